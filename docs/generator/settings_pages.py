"""Reference pages of the settings: parameters, drivers file, ambiguity, archive tables."""

from mag_tracking.drivers.configuration import settings_by_kind
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.results.archive_folder import TABLES
from mag_tracking.results.columns import EVENTS, FITS, RESULT_TABLES, SIGNATURES, traffic_tables
from mag_tracking.settings import USER, flatten
from mag_tracking.stages.track.doubts import MEANINGS

PARAMETERS = """# Parameters

Every setting of the pipeline, for parameter files (`--params`), `settings=` in Python and ROS
parameters. Those marked *user* describe the site, the targets and the wanted results
({doc}`/guides/settings`); the others belong to the methods and rarely change. Nodes read settings
once, when they start; those marked *live* may change while a node runs. `<name>` is the name of a
row of a table.
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
RESULTS = """# Tables of results

Columns of the CSV files that `mag-tracking replay`, `fit` and `events` write, and of the DataFrames
in Python. Numbers in files of `replay` and `fit` are read back exactly. A fit that is not trusted
as a whole has only its trusted quantities. Standard deviations of fits include model errors.
"""
TRAFFIC = """# Tables of traffic

Columns of the CSV and Parquet files that `mag-tracking replay --tables passages` writes
({doc}`/guides/traffic`).
"""


def settings_pages():
    """{file name: Markdown} of the pages of settings and table columns."""
    return {'parameters.md': parameters(), 'drivers.md': drivers(), 'doubts.md': doubts(),
            'result_tables.md': table_page(RESULTS, {
                **RESULT_TABLES, 'fits.csv': FITS, 'events.csv': EVENTS,
                'signatures.csv': SIGNATURES}),
            'archive_tables.md': table_page(ARCHIVE, TABLES),
            'traffic_tables.md': table_page(TRAFFIC, traffic_tables(('<class>',), True))}


def parameters():
    """Markdown: all settings of the pipeline, by stage."""
    lines = [PARAMETERS]
    groups = {}
    for name, rows in declared(Settings()).items():
        groups.setdefault(name.rpartition('.')[0], {})[name] = rows
    for group, members in groups.items():
        lines += [f'## {group.replace("<name>", "&lt;name&gt;")}', '',
                  *(line for name, rows in members.items() for line in entry(name, rows))]
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
                  *(line for name, rows in declared(settings).items()
                    for line in entry(name, rows))]
    return '\n'.join(lines)


def declared(settings):
    """{name: [Parameter]}: each setting, and each column of a table with its parameter by row."""
    out = {}
    for p in flatten(settings):
        group, _, leaf = p.name.rpartition('.')
        out.setdefault(f'{group.removesuffix(p.row)}<name>.{leaf}' if p.row else p.name,
                       []).append(p)
    return out


def entry(name, rows):
    """Lines of the definition list entry of a setting."""
    p = rows[0]
    defaults = ', '.join(f'`{r.value!r}`' + (f' ({r.row})' if r.row else '') for r in rows)
    properties = [f'default {defaults}', p.unit, *(
        [f'{p.range[0]:g} to {p.range[1]:g}'] if p.range else
        [f'one of {", ".join(f"`{c}`" for c in p.choices)}'] if p.choices else []),
        'live' if p.live else '', 'user' if p.level == USER else '']
    return [f'`{name}`', f': {"; ".join(f for f in properties if f)}', '', f'  {p.doc}', '']


def doubts():
    """Markdown: the reasons for an ambiguous pose."""
    return '\n'.join(
        [DOUBTS, *(f'| `{name}` | {meaning} |' for name, meaning in MEANINGS.items())]) + '\n'


def table_page(text, tables):
    """Markdown: an introduction, and the columns of tables."""
    lines = [text]
    for table, columns in tables.items():
        lines += [f'## {table}', '', *column_rows(columns), '']
    return '\n'.join(lines)


def column_rows(columns):
    """Lines of the Markdown table of columns."""
    return ['| column | unit | meaning |', '|---|---|---|',
            *(f'| `{c.name}` | {c.unit} | {c.meaning} |' for c in columns)]
