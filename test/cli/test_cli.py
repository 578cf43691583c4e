"""The command line: output files, printed lines and error messages."""

import json
import os
import re
import subprocess
import sys

import pytest

from mag_tracking.cli import main
from mag_tracking.cli.commands import COMMANDS, GROUPS, PARENTS, RENAMED
from mag_tracking.results.columns import DETECTIONS, FITS, POSES, SMOOTHED, names_of
from support.bundled import DATA, NETWORK_FILE, QUICK, parameter_file, vehicle_path
from support.cli_runs import NAME, quick_file, replay_one
from support.permissions import enforced_permissions


def test_replay_writes_all_documented_files(tmp_path, capsys):
    out = tmp_path / 'out'
    assert main(['replay', str(vehicle_path(NAME)), '--network', str(NETWORK_FILE), '--verbose',
                 '--out', str(out)]) == 0
    assert {p.name for p in out.iterdir()} == {
        'poses.csv', 'poses_smoothed.csv', 'detections.csv', 'disturbances.csv', 'hypotheses.csv',
        'summary.json', 'tracks.mcap', 'metadata.yaml', 'map_track_1.png', 'weights_track_1.png',
        'field_track_1.png', 'report.html'}
    head = (out / 'poses.csv').read_text().splitlines()[0]
    assert head == ('stamp_ns,track_id,x,y,z,vx,vy,vz,sd_x,sd_y,sd_z,sd_vx,sd_vy,sd_vz,'
                    'mx,my,mz,weight,ambiguous,kind,kind_weight,length,sd_length,doubts'
                    ) == ','.join(names_of(POSES))
    assert (out / 'poses_smoothed.csv').read_text().splitlines()[0] == ','.join(names_of(SMOOTHED))
    assert (out / 'detections.csv').read_text().splitlines()[0] == ','.join(names_of(DETECTIONS))
    track = json.loads((out / 'summary.json').read_text())['tracks'][0]
    assert track['arrival'] == 'left' and track['verdict'] == 'unique'
    assert {'speed', 'moment', 'poses', 'truth', 'smoothed', 'kind'} <= set(track)
    output = capsys.readouterr().out
    assert 'from left (100%), car (100%)' in output and 'replacing' not in output
    n = track['doubts']['another_arrival']
    assert f'ambiguous in {n} of {track["poses"]} poses' in output
    assert n == sum('another_arrival' in row for row in (out / 'poses.csv').read_text().split())


def test_replay_reports_replaced_results_and_follows_no_links(tmp_path, capsys):
    out, other_file = tmp_path / 'out', tmp_path / 'theirs'
    out.mkdir()
    other_file.write_text('- tracks.mcap\n')
    for name in ('poses.csv', 'summary.json', 'tracks.mcap', 'metadata.yaml', 'map_track_1.png'):
        (out / name).symlink_to(other_file)
    (out / 'field_track_7.png').write_text('of an earlier run')
    (out / 'notes.txt').write_text('mine')
    assert replay_one(out) == 0
    output = capsys.readouterr().out.splitlines()
    assert sum(line.endswith(f'run in {out}') for line in output) == 1
    assert other_file.read_text() == '- tracks.mcap\n' and (out / 'notes.txt').exists()
    assert not any(path.is_symlink() for path in out.iterdir())
    assert {path.name for path in out.glob('*.png')} == {
        f'{kind}_track_1.png' for kind in ('map', 'weights', 'field')}


def test_replay_warns_of_a_track_too_long_to_smooth(tmp_path, capsys):
    params = parameter_file(tmp_path / 'short.yaml', QUICK | {'track.max_smoothing_s': 1.0})
    assert main(['replay', str(vehicle_path(NAME)), '--network', str(NETWORK_FILE), '--params',
                 str(params), '--no-figures', '--out', str(tmp_path / 'out')]) == 0
    assert '1 track was' in capsys.readouterr().out
    assert len((tmp_path / 'out' / 'poses_smoothed.csv').read_text().splitlines()) == 1


def test_several_recordings_get_a_folder_each(tmp_path):
    names, out = ['straight_car_right', 'straight_small_left'], tmp_path / 'out'
    assert main(['replay', *(str(vehicle_path(n)) for n in names), '--network', str(NETWORK_FILE),
                 '--params', str(quick_file(tmp_path)), '--out', str(out), '--no-figures']) == 0
    assert sorted(p.name for p in out.iterdir()) == names


def test_a_magnet_table_is_imported_and_replayed(tmp_path, capsys):
    source = DATA / 'magnet_16_sensors'
    assert main(['import', str(source / 'lisa_data1.csv'), '--background',
                 str(source / 'lisa_data1_background.csv'), '--out', str(tmp_path / 'm')]) == 0
    assert main(['replay', str(tmp_path / 'm'), '--network', str(tmp_path / 'm/network.yaml'),
                 '--target', 'magnet', '--out', str(tmp_path / 'out')]) == 0
    assert json.loads((tmp_path / 'out' / 'summary.json').read_text())['tracks'][0]['poses'] == 63


def test_info_lists_topics_and_sensors(capsys):
    assert main(['info', str(vehicle_path(NAME)), '--network', str(NETWORK_FILE)]) == 0
    out = capsys.readouterr().out
    assert '/mag_1/imu/mag  sensor_msgs/msg/MagneticField  2000' in out
    assert 'sensor mag_2: /mag_2/imu/mag' in out


def fail(capsys, *arguments):
    """Run a command that must fail; return its error message of one line."""
    assert main([str(a) for a in arguments]) == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith('mag-tracking: ') and '\n' not in error
    return error


def test_errors_are_reported_in_one_line(tmp_path, capsys):
    common = ['--network', NETWORK_FILE, '--out', tmp_path / 'out']
    recording = vehicle_path(NAME)
    assert 'x.mcap' in fail(capsys, 'replay', tmp_path / 'x.mcap', *common)
    typo = tmp_path / 'typo.yaml'
    typo.write_text('track: {vehicle: {kinds: {car: {momnet: 3.0}}}}')
    assert 'mean track.vehicle.kinds.car.moment?' in fail(
        capsys, 'replay', recording, *common, '--params', typo)
    blocked = tmp_path / 'blocked'
    blocked.write_text('a file')
    assert str(blocked) in fail(capsys, 'replay', recording, '--network', NETWORK_FILE,
                                     '--out', blocked / 'out')
    network = tmp_path / 'network.yaml'
    network.write_text('sensors: {mag_7: {position: [0, 0, 0]}}')
    assert '/mag_1/' in fail(
        capsys, 'replay', recording, '--network', network, '--out', tmp_path / 'out')
    bad = tmp_path / 'bad.csv'
    bad.write_text('a,b\n1,2\n')
    assert 'column id' in fail(capsys, 'import', bad, '--background', bad,
                                          '--out', tmp_path / 'out')


@pytest.mark.parametrize('command', [
    'replay a\0b --network n.yaml --out out', 'replay a.mcap --network n.yaml --out a\0b',
    'calibrate network a.mcap --network a\0b --out c.yaml',
    'calibrate tumble a.mcap --network n.yaml --out a\0b',
    'calibrate board a\0b --moment 1 --out b.yaml', 'ros echo a\0b',
    'doctor a\0b --network n.yaml', 'fit a.mcap --network n.yaml --out a\0b',
    'plan --network n.yaml --out a\0b', 'listen a\0b', 'record --network n.yaml --out a\0b',
    'repair a\0b', 'run --network a\0b', 'info a\0b', 'import a\0b --background b --out out'])
def test_an_argument_with_a_nul_character_is_named(capsys, command):
    assert fail(capsys, *command.split()) == "mag-tracking: 'a\\x00b' contains a NUL character"


def test_a_read_only_folder_is_named(tmp_path, capsys):
    folder = tmp_path / 'theirs'
    folder.mkdir(mode=0o500)
    with enforced_permissions():
        error = fail(capsys, 'replay', vehicle_path(NAME), '--network', NETWORK_FILE,
                     '--out', folder / 'out')
    assert f'{folder / "out"}' in error and 'Permission denied' in error
    assert list(folder.iterdir()) == []


def test_replay_reports_a_recording_too_short_to_learn_a_background(tmp_path, capsys):
    params = tmp_path / 'p.yaml'
    params.write_text('calibrate: {learn_s: 600.0}')
    assert main(['replay', str(vehicle_path(NAME)), '--network', str(NETWORK_FILE), '--params',
                 str(params), '--out', str(tmp_path / 'out')]) == 0
    out = capsys.readouterr().out
    assert 'mag_1, mag_2' in out
    assert json.loads((tmp_path / 'out/summary.json').read_text())['tracks'] == []


def test_help_contains_an_example(capsys):
    text = subprocess.run([sys.executable, '-m', 'mag_tracking.cli', 'replay', '--help'],
                          capture_output=True, text=True, check=True).stdout
    assert 'example' in text
    for command in ('run', 'import'):
        with pytest.raises(SystemExit, match='0'):
            main([command, '--help'])
        assert 'example' in capsys.readouterr().out


def test_an_upside_down_sensor_is_named(tmp_path, capsys):
    network = tmp_path / 'turned.yaml'
    text, upright = NETWORK_FILE.read_text(), 'orientation: [0.0, 0.0, 0.0, 1.0]'
    assert text.count(upright) == 1
    network.write_text(text.replace(upright, 'orientation: [1.0, 0.0, 0.0, 0.0]'))
    assert main(['replay', str(vehicle_path('straight_car_right')), '--network', str(network),
                 '--out', str(tmp_path / 'out'), '--no-figures']) == 0
    assert 'orientation' in capsys.readouterr().out
    # A correct network causes no warning.
    assert replay_one(tmp_path / 'right', '--no-figures') == 0
    assert 'rotated' not in capsys.readouterr().out


def test_replay_prints_counts_in_the_singular(tmp_path, capsys):
    assert replay_one(tmp_path, '--no-figures') == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(re.fullmatch(r'\S+: \d+ frames, 1 detection, 1 track \(1 \w+\)', x)
               for x in lines), lines


def test_replay_reports_a_recording_without_targets(tmp_path, capsys):
    assert replay_one(tmp_path, '--no-figures', '--target', 'magnet') == 0
    assert 'a magnet' in capsys.readouterr().out


def test_replay_and_fit_print_a_row_per_vehicle(tmp_path, capsys):
    command = [str(vehicle_path('straight_car_right')), '--network', str(NETWORK_FILE),
               '--no-figures', '--out', str(tmp_path)]
    for arguments in (['replay', *command], ['fit', *command, '--orders', '1', '2']):
        assert main(arguments) == 0
        brief = capsys.readouterr().out
        assert 'verdict' in brief and len(re.findall(r'^  \w+ 1 +14:13:28.* unique$', brief,
                                                     re.M)) == 1, brief
        assert main([*arguments, '--verbose']) == 0
        assert len(capsys.readouterr().out) > 1.2 * len(brief)


def test_replay_writes_only_the_requested_tables_in_one_run(tmp_path, capsys):
    command = ['replay', str(vehicle_path('straight_car_right')), '--network', str(NETWORK_FILE),
               '--params', str(quick_file(tmp_path)), '--no-figures']
    assert main([*command, '--out', str(tmp_path / 'all'), '--tables',
                 'poses,passages,events,fits']) == 0
    printed = capsys.readouterr().out
    for part in ('1 track (1 unique)', 'straight_car_right: 1 vehicle', 'mag_1: 1 event', 'pass 1'):
        assert printed.count(part) == 1, printed
    assert json.loads((tmp_path / 'all/fits.json').read_text())['interrupted'] is False
    files = {p.name: p.read_bytes() for p in (tmp_path / 'all').iterdir()}
    assert {'poses.csv', 'passages.csv', 'intervals.csv', 'events.csv', 'signatures.csv',
            'fits.csv', 'fits.json'} <= {*files}
    for table, names in (('passages,fits', {'passages.csv', 'intervals.csv', 'passages.parquet',
                                            'intervals.parquet', 'fits.csv', 'fits.json'}),
                         ('events', {'events.csv', 'signatures.csv'})):
        out = tmp_path / table
        assert main([*command, '--tables', table, '--out', str(out)]) == 0
        assert {p.name for p in out.iterdir()} == names
        assert all((out / name).read_bytes() == files[name] for name in names
                   if not name.endswith('parquet'))


@pytest.mark.parametrize('options, message', [
    ([], 'add --out DIR'), (['--tables', 'fits'], 'add --out DIR'),
    (['--live', '--out', 'out'], '--live shows one recording and writes no files'),
    (['--live', '--rate', '0'], '--rate: expected a number above 0, got 0'),
    (['--out', 'out', '--fleet', 'fleet.json'], 'require --tables passages'),
    (['--tables', 'events', '--tum'], '--tables poses'), (['--live', '--tum'], 'writes no files'),
    (['--out', 'out', '--rate', '2'], '--rate requires')])
def test_replay_refuses_combinations_of_options(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    assert message in fail(capsys, 'replay', vehicle_path(NAME), '--network', NETWORK_FILE,
                           *options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize('command, message', [
    ('reply a.mcap', 'unknown command reply; did you mean replay?'),
    ('ros tpics', 'unknown command ros tpics; did you mean ros topics?'),
    ('ros a.mcap', 'unknown command ros a.mcap; expected topics, echo, param, lifecycle, watch'),
    ('calibrate a.mcap', 'calibrate is now: mag-tracking calibrate network'),
    *((name, f'{name} is now: mag-tracking {form}') for name, form in RENAMED.items()
      if name not in PARENTS)])
def test_an_unknown_command_is_answered_with_a_known_one(capsys, command, message):
    with pytest.raises(SystemExit, match='2'):
        main(command.split())
    assert capsys.readouterr().err == f'mag-tracking: {message}\n'


def test_the_commands_have_groups_and_former_commands_have_present_ones(capsys):
    top_level = {name.split()[0] for name in COMMANDS}
    assert {name for names in GROUPS.values() for name in names} == top_level
    assert len(top_level) == 14 and not top_level & {*RENAMED} - {*PARENTS}
    assert {form.split(' --')[0] for form in RENAMED.values()} <= {*COMMANDS}
    with pytest.raises(SystemExit, match='0'):
        main(['--help'])
    assert all(f'\n{group}:\n' in text for text in [capsys.readouterr().out] for group in GROUPS)


def test_the_example_runs():
    from support.bundled import ROOT
    out = subprocess.run([sys.executable, str(ROOT / 'examples/offline.py')], check=True,
                         capture_output=True, text=True).stdout
    assert 'left' in out and len(out.splitlines()) > 30


def test_the_demo_draws_a_track_over_topics(tmp_path):
    from support.bundled import ROOT
    out = subprocess.run([sys.executable, str(ROOT / 'examples/demo.py'), '--rate', '6',
                          '--out', str(tmp_path)], check=True, capture_output=True,
                         text=True, timeout=120).stdout
    assert 'from left' in out
    assert {'map_track_1.png', 'weights_track_1.png', 'field_track_1.png'} <= {
        p.name for p in tmp_path.iterdir()}


def test_fit_writes_all_documented_files(tmp_path, capsys):
    out = tmp_path / 'out'
    names = ['straight_car_fast_left', 'junction_right_turns_to_rear']
    out.mkdir()
    for link in ('fits.json', 'orders.png', f'{names[0]}_pass_1.png'):
        (out / link).symlink_to(tmp_path / 'elsewhere')
    assert main(['fit', *(str(vehicle_path(n)) for n in names), '--network', str(NETWORK_FILE),
                 '--orders', '1', '3', '--verbose', '--out', str(out)]) == 0
    assert {p.name for p in out.iterdir()} == {'fits.csv', 'fits.json', 'orders.png', 'report.html',
                                               *(f'{n}_pass_1.png' for n in names)}
    assert not (tmp_path / 'elsewhere').exists()
    lines = (out / 'fits.csv').read_text().splitlines()
    assert lines[0] == ','.join(names_of(FITS)) and len(lines) == 5
    content = json.loads((out / 'fits.json').read_text())
    assert content['iron'] is None and not content['interrupted']
    car, turn = content['fits'][1], content['fits'][3]
    assert car['chosen'] == 1 and abs(car['speed'] - 20.0) < 1.6 and not car['reason']
    assert 'constant velocity' in turn['reason'] and turn['speed'] is None
    text = capsys.readouterr().out
    assert 'a turn' in text and 'closest to' in text


def test_a_file_name_may_be_invalid_utf8(tmp_path):
    path = tmp_path / os.fsdecode(b'\xff$a$.mcap')
    path.write_bytes(vehicle_path('straight_car_right').read_bytes())
    process = subprocess.run(
        [sys.executable, '-m', 'mag_tracking.cli', 'fit', path, '--network', NETWORK_FILE,
         '--orders', '1', '--out', tmp_path / 'out'], capture_output=True, text=True, timeout=120,
        env={**os.environ, 'PYTHONIOENCODING': 'utf-8:strict'})
    assert process.returncode == 0, process.stderr
    assert '\\udcff$a$:\n' in process.stdout
    assert '\n\\udcff$a$,1,1,' in (tmp_path / 'out' / 'fits.csv').read_text()


def test_fit_of_a_single_pass_cannot_separate_hard_and_soft_iron(tmp_path, capsys):
    """The value `iron` in fits.json is null."""
    name = str(vehicle_path('straight_car_right'))
    assert main(['fit', name, '--network', str(NETWORK_FILE), '--orders', '3', '--same-vehicle',
                 '--no-figures', '--out', str(tmp_path)]) == 0
    assert 'separated' in capsys.readouterr().out
    assert json.loads((tmp_path / 'fits.json').read_text())['iron'] is None


def test_fit_with_one_sensor_writes_the_observable_values(tmp_path, capsys):
    network = tmp_path / 'one.yaml'
    network.write_text('sensors:\n  mag_1:\n    position: [0.0, -4.5, 0.0]\n')
    assert main(['fit', str(vehicle_path('straight_car_right')), '--network', str(network),
                 '--orders', '2', '--no-figures', '-v', '--out', str(tmp_path / 'out')]) == 0
    row, = json.loads((tmp_path / 'out' / 'fits.json').read_text())['fits']
    assert row['x'] is None and row['rate'] > 0.0 and row['sd_cpa_time'] > 0.0
    assert len(row['bearing']['motion']) == 3 and 'reversed' in row['bearing']['or_reversed']
    assert 'reversed' in capsys.readouterr().out


def test_fit_opens_all_recordings_before_it_writes(tmp_path, capsys):
    out = tmp_path / 'out'
    out.mkdir()
    (out / 'fits.csv').write_text('old')
    for names in (['nosuch'], [NAME, 'nosuch'], [NAME, NAME]):
        assert main(['fit', *(str(vehicle_path(n)) for n in names), '--network',
                     str(NETWORK_FILE), '--out', str(out)]) == 1
        assert (out / 'fits.csv').read_text() == 'old'
    assert f'named {NAME}' in capsys.readouterr().err


@pytest.mark.parametrize('options, text', [
    (['--orders', '0'], '--orders: '),
    (['--orders', '2', '2'], '--orders'),
    (['--cpa-range', '4', '1'], 'single sensor'),
])
def test_fit_refuses_invalid_options(tmp_path, capsys, options, text):
    assert main(['fit', str(vehicle_path(NAME)), '--network', str(NETWORK_FILE), *options,
                 '--out', str(tmp_path / 'out')]) == 1
    assert text in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
