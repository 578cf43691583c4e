"""Reports of fit, plan, calibrate and doctor in headless Chromium."""

import csv
import json

import numpy as np
import pytest
import yaml

from mag_tracking.cli import main
from mag_tracking.messages.types import MAGNETIC_FIELD
from mag_tracking.recording.writer import RecordingWriter
from support.browser import Page as Opened
from support.browser import needs_browser
from support.bundled import NETWORK_FILE, vehicle_path
from support.samples import field_dict

pytestmark = needs_browser

RECORDINGS = [vehicle_path('straight_car_right'), vehicle_path('straight_small_left')]


def run(*arguments):
    return main([*map(str, arguments), '--network', str(NETWORK_FILE)])


def open_page(chromium, path):
    page = Opened(chromium, path.as_uri())
    page.wait('document.querySelectorAll(".plot .main-svg").length')
    return page


def check_and_close(page):
    """Check that the page is complete, logged no error and contacts no other origin; close it."""
    page.assert_complete()
    page.assert_private()
    assert page.page_errors == []
    page.page.close()


def test_a_fit_report_shows_the_paths_of_its_table(chromium, tmp_path):
    assert run('fit', *RECORDINGS, '--out', tmp_path, '--no-figures') == 0
    with open(tmp_path / 'fits.csv', newline='') as stream:
        chosen = [row for row in csv.DictReader(stream) if row['chosen'] == '1']
    path = tmp_path / 'report.html'
    page = open_page(chromium, path)
    assert page.value('magTracking.scene.tracks.length') == len(chosen) == 2
    for k, row in enumerate(chosen):
        columns = f'magTracking.scene.tracks[{k}].columns'
        x, y, vx, vy = (np.array(page.value(f'Array.from({columns}.{name})'))
                        for name in ('x', 'y', 'vx', 'vy'))
        np.testing.assert_allclose(vx, float(row['vx']))
        np.testing.assert_allclose(vy, float(row['vy']))
        # The table contains the position at the strongest field, which is on the straight path.
        d = [float(row['x']) - x[0], float(row['y']) - y[0]]
        assert abs(d[0] * vy[0] - d[1] * vx[0]) / np.hypot(vx[0], vy[0]) < 1e-6
    begin, end = page.value('(t => [t[0], t[t.length - 1]])(magTracking.scene.tracks[1].columns.t)')
    page.move_slider(0.5 * (begin + end))
    page.wait('magTracking.current === 2')
    assert 'Track 2' in page.value('document.getElementById("readout").textContent')
    assert not page.value('document.getElementById("weights-card").checkVisibility()')
    check_and_close(page)


def test_a_plan_report_shows_its_maps(chromium, tmp_path, capsys):
    assert run('plan', '--target', 'car', '--grid', 15, '--out', tmp_path) == 0
    lines = capsys.readouterr().out.splitlines()
    path = tmp_path / 'report.html'
    page = open_page(chromium, path)
    maps = page.value('''[...document.querySelectorAll('#charts .plot')]
        .map(p => p.data.find(d => d.type === 'heatmap')).filter(Boolean).map(d => d.z)''')
    assert len(maps) == 3
    plan = json.loads((tmp_path / 'plan.json').read_text())
    np.testing.assert_allclose(maps[1], plan['detection'], atol=1e-6)
    bound = np.log10(np.minimum(plan['position_std'], np.ptp(plan['x'])))
    np.testing.assert_allclose(np.array(maps[0], dtype=float), bound, atol=1e-4)
    notes = page.value('[...document.querySelectorAll("#notes li")].map(e => e.textContent)')
    assert notes == [line.strip() for line in lines[:-1]]
    check_and_close(page)


def test_a_calibration_report_shows_each_sensor(chromium, tmp_path):
    path = tmp_path / 'found.html'
    assert run('calibrate', 'network', RECORDINGS[0], '--out', tmp_path / 'network.yaml',
               '--report', path) == 0
    page = open_page(chromium, path)
    cells = page.value('[...document.querySelectorAll("tbody tr")].map(r => r.cells[0].innerText)')
    assert cells == ['mag_1', 'mag_2']
    titles = page.value('[...document.querySelectorAll("#charts h2")].map(e => e.innerText)')
    assert 'First knock, corrected clocks' in titles
    check_and_close(page)


def test_the_doctor_report_shows_its_findings(chromium, tmp_path, capsys):
    path = tmp_path / 'health.html'
    assert run('doctor', RECORDINGS[0], '--report', path) == 0
    assert 'no faults' in capsys.readouterr().out
    page = open_page(chromium, path)
    assert page.value('document.getElementById("notes").innerText').strip().startswith('no faults')
    check_and_close(page)


def test_a_plan_report_keeps_the_digits_of_large_coordinates(chromium, tmp_path):
    """UTM coordinates, with seven digits before the decimal point, keep their resolution."""
    network = yaml.safe_load(NETWORK_FILE.read_text())
    for sensor in network['sensors'].values():
        sensor['position'][0] += 6_500_000.0
    network_file = tmp_path / 'far.yaml'
    network_file.write_text(yaml.safe_dump(network))
    assert main(['plan', '--target', 'car', '--grid', '15', '--out', str(tmp_path),
                 '--network', str(network_file)]) == 0
    path = tmp_path / 'report.html'
    page = open_page(chromium, path)
    x = page.value('document.querySelector("#charts .plot").data.find(d => d.type === "heatmap").x')
    np.testing.assert_allclose(x, json.loads((tmp_path / 'plan.json').read_text())['x'], rtol=1e-9)
    assert len(set(x)) == len(x)
    check_and_close(page)


@pytest.mark.parametrize('arguments', [
    ('doctor', RECORDINGS[0], '--report', 'the recording'),
    ('doctor', RECORDINGS[0], '--report', 'found.txt')])
def test_a_report_replaces_no_other_file(tmp_path, capsys, arguments):
    recording = tmp_path / 'recording.mcap'
    recording.write_bytes(RECORDINGS[0].read_bytes())
    report = recording if arguments[-1] == 'the recording' else tmp_path / arguments[-1]
    assert run('doctor', recording, '--report', report) == 1
    assert '.html' in capsys.readouterr().err
    assert recording.read_bytes() == RECORDINGS[0].read_bytes()


def test_a_network_named_like_a_page_is_not_replaced(tmp_path, capsys):
    network = tmp_path / 'network.html'
    network.write_text(NETWORK_FILE.read_text())
    assert main(['doctor', str(RECORDINGS[0]), '--network', str(network),
                 '--report', str(network)]) == 1
    assert 'is also' in capsys.readouterr().err
    assert network.read_text() == NETWORK_FILE.read_text()


def test_the_doctor_reports_on_a_single_reading(chromium, tmp_path):
    recording, path = tmp_path / 'short.mcap', tmp_path / 'health.html'
    with RecordingWriter(recording) as writer:
        writer.write('/mag_1/imu/mag', MAGNETIC_FIELD,
                     field_dict(1_790_000_000_000_000_000, 'mag_1', np.array([2e-6, 1e-5, -4e-5])),
                     1_790_000_000_000_000_000)
    assert run('doctor', recording, '--report', path) == 2
    page = open_page(chromium, path)
    assert 'Error' in page.value('getComputedStyle(document.querySelector("#notes .error"), '
                                 '"::before").content')
    check_and_close(page)


@pytest.mark.parametrize('where', ['missing/health.html', 'folder.html'])
def test_an_unwritable_report_is_reported_before_the_computation(tmp_path, capsys, where):
    (tmp_path / 'folder.html').mkdir()
    assert run('doctor', RECORDINGS[0], '--report', tmp_path / where) == 1
    out = capsys.readouterr()
    assert 'cannot write' in out.err and out.out == ''
