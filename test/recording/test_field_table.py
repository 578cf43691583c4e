"""Import of tables: the same readings in every usual layout, and refusal of ambiguous tables."""

import datetime
import re

import numpy as np
import pytest

from mag_tracking.cli import main
from mag_tracking.errors import MagTrackingError
from mag_tracking.recording.field_table import TableOptions, import_field_table, read_field_table
from mag_tracking.recording.reader import Recording
from mag_tracking.units import NS

EPOCH_S = 1_777_852_795
"""2026-05-03 23:59:55 UTC."""
N = 250
SECONDS = [(round(0.04 * k + 0.0031 * j, 4), j) for k in range(N) for j in (0, 1)]
"""Time and number of the sensor of each reading."""
rng = np.random.default_rng(1)
FIELDS = np.array([2.0, 15.5, -49.0]) + rng.normal(0.0, 0.5, (2 * N, 3)).round(3)
"""uT."""
HEADER = ['t', 'id', 'bx', 'by', 'bz']
COLUMNS = ['time=t', 'sensor=id', 'x=bx', 'y=by', 'z=bz']


def cells(time='{:.4f}'.format, number='{:.3f}'.format, sensors=('1', '2')):
    """Rows of the table as text."""
    return [[time(t), sensors[j], *map(number, B)]
            for (t, j), B in zip(SECONDS, FIELDS.tolist(), strict=True)]


def text(rows, header=HEADER, separator=','):
    """Content of a table."""
    return '\n'.join(separator.join(row) for row in ([header] if header else []) + rows) + '\n'


def read(folder, content, **options):
    """Write and read a table."""
    path = folder / 'table.csv'
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_field_table(path, TableOptions(**options))


def check(table, epoch_s=0.0, tolerance_s=1e-9, tolerance_t=1e-12, sensors=(0, 1)):
    """Compare the readings of a table with the simulated ones."""
    (readings,) = table.sessions
    rows = [i for i, (_, j) in enumerate(SECONDS) if j in sensors]
    assert readings.sensor_names() == [f'mag_{SECONDS[i][1] + 1}' for i in rows]
    expected = [round(epoch_s * NS) + round(SECONDS[i][0] * NS) for i in rows]
    assert np.abs(readings.stamp_ns - np.array(expected)).max() <= tolerance_s * NS
    assert np.abs(readings.field - 1e-6 * FIELDS[rows]).max() < tolerance_t


def comma(number):
    """Format with a decimal comma."""
    return f'{number:.4f}'.replace('.', ',')


def thousandths(number):
    """Format with a decimal comma and three digits, which might as well be thousands."""
    return f'{number:.3f}'.replace('.', ',')


LAYOUTS = {
    'commas': (text(cells()), {}),
    'tabs': (text(cells(), separator='\t'), {}),
    'spaces': (text(cells(), separator='   '), {}),
    'semicolons and decimal commas': (text(cells(comma, comma), separator=';'), {}),
    'tabs and decimal commas': (text(cells(comma, comma), separator='\t'), {}),
    'quoted decimal commas': (text([[f'"{c}"' for c in row] for row in cells(comma, comma)]), {}),
    'UTF-16': (text(cells()).encode('utf-16'), {}),
    'UTF-16 without mark': (text(cells()).encode('utf-16-le'), {}),
    'CRLF': (text(cells()).replace('\n', '\r\n'), {}),
    'trailing commas': (text(cells()).replace('\n', ',\n'), {}),
    'trailing commas of rows': (text(cells()).replace('\n', ',\n').replace(',\n', '\n', 1), {}),
    'blank lines': (text(cells()).replace('\n', '\n\n'), {}),
    'preamble': ('Logger 1.2\nserial, 12\n\n' + text(cells()), {}),
    'long preamble': ('Setting: value, 1\n' * 900 + text(cells()), {}),
    'cut first row': (text([['0.0', '1'], *cells()]), {}),
    'comments': ('# logger\n' + text(cells()[:200]) + '# pause\n' + text(cells()[200:], None), {}),
    'header as comment': ('# ' + text(cells()), {}),
    'no header': (text(cells(), None), {'columns': ['time=1', 'sensor=2', 'x=3', 'y=4', 'z=5']}),
    'units in the header': (
        text(cells('{:.4f}'.format), ['t (s)', 'id', 'Bx [µT]', 'By [µT]', 'Bz [µT]'])
        .encode('latin-1'), {'unit': '', 'columns': ()}),
    'line of units': (text([['ms', '', 'nT', 'nT', 'nT'], *cells(
        lambda t: f'{1000 * t:.1f}', lambda b: f'{1000 * b:.0f}')]), {'unit': ''}),
    'gamma': (text(cells(number=lambda b: f'{1000 * b:.0f}'), [
        't', 'id', 'x (gamma)', 'y (Gammas)', 'z [\u03b3]']), {'unit': '', 'columns': ()}),
    'German header': (text(cells(comma, thousandths), [
        'Zeit (s)', 'id', *(f'Magnetfeld {a} (µT)' for a in 'xyz')], '\t'),
        {'unit': '', 'columns': ()}),
    'French header': (text(cells(comma, thousandths), [
        'Temps (s)', 'id', *(f'Champ magnétique {a} (µT)' for a in 'xyz')], ';').encode('cp1252'),
        {'unit': '', 'columns': ()}),
    'grouped digits': (text(cells(number=lambda b: f'"{1000 * b:,.1f}"')), {'unit': 'nT'}),
    'names': (text(cells(sensors=('vänster', '00:1A'))),
              {'sensors': {'vänster': 'mag_1', '00:1A': 'mag_2'}}),
    'gauss': (text(cells(number=lambda b: f'{b / 100:.5f}')), {'unit': 'Gauss'}),
    'counts per gauss': (text(cells(number=lambda b: f'{b * 1e3:.0f}')), {'unit': '100000/G'}),
    'tesla per count': (text(cells(number=lambda b: f'{b * 1e3:.0f}')), {'unit': '1e-9'}),
    'newest row first': (text(cells()[::-1]), {}),
    'one sensor after the other': (text(sorted(cells(), key=lambda row: row[1])), {}),
    'unsorted, as stated': (text(cells()[200:] + cells()[:200]), {'jumps': 'sort'}),
}


@pytest.mark.parametrize('layout', LAYOUTS)
def test_the_same_readings_are_read_from_every_layout(layout, tmp_path):
    content, options = LAYOUTS[layout]
    table = read(tmp_path, content, **{'columns': COLUMNS, 'unit': 'uT', **options})
    if 'row first' in layout:
        table.sessions[0] = table.sessions[0].part(np.lexsort(
            (table.sessions[0].rows({'mag_1': 0, 'mag_2': 1}), table.sessions[0].stamp_ns)))
    check(table)


def utc(form):
    """Format times as dates."""
    return lambda t: datetime.datetime.fromtimestamp(
        EPOCH_S, datetime.UTC).__add__(datetime.timedelta(seconds=t)).strftime(form)


MIDNIGHT_S = 86395
TIMES = {
    '%Y-%m-%dT%H:%M:%S.%fZ': EPOCH_S, '%Y-%m-%d %H:%M:%S.%f+0000': EPOCH_S,
    '%d.%m.%Y %H:%M:%S.%f': EPOCH_S, '%d %B %Y %H:%M:%S.%f': EPOCH_S,
    '%d-%b-%Y %H:%M:%S.%f': EPOCH_S, '%b %d, %Y %I:%M:%S.%f %p': EPOCH_S,
    '%Y%m%dT%H%M%S.%f': EPOCH_S, '%Y%m%d%H%M%S%f': EPOCH_S, '%H:%M:%S.%f': MIDNIGHT_S,
    '%I:%M:%S.%f %p': MIDNIGHT_S, '%H%M%S.%f': MIDNIGHT_S}


@pytest.mark.parametrize('form', TIMES)
def test_dates_and_times_of_day_are_read_across_midnight(form, tmp_path):
    content = text([[f'"{row[0]}"', *row[1:]] for row in cells(utc(form))])
    check(read(tmp_path, content, columns=COLUMNS, unit='uT'), TIMES[form])


def test_decimal_commas_are_found_beside_dates_with_points(tmp_path):
    rows = cells(utc('%d.%m.%Y;%H:%M:%S,%f'), thousandths)
    content = text(rows, ['Date', 'Time', *HEADER[1:]], ';')
    check(read(tmp_path, content, unit='uT'), EPOCH_S)


def test_rows_without_a_field_are_counted(tmp_path):
    content = text([[*row[:2], 'NaN', '', 'null'] if k % 50 == 7 else row
                    for k, row in enumerate(cells())])
    table = read(tmp_path, content, columns=COLUMNS, unit='uT')
    assert sum(map(len, table.sessions)) == 2 * N - 10
    assert any('10 rows' in note for note in table.notes)


NUMBERS = {
    'seconds': (lambda t: f'{t:.4f}', {}, 0),
    'seconds from a trigger': (lambda t: f'{t - 5:.4f}', {}, 0),
    's since 1970': (lambda t: f'{EPOCH_S + t:.4f}', {}, EPOCH_S),
    'us since 1970': (lambda t: str(EPOCH_S * 10**6 + round(t * 1e6)), {}, EPOCH_S),
    'ns since 1970': (lambda t: str(EPOCH_S * NS + round(t * NS)), {}, EPOCH_S),
    'ticks': (lambda t: str(round(t * 10000)), {'time_unit': '10000/s'}, 0),
    'seconds per tick': (lambda t: str(round(t * 10000)), {'time_unit': '1e-4'}, 0),
    'minutes': (lambda t: f'{t / 60:.12f}', {'time_unit': 'min'}, 0),
    '32-bit us': (lambda t: str((round(t * 1e6) + 2**32 - 5_000_000) % 2**32),
                  {'time_unit': 'us'}, (2**32 - 5_000_000) / 1e6),
    'week of GPS': (lambda t: f'{(604795 + t) % 604800:.4f}', {}, 604795),
    '10,000 as stated': (lambda t: str((round(t * 1e4) + 70000) % 100000),
                         {'time_unit': '1e-4', 'wrap': 100000}, 7)}


@pytest.mark.parametrize('name', NUMBERS)
def test_times_that_are_numbers_are_exact_and_unwrapped(name, tmp_path):
    form, options, epoch_s = NUMBERS[name]
    check(read(tmp_path, text(cells(form)), columns=COLUMNS, unit='uT', **options), epoch_s)


@pytest.mark.parametrize('bits, unit, tick_s', [
    (16, 'ms', 1e-3), (24, 'us', 1e-6), (31, 'us', 1e-6)])
def test_counters_of_few_bits_are_unwrapped(bits, unit, tick_s, tmp_path):
    first = 2**bits - round(5.0 / tick_s)

    def form(t):
        return str((round(t / tick_s) + first) % 2**bits)

    check(read(tmp_path, text(cells(form)), columns=COLUMNS, unit='uT', time_unit=unit),
          first * tick_s, tick_s)


@pytest.mark.parametrize('days, decimals', [(25569, 10), (719529, 10)])
def test_serial_dates_of_spreadsheets_and_matlab_are_read(days, decimals, tmp_path):
    content = text(cells(lambda t: f'{days + (EPOCH_S + t) / 86400:.{decimals}f}'))
    check(read(tmp_path, content, columns=COLUMNS, unit='uT'), EPOCH_S, 2e-5)


def test_date_and_time_may_be_two_columns(tmp_path):
    rows = [[*row[0].split(), *row[1:]] for row in cells(utc('%d.%m.%Y %H:%M:%S.%f'))]
    check(read(tmp_path, text(rows, ['Date', 'Time', *HEADER[1:]]), unit='uT'), EPOCH_S)
    rows = [[*row[0].split('.'), *row[1:]] for row in cells(
        lambda t: f'{EPOCH_S + t:.4f}00000')]
    check(read(tmp_path, text(rows, ['sec', 'nanosec', *HEADER[1:]]),
               columns=['time=sec+nanosec', *COLUMNS[1:]], unit='uT'), EPOCH_S)


def test_a_column_of_milliseconds_follows_the_time(tmp_path):
    rows = [[*row[0].split(), f'{round(1000 * t) % 1000}', *row[1:]] for (t, _), row in zip(
        SECONDS, cells(utc('%Y-%m-%d %H:%M:%S')), strict=True)]
    check(read(tmp_path, text(rows, ['Date', 'Time', 'ms', *HEADER[1:]]),
               columns=['time=Date+Time+ms', *COLUMNS[1:]], unit='uT'), EPOCH_S, 1e-3)


def test_columns_of_several_sensors_are_found_by_their_names(tmp_path):
    odd = [f'{1e3 * b:.0f}' for b in FIELDS[1]]
    content = 'Time (ms),Bx1 (uT),By1 (uT),Bz1 (uT),mag2_x [nT],mag2_y [nT],mag2_z [nT],ax\n'
    content += '\n'.join(','.join([f'{10 * k}.0', *(f'{b:.3f}' for b in FIELDS[0]),
                                   *(odd if k % 2 else ['', 'nan', ''])]) + ',9.8'
                         for k in range(10))
    (readings,) = read(tmp_path, content).sessions
    assert readings.sensor_names().count('mag_1') == 10
    assert readings.sensor_names().count('mag_2') == 5
    for name, B in (('mag_1', FIELDS[0]), ('mag_2', FIELDS[1])):
        own = readings.field[np.array(readings.sensor_names()) == name]
        assert own == pytest.approx(np.tile(1e-6 * B, (len(own), 1)))


def test_unusable_rows_are_counted_with_the_first_of_them(tmp_path):
    rows = text(cells(), None).split('\n')[:-1]
    content = text([]) + '\n'.join([
        *rows[:200], ','.join(HEADER), *rows[200:300], 'ERROR i2c', '6.1,1,b,3,4',
        '99999999,1,1,2,3', *rows[300:], rows[-1][:9]])
    table = read(tmp_path, content, columns=COLUMNS, unit='uT')
    check(table)
    notes = '; '.join(table.notes)
    for fact in ('1 repeated header line', '1 incomplete last row', '3 unusable rows', 'row 303'):
        assert fact in notes


@pytest.mark.parametrize('units', [[], [['s', '', 'uT', 'uT', 'uT']]])
def test_messages_between_header_and_rows_are_unusable_rows(units, tmp_path):
    content = text([*units, ['ERROR: I2C timeout'], ['Waiting', 'retry 1'], *cells()])
    table = read(tmp_path, content, unit='' if units else 'uT')
    check(table)
    notes = '; '.join(table.notes)
    assert 'line 1' in notes and f'first row {2 + len(units)}' in notes
    assert 'ignored' not in notes


@pytest.mark.parametrize('number', [
    lambda b: f'{b:.3f}', lambda b: f'{b:.4e}', lambda b: f'"{b:.3f}"'])
def test_a_number_that_the_end_of_the_file_cuts_is_not_read(number, tmp_path):
    content = text(cells(number=number))[:-1]
    table = read(tmp_path, content, columns=COLUMNS, unit='uT')
    check(table)
    assert not any('ignored' in note for note in table.notes)
    for n_cut in (2, 4, 6):
        table = read(tmp_path, content[:-n_cut], columns=COLUMNS, unit='uT')
        assert len(table.sessions[0]) == 2 * N - 1, content[-20:-n_cut]
        assert any('incomplete last' in note for note in table.notes)


def test_readings_of_a_sensor_are_ignored_as_stated(tmp_path):
    table = read(tmp_path, text(cells()), columns=COLUMNS, unit='uT', sensors={'2': '-'})
    check(table, sensors=(0,))


def restarted(t):
    """Time in ms of a device that restarts after 6 s."""
    return str(round(1000 * t) if t < 6.0 else round(1000 * t) - 5900)


def test_a_restart_of_the_clock_is_refused_with_its_row_or_split_as_stated(tmp_path):
    with pytest.raises(MagTrackingError, match=r'row 302: .*backwards.*--jumps split'):
        read(tmp_path, text(cells(restarted)), columns=COLUMNS, unit='uT', time_unit='ms')
    recordings, table = import_field_table(tmp_path / 'table.csv', TableOptions(
        COLUMNS, 'uT', time_unit='ms', jumps='split'), tmp_path / 'out')
    assert [len(r) for r in table.sessions] == [300, 200]
    assert [int(r.stamp_ns[0]) for r in table.sessions] == [0, NS // 10]
    assert [sum(1 for _ in Recording(path).messages()) for path in recordings] == [300, 200]


def test_a_rate_replaces_missing_and_coarse_times(tmp_path):
    whole = text([[str(int(t)), *row[1:]] for (t, _), row in zip(SECONDS, cells(), strict=True)])
    with pytest.raises(MagTrackingError, match='96 % .*--rate'):
        read(tmp_path, whole, columns=COLUMNS, unit='uT')
    check(read(tmp_path, whole, columns=COLUMNS, unit='uT', rate=25.0), 0.0, 0.0032)
    own = text([row[2:] for row in cells()[::2]], ['Mag X', 'Mag Y', 'Mag Z'])
    with pytest.raises(MagTrackingError, match='--rate.*tumble'):
        read(tmp_path, own, unit='uT')
    check(read(tmp_path, own, unit='uT', rate=25.0), 0.0, 1e-9, sensors=(0,))


def milliseconds(t):
    """Time in milliseconds."""
    return f'{1000 * t:.0f}'


@pytest.mark.parametrize('content, options, facts', [
    (text(cells(milliseconds)), {}, ['0.025 Hz', '--time-unit', 'ms (25 Hz']),
    (text(cells(lambda t: f'{1e3 * (EPOCH_S + t):.2E}')), {}, ['1.78E+12', 'spreadsheet']),
    (text(cells(lambda t: '0')), {}, ['equal', '--rate']),
    (text(cells(lambda t: f'{t + (EPOCH_S if t > 5 else 0):.4f}')), {},
     ['row 253', 'jumps ahead']),
    (text(cells(utc('%d/%m/%Y %H:%M:%S.%f'))[:200]), {}, ['--date-order', '03/05/2026']),
    (text(cells(utc('%Y-%m-%d %H:%M:%S.%f CET'))), {}, ['CET', 'offset']),
    (text(cells(comma, comma)), {}, ['5 cells', 'has 9', 'decimal commas']),
    (text(cells(lambda t: f'{t + 1:.3f}'.replace('.', ','), lambda b: f'{60 + b:.3f}'.replace(
        '.', ',')), separator='\t'), {}, ["'1,000'", '--decimal']),
    (text(cells(), ['t', 'id', 'x (foo)', 'y (foo)', 'z (foo)']), {'unit': '', 'columns': ()},
     ['x (foo)', '--unit', '--columns']),
    (text(cells(), None), {}, ['no header', 'time=1', '--header']),
    (text(cells(sensors=('left side', '2'))), {}, ['left side', '--sensors']),
    (text(cells()), {'unit': ''}, ['--unit', 'bx']),
    (text(cells()), {'unit': '1090'}, ['1090/G']),
    (text(cells()), {'unit': 'MT'}, ["'MT'", 'uT']),
    (text(cells()), {'separator': 'hash'}, ['--separator', 'hash']),
    (text(cells()), {'encoding': 'utf-99'}, ['--encoding', 'utf-99']),
    (text(cells()), {'columns': ['time=t', 'x=by1']}, ['by1', 'bx, by, bz']),
    (text(cells(), ['t', 'id', 'b', 'b', 'b']), {'columns': ['time=t', 'x=b']}, ['3, 4, 5']),
    (text(cells(), ['t', 'time', 'x', 'y', 'z']), {'columns': ()}, ['t and time', '--columns']),
    (text([[*row[:2], 'b', *row[3:]] if k % 5 == 0 else row for k, row in enumerate(cells())]), {},
     ["row 2: bx is 'b'", '100 of 500']),
    (text(cells(lambda t: f'{(t - 5) * 1e9:.4f}')), {'time_unit': 's'}, ['row 2', '-5e+09 s']),
    (b'PK\x03\x04rest', {}, ['ZIP archive']), (b'', {}, ['no rows']), (text([]), {}, ['no rows']),
    (text(cells()), {'columns': ['time=t', 'sensor=id', 'a.x=bx']}, ["'a.x'"]),
    (text(cells()), {'columns': ['time=t', 'time=id', 'x=bx']}, ["'time=id'"])])
def test_an_ambiguous_table_is_refused_with_the_property_and_the_option(
        content, options, facts, tmp_path):
    with pytest.raises(MagTrackingError) as error:
        read(tmp_path, content, **{'columns': COLUMNS, 'unit': 'uT', **options})
    for fact in facts:
        assert re.search(re.escape(fact), str(error.value)), (fact, error.value)


def test_the_command_prints_rate_gaps_and_an_unusual_field(tmp_path, capsys):
    table = tmp_path / 'a.csv'
    table.write_text(text([row for (t, _), row in zip(SECONDS, cells(
        number=lambda b: f'{b * 10.9:.0f}'), strict=True) if not 3.0 <= t < 5.0]))
    out = tmp_path / 'out'
    assert main(['import', str(table), '--unit', 'uT', '--out', str(out)]) == 0
    printed = capsys.readouterr().out
    for fact in ('400 readings', '25 Hz', '1 gap, longest 2.04 s at 2.96 s', '1090/G'):
        assert fact in printed
    assert main(['import', str(table), '--unit', '1090/G', '--out', str(out)]) == 0
    assert 'warning' not in capsys.readouterr().out
    assert {m.topic for m in Recording(out / 'a.mcap').messages()} == {
        '/mag_1/imu/mag', '/mag_2/imu/mag'}


def test_a_table_without_times_is_tumbled(tmp_path, capsys):
    directions = rng.normal(size=(1000, 3))
    B = 50.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + [3.0, -5.0, 2.0]
    table, network = tmp_path / 'hand.csv', tmp_path / 'network.yaml'
    table.write_text(text([[f'{b:.3f}' for b in row] for row in B], ['Mag X', 'Mag Y', 'Mag Z']))
    network.write_text('sensors: {mag_7: {position: [0, 0, 0]}}\n')
    assert main(['calibrate', 'tumble', str(table), '--unit', 'uT', '--network', str(network),
                 '--out', str(tmp_path / 'tumbled.yaml')]) == 0
    offset = re.search(r'mag_7: .*offset (\S+) \S+ (\S+) \S+ (\S+)', capsys.readouterr().out)
    assert [float(v) for v in offset.groups()] == pytest.approx([3.0, -5.0, 2.0], abs=0.01)
    network.write_text('sensors: {a: {position: [0, 0, 0]}, b: {position: [1, 0, 0]}}\n')
    assert main(['calibrate', 'tumble', str(table), '--unit', 'uT', '--network', str(network),
                 '--out', str(tmp_path / 'tumbled.yaml')]) == 1
    assert 'mag_1' in capsys.readouterr().err
