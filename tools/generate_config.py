"""Generate the files in config/ that contain every user setting with its default.

`make config` runs it; a test compares the files with its output.
"""

from pathlib import Path

from mag_tracking.pipeline import TARGET_DEFAULTS, Settings, settings_for
from mag_tracking.settings import TARGETS, USER, to_yaml

ROOT = Path(__file__).resolve().parents[1]


def generated():
    """Contents of all generated files: {path: content}."""
    # A bench differs from a magnet in a hand by a few settings, which the documentation lists.
    assert {*TARGET_DEFAULTS} == {*TARGETS} == {'vehicle', 'magnet', 'bench'}
    return {ROOT / 'config' / 'default.yaml': to_yaml(Settings(), USER),
            ROOT / 'config' / 'magnet.yaml': to_yaml(settings_for('magnet'), USER)}


if __name__ == '__main__':
    for path, content in generated().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(content, encoding='utf-8')
        print(f'wrote {path.relative_to(ROOT)}')
