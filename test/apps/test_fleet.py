"""Enrolled vehicles: enrolment from recordings, recognition, and invalid enrolments."""

import csv
import json

import numpy as np
import pytest

from mag_tracking.cli import main
from mag_tracking.inference.identification import UNKNOWN
from support.bundled import DATA, NETWORK_FILE, vehicle_path
from support.iron_passes import HARD, recorded

OTHER_HARD = [-x for x in HARD[:2]] + [HARD[2]]
"""Hard iron [A m²] of another vehicle, with the magnitude of `HARD`."""


@pytest.fixture(scope='module')
def recordings(tmp_path_factory):
    """{name: recording} of two vehicles, each heading east and west."""
    rng, folder, out = np.random.default_rng(7), tmp_path_factory.mktemp('fleet'), {}
    for name, heading, hard in (('van_east', 0.0, HARD), ('van_west', 180.0, HARD),
                                ('van_again', 0.0, HARD), ('other_east', 0.0, OTHER_HARD),
                                ('other_west', 180.0, OTHER_HARD),
                                ('other_again', 180.0, OTHER_HARD)):
        (folder / name).mkdir()
        out[name] = str(recorded(folder / name, heading, rng, hard))
    return out


def command(*arguments):
    return main(['replay', *arguments, '--network', str(NETWORK_FILE), '--tables', 'passages'])


def vehicles_of(folder):
    with open(folder / 'passages.csv', newline='') as stream:
        return [(r['recording'], r['vehicle']) for r in csv.DictReader(stream)]


def test_enrolled_vehicles_are_recognised(recordings, tmp_path, capsys):
    fleet = ['--fleet', str(tmp_path / 'fleet.json')]
    assert command(recordings['van_east'], recordings['van_west'], *fleet, '--enrol', 'van') == 0
    assert 'any heading (passes: 2)\n' in capsys.readouterr().out
    assert command(recordings['van_again'], recordings['other_east'], *fleet, '--out',
                   str(tmp_path / 'one')) == 0
    assert vehicles_of(tmp_path / 'one') == [('van_again', 'van'), ('other_east', UNKNOWN)]
    assert 'vehicle van' in capsys.readouterr().out
    for name in ('other_east', 'other_west'):
        assert command(recordings[name], *fleet, '--enrol', 'other') == 0
    printed = capsys.readouterr().out
    assert 'other' in printed and 'only (passes: 1)\n' in printed
    assert command(recordings['other_again'], recordings['van_again'], *fleet, '--out',
                   str(tmp_path / 'both')) == 0
    assert vehicles_of(tmp_path / 'both') == [('other_again', 'other'), ('van_again', 'van')]


def test_invalid_enrolments_are_reported(recordings, tmp_path, capsys):
    file = tmp_path / 'fleet.json'
    assert command(recordings['van_east'], '--enrol', 'van') == 1
    assert 'add --fleet' in capsys.readouterr().err
    for name in ('', '  ', UNKNOWN):
        assert command(recordings['van_east'], '--fleet', str(file), '--enrol', name) == 1
        assert f'--enrol: {name!r}' in capsys.readouterr().err
    assert command(str(DATA / 'two_way_road' / 'two_way_road_start.mcap'), '--fleet', str(file),
                   '--enrol', 'van') == 1
    assert 'but 0' in capsys.readouterr().err
    assert not file.exists()
    for text in ('{}', '[]', '{"mag_tracking.fleet": 1, "vehicles": {"a": [{"moment": [1]}]}}',
                 'nothing'):
        file.write_text(text)
        assert command(recordings['van_east'], '--fleet', str(file)) == 1
        assert 'fleet' in capsys.readouterr().err
    file.write_text(json.dumps({'mag_tracking.fleet': 1, 'vehicles': {'empty': []}}))
    assert command(recordings['van_east'], '--fleet', str(file)) == 1
    assert 'empty: ' in capsys.readouterr().err


def test_enrolment_requires_an_earth_field(tmp_path, capsys):
    network = tmp_path / 'network.yaml'
    network.write_text('sensors:\n  mag_1: {position: [0, -4.5, 0]}\n'
                       '  mag_2: {position: [0, 4.5, 0]}\n')
    assert main(['replay', str(vehicle_path('straight_car_right')), '--network', str(network),
                 '--tables', 'passages', '--fleet', str(tmp_path / 'f.json'), '--enrol',
                 'car']) == 1
    assert 'add earth_field' in capsys.readouterr().err
