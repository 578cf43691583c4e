#!/usr/bin/env bash
# pyIGRF 1.0.0 cannot be imported: its package lacks the coefficients of the model.
#
# Expected: `import pyIGRF` after `pip install`, as the description of the package shows, gives the
# functions igrf_value and igrf_variation of IGRF-14.
# Seen: the import raises FileNotFoundError for src/igrf14coeffs.txt, which neither the wheel nor the
# source distribution installs. Packages that import it, such as groundmag 0.0.1, fail as well.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check pyIGRF==1.0.0
"$folder/venv/bin/python" - "$folder" <<'END'
from importlib.metadata import files, version

print('pyIGRF', version('pyIGRF'))
names = [str(f) for f in files('pyIGRF')]
print('data files:', [n for n in names if n.endswith('.txt') and 'dist-info' not in n])
try:
    import pyIGRF
except FileNotFoundError as error:
    print('import:', type(error).__name__, error.filename.rsplit('/', 1)[-1])
    assert error.filename.endswith('src/igrf14coeffs.txt')
else:
    raise SystemExit(f'changed: the import works, {pyIGRF.igrf_value(58.4, 15.6, 0.0, 2026.0)}')
END
