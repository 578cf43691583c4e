"""Write what is made from the settings: files in config/, docs/parameters.md and others.

`make config` runs it; a test compares the files with what it would write.
"""

from pathlib import Path

from mag_tracking.drivers.configuration import settings_by_kind
from mag_tracking.pipeline import TARGET_DEFAULTS, Settings, settings_for
from mag_tracking.settings import flatten, to_reference, to_yaml

ROOT = Path(__file__).resolve().parents[1]


def generated():
    """{path: content} of every generated file."""
    default = {p.name: p.value for p in flatten(Settings())}
    lines = ['# Parameters', '',
             'Generated from the settings by `make config`; do not edit. Every parameter is',
             'read-only while a node runs unless it says live.', '', to_reference(Settings()), '',
             '## What differs for a magnet', '',
             '| parameter | vehicle | magnet |', '|---|---|---|']
    for p in flatten(settings_for('magnet')):
        if p.value != default[p.name]:
            lines.append(f'| `{p.name}` | `{default[p.name]}` | `{p.value}` |')
    drivers = ['# Settings of the drivers file', '',
               'Generated from the settings by `make config`; do not edit. What they are for: '
               '[drivers.md](drivers.md).', '']
    for group, settings in settings_by_kind().items():
        drivers += [f'## {group or "Of every device"}', '', to_reference(settings, live=False)]
    assert set(TARGET_DEFAULTS) == {'vehicle', 'magnet'}
    return {ROOT / 'config' / 'default.yaml': to_yaml(Settings()),
            ROOT / 'config' / 'magnet.yaml': to_yaml(settings_for('magnet')),
            ROOT / 'docs' / 'parameters.md': '\n'.join(lines) + '\n',
            ROOT / 'docs' / 'drivers_settings.md': '\n'.join(drivers)}


if __name__ == '__main__':
    for path, content in generated().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(content, encoding='utf-8')
        print(f'wrote {path.relative_to(ROOT)}')
