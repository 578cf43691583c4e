"""Reference pages of the settings: parameters, drivers file, ambiguity, archive tables."""

from mag_tracking.drivers.configuration import settings_by_kind
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.recording.archive_tables import TABLES
from mag_tracking.recording.traffic_tables import tables_of
from mag_tracking.settings import flatten
from mag_tracking.stages.track.doubts import MEANINGS

PARAMETERS = """# Parameters

Every setting of the pipeline, for parameter files (`--params`), `settings=` in Python and ROS
parameters. {doc}`/guides/own_recording` shows how to set them. Nodes read them once, when they
start; those marked *live* may change while a node runs.
"""
MAGNET = """## Defaults for a magnet

`target: magnet` (`--target magnet`) changes these defaults for a magnet in a hand that moves at
up to 0.5 m/s and turns at up to 3 rad/s. `target: bench` is for a magnet that is moved slowly or
step by step.

| parameter | vehicle | magnet | bench |
|---|---|---|---|"""
DRIVERS = """# Drivers file

Every setting of a drivers file. {doc}`/guides/connect_sensors` explains what they are for.
"""
DOUBTS = """# Reasons for an ambiguous pose

A pose is `ambiguous` while at least one of these reasons applies. They are listed in the field
`doubts` of a `Track` message, in the column `doubts` of `poses.csv`, and with the number of poses
in `summary.json`. {doc}`/concepts/uncertainty` explains what the flag promises.

| reason | meaning |
|---|---|"""
ARCHIVE = """# Tables of an archive

Columns of the Parquet tables that `mag-tracking archive` writes ({doc}`/guides/archive`). Unknown
values are null, and NaN in a covariance. The unit and the meaning of each column are also stored in
the metadata of the files.
"""
TRAFFIC = """# Tables of traffic

Columns of the CSV and Parquet files that `mag-tracking replay --tables passages` writes
({doc}`/guides/traffic`).
"""


def settings_pages():
    """{file name: Markdown} of the pages of settings and table columns."""
    return {'parameters.md': parameters(), 'drivers.md': drivers(), 'doubts.md': doubts(),
            'archive_tables.md': archive_tables(), 'traffic_tables.md': traffic_tables()}


def parameters():
    """Markdown: all settings of the pipeline, by stage."""
    lines = [PARAMETERS]
    groups = {}
    for parameter in flatten(Settings()):
        groups.setdefault(parameter.name.rpartition('.')[0], []).append(parameter)
    for group, members in groups.items():
        lines += [f'## {group}', '', *(line for p in members for line in entry(p))]
    default = {p.name: p.value for p in flatten(Settings())}
    lines.append(MAGNET)
    lines += [f'| `{p.name}` | `{default[p.name]}` | `{p.value}` | `{bench.value}` |'
              for p, bench in zip(*(flatten(settings_for(target)) for target in (
                  'magnet', 'bench')), strict=True) if p.value != default[p.name]]
    return '\n'.join(lines) + '\n'


def drivers():
    """Markdown: all settings of a drivers file, by transport, framing and device."""
    lines = [DRIVERS]
    for group, settings in settings_by_kind().items():
        lines += [f'## {group or "Every device"}', '',
                  *(line for p in flatten(settings) for line in entry(p))]
    return '\n'.join(lines)


def entry(p):
    """Lines of the definition list entry of a parameter."""
    properties = [f'default `{p.value!r}`', p.unit, *(
        [f'{p.range[0]:g} to {p.range[1]:g}'] if p.range else
        [f'one of {", ".join(f"`{c}`" for c in p.choices)}'] if p.choices else []),
        'live' if p.live else '']
    return [f'`{p.name}`', f': {"; ".join(f for f in properties if f)}', '', f'  {p.doc}', '']


def doubts():
    """Markdown: the reasons for an ambiguous pose."""
    return '\n'.join(
        [DOUBTS, *(f'| `{name}` | {meaning} |' for name, meaning in MEANINGS.items())]) + '\n'


def archive_tables():
    """Markdown: the columns of the tables of an archive."""
    lines = [ARCHIVE]
    for table, columns in TABLES.items():
        lines += [f'## {table}', '', *column_rows(columns), '']
    return '\n'.join(lines)


def traffic_tables():
    """Markdown: the columns of the table `passages` of `mag-tracking replay`."""
    lines = [TRAFFIC]
    for table, columns in tables_of(('<class>',), True).items():
        lines += [f'## {table}', '', *column_rows(columns), '']
    return '\n'.join(lines)


def column_rows(columns):
    """Lines of the Markdown table of columns."""
    return ['| column | unit | meaning |', '|---|---|---|',
            *(f'| `{c.name}` | {c.unit} | {c.meaning} |' for c in columns)]
