#!/usr/bin/env bash
# cdflib 1.3.16: a missing time of a CDF file is the year 10000 in Unix time.
#
# Expected: the fill value of CDF_TIME_TT2000 (-2^63, "no time" in the CDF standard) is NaN, or an
# error, in every conversion: geomagnetic observatories and satellites publish such files.
# Seen: to_datetime returns NaT, but unixtime returns 253402300800.0, the first second of the year
# 10000: a valid number that sorts, subtracts and plots.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check cdflib==1.3.16 numpy==2.2.6
"$folder/venv/bin/python" - "$folder" <<'END'
from importlib.metadata import version

import numpy as np
from cdflib import cdfepoch

print('cdflib', version('cdflib'))
fill = np.int64(-2**63)
stamp = cdfepoch.compute_tt2000([2026, 11, 29, 2, 40, 0, 0, 0, 0])
for name, value in (('2026-11-29T02:40', stamp), ('fill value', fill)):
    print(f'{name}: to_datetime {cdfepoch.to_datetime(value)}, unixtime {cdfepoch.unixtime(value)}')
assert cdfepoch.unixtime(stamp) == 1795920000.0
assert np.isnat(cdfepoch.to_datetime(fill)).all()
assert cdfepoch.unixtime(fill) == 253402300800.0
END
