"""Options that describe a table of readings, for `import` and `calibrate tumble`."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from mag_tracking.errors import SettingsError

if TYPE_CHECKING:
    from mag_tracking.recording.field_table import TableOptions


def add_table_options(parser: argparse.ArgumentParser, sensor: bool = True) -> None:
    """Add the options that describe a table of readings, with or without --sensor."""
    p = parser.add_argument_group('table of readings', 'properties that are found if not given')
    p.add_argument('--columns', nargs='+', metavar='KEY=COLUMN',
                   help='columns, by name or number (from 1): time=, and x= y= z= with sensor=, or '
                   'for each sensor NAME.x= NAME.y= NAME.z=')
    p.add_argument('--unit', default='', metavar='UNIT',
                   help='unit of the field: T, mT, uT, nT, G or mG, counts per unit such as '
                   '1090/G, or tesla per count')
    p.add_argument('--time-unit', default='', metavar='UNIT',
                   help='unit of times that are numbers: s, ms, us, ns, min, h, d, ticks per unit '
                   'such as 32768/s, or seconds per tick')
    if sensor:
        p.add_argument('--sensor', default='', metavar='NAME',
                       help='name of the only sensor (default: mag_1)')
    p.add_argument('--sensors', nargs='+', default=[], metavar='TEXT=NAME',
                   help='names of the sensors by the text in their column, or - to ignore it')
    p.add_argument('--separator', default='', metavar='CHARACTER',
                   help='comma, semicolon, tab, spaces, bar, or another character')
    p.add_argument('--decimal', default='', metavar='MARK', help="decimal mark, . or ','")
    p.add_argument('--header', type=int, metavar='LINE',
                   help='number of the header line; 0 without a header')
    p.add_argument('--encoding', default='', metavar='NAME', help='such as utf-16 or latin-1')
    p.add_argument('--date-order', default='', metavar='ORDER',
                   help='order of a date of three numbers: dmy, mdy or ymd')
    p.add_argument('--rate', type=float, metavar='HZ',
                   help='rate of the readings, for tables without times or with coarse times')
    p.add_argument('--wrap', type=int, default=0, metavar='N',
                   help='number at which the time returns to 0')
    p.add_argument('--jumps', default='', metavar='split|sort',
                   help='meaning of a time that runs backwards: the clock restarted (split into '
                   'recordings), or the rows are out of order (sort)')


def table_options(args: argparse.Namespace, sensor: str | None = None) -> 'TableOptions':
    """Collect the options of `add_table_options`; raises SettingsError if --sensors is not valid.

    `sensor` is the name of the only sensor, if --sensor is not one of the options.
    """
    from mag_tracking.recording.field_table import TableOptions

    sensors = dict(text.rpartition('=')[::2] for text in args.sensors)
    if '' in sensors or not all(sensors.values()):
        raise SettingsError('--sensors: expected TEXT=NAME such as A=mag_1')
    return TableOptions(
        args.columns or (), args.unit, args.time_unit,
        args.sensor if sensor is None else sensor, sensors,
        args.separator, args.decimal, args.header, args.encoding, args.date_order, args.rate,
        args.wrap, args.jumps)


def print_notes(table: Path, notes: Iterable[str]) -> None:
    """Print what was found out about a table, with each warning on its own line."""
    notes = list(notes)
    print(f'{table}: {"; ".join(n for n in notes if not n.startswith("warning"))}')
    for note in notes:
        if note.startswith('warning'):
            print(f'  {note}')
