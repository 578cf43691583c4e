"""Report page of a replay in headless Chromium: values, controls and robustness."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.apps.replay import replay
from mag_tracking.apps.replay_report import write_report
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.report.page import Note, Page, Table, report_html
from support.browser import Page as Opened
from support.browser import needs_browser
from support.bundled import QUICK, vehicle_path

pytestmark = needs_browser

RECORDING = 'junction_left_turns_to_rear'
MAX_PASS_MB = 2.0
"""Maximum size of the report of a pass of 14 s."""
MAX_MB = 4.0
"""Maximum size of a report, however many tracks it shows."""
MARKUP = '</script><script>window.broken = true</script><b>left</b>'


@pytest.fixture(scope='module')
def report(vehicle_replays, road_network):
    """Path of a report page, and the rows of its poses.csv."""
    run, folder = vehicle_replays[RECORDING]
    path = write_report(run, road_network, folder)
    with open(folder / 'poses.csv', newline='') as stream:
        return path, list(csv.DictReader(stream))


@pytest.fixture(scope='module')
def shared_page(chromium, report):
    """Page shared by several tests; each test must set the slider."""
    page = Opened(chromium, report[0].as_uri())
    page.wait('magTracking.drawn > 0')
    yield page
    page.page.close()


def column(rows, name):
    return np.array([float(row[name]) for row in rows])


def columns(page, name):
    return np.array(page.value(f'Array.from(magTracking.scene.tracks[0].columns.{name})'))


def test_poses_on_the_page_match_the_table(shared_page, report):
    rows = report[1]
    begin_ns = int(shared_page.value('magTracking.scene.begin_ns'))
    stamps = np.array([int(row['stamp_ns']) for row in rows])
    np.testing.assert_allclose(columns(shared_page, 't'), (stamps - begin_ns) / 1e9, atol=1e-9)
    for key, name in (('x', 'x'), ('y', 'y'), ('z', 'z'), ('vx', 'vx'), ('vy', 'vy')):
        np.testing.assert_array_equal(columns(shared_page, key), column(rows, name))
    for key, name in (('xx', 'sd_x'), ('yy', 'sd_y')):
        np.testing.assert_allclose(np.sqrt(columns(shared_page, key)), column(rows, name),
                                   rtol=1e-6)
    np.testing.assert_array_equal(columns(shared_page, 'ambiguous'), column(rows, 'ambiguous'))


def test_fields_weights_and_innovations_match_the_run(shared_page, vehicle_replays):
    log = vehicle_replays[RECORDING][0].logs[1]
    for j in range(2):
        for name in ('measured', 'predicted'):
            found = shared_page.value('magTracking.scene.tracks[0].fields'
                                      f'[{j}].{name}.map(axis => Array.from(axis))')
            np.testing.assert_allclose(np.array(found, dtype=float).T,
                                       np.array(getattr(log, name))[:, j], rtol=1e-6)
    for name in {name for row in log.arrivals for name in row}:
        found = shared_page.value(f'Array.from(magTracking.scene.tracks[0].arrivals.{name}.weight)')
        np.testing.assert_allclose(found, [row[name][0] if name in row else 0.0
                                           for row in log.arrivals], rtol=1e-6)
    per_axis = np.array(log.nis) / np.maximum(1, log.degrees_of_freedom)
    np.testing.assert_allclose(columns(shared_page, 'nis').astype(float), per_axis, rtol=1e-6)


def test_the_slider_updates_map_curves_and_text(shared_page, report):
    t = columns(shared_page, 't')
    for k in (0, len(t) // 2, len(t) - 1):
        shared_page.move_slider(t[k])
        row = report[1][k]
        np.testing.assert_allclose(shared_page.pose_on_map(), [float(row['x']), float(row['y'])])
        shared_page.wait(f'Math.abs(document.getElementById("speed").layout.shapes[0].x0 - {t[k]})'
                         ' < 1e-9')
        np.testing.assert_allclose(shared_page.line_times(), t[k])
        text = shared_page.value('document.getElementById("readout").textContent')
        assert f'x {float(row["x"]):.2f}, y {float(row["y"]):.2f}' in text
        assert ('ambiguous' in text) == (row['ambiguous'] == '1')


def test_buttons_cover_nothing_and_contact_no_other_origin(chromium, report):
    page = Opened(chromium, report[0].as_uri())
    page.wait('magTracking.drawn > 0')
    page.assert_complete()
    page.assert_private()
    page.page.close()


def visible_cards(page):
    """Names of the visible panels."""
    return set(page.value('''[...document.querySelectorAll('#scene .card[id]')]
        .filter(card => card.checkVisibility()).map(card => card.id.replace('-card', ''))'''))


def trace_with(page, plot, meta):
    """Points (2, n) of the trace of a plot with the given `meta`."""
    return np.array(page.value(f'''(d => [d.x, d.y])(document.getElementById('{plot}').data
        .find(d => d.meta === '{meta}'))'''), dtype=float)


def test_the_vehicle_is_drawn_to_scale_along_its_heading(shared_page, vehicle_replays):
    log = vehicle_replays[RECORDING][0].logs[1]
    for k in (20, 45):
        shared_page.move_slider((log.stamp_ns[k] - log.stamp_ns[0]) / 1e9)
        points = trace_with(shared_page, 'map', 'body')[:, :7] - log.position[k][:2, None]
        heading = log.velocity[k][:2] / np.hypot(*log.velocity[k][:2])
        along, across = heading @ points, np.array([-heading[1], heading[0]]) @ points
        # The recorded car is 4.3 m long and 1.75 m wide.
        assert np.ptp(along) == pytest.approx(4.3, abs=1.0)
        assert np.ptp(across) == pytest.approx(1.75, abs=0.1)
        np.testing.assert_allclose(across.min(), -across.max())


def test_time_marks_are_at_the_poses_of_their_times(shared_page, vehicle_replays):
    log = vehicle_replays[RECORDING][0].logs[1]
    shared_page.move_slider(3.0)
    found = trace_with(shared_page, 'map', 'time')
    texts = shared_page.value('''document.getElementById('map').data
        .find(d => d.meta === 'time').text''')
    assert len(texts) >= 4
    for text, x, y in zip(texts, *found, strict=True):
        position = np.array([np.interp(float(text.split()[0]), log.seconds(), axis)
                             for axis in np.array(log.position).T[:2]])
        assert np.hypot(*(position - [x, y])) < 0.5


def test_the_map_holds_the_vehicle_and_its_region(shared_page, vehicle_replays):
    log = vehicle_replays[RECORDING][0].logs[1]
    for k in np.flatnonzero(~np.array(log.ambiguous))[::8]:
        shared_page.move_slider((log.stamp_ns[k] - log.stamp_ns[0]) / 1e9)
        assert shared_page.is_within_map(['body', '90 % region'])


def test_a_report_of_one_vehicle_has_no_panel_of_other_targets(shared_page):
    assert visible_cards(shared_page) == {'map', 'field', 'weights', 'innovation', 'speed'}


def test_a_magnet_has_a_side_view(chromium, magnet_replays, magnet_runs, tmp_path):
    run, _ = magnet_replays[1]
    page = Opened(chromium, write_report(run, read_network(magnet_runs[1][1]),
                                         tmp_path).as_uri())
    page.wait('magTracking.drawn > 0')
    assert visible_cards(page) == {'map', 'side', 'field', 'innovation', 'speed'}
    log = run.logs[1]
    path = np.array(page.value('''(d => [d.x, d.y])(document.getElementById('side').data
        .find(d => d.name === 'smoothed'))'''))
    np.testing.assert_allclose(path, 1e3 * np.array(run.smoothed[1].position)[:, [0, 2]].T)
    k = len(log.stamp_ns) // 2
    page.move_slider((log.stamp_ns[k] - log.stamp_ns[0]) / 1e9)
    tail, tip = np.array(page.value('''(d => [d.x, d.y])(document.getElementById('side').data
        .find(d => d.name === 'moment'))''')).T
    direction = log.moment[k][[0, 2]] / np.linalg.norm(log.moment[k][[0, 2]])
    np.testing.assert_allclose((tip - tail) / np.hypot(*(tip - tail)), direction, atol=1e-5)
    page.assert_complete()
    assert page.page_errors == []
    page.page.close()


def test_all_controls_work_without_an_error(shared_page, report):
    t = columns(shared_page, 't')
    for share in np.linspace(0.0, 1.0, 7):
        shared_page.move_slider(t[0] + share * (t[-1] - t[0]))
    shared_page.page.select_option('#sensors', 'mag_2')
    shared_page.page.set_viewport_size({'width': 390, 'height': 800})
    # Playback from the end restarts at the beginning.
    shared_page.page.click('#play')
    shared_page.wait(f'magTracking.plays && magTracking.t < {t.mean()}')
    shared_page.page.click('#play')
    shared_page.wait('!magTracking.plays')
    shared_page.move_slider(t[0] + 0.8 * (t[-1] - t[0]))
    shared_page.page.click('#play')
    shared_page.wait('magTracking.plays')
    shared_page.wait(f'!magTracking.plays && magTracking.t >= {t[-1]}')
    assert shared_page.page_errors == []
    assert report[0].stat().st_size < MAX_PASS_MB * 1e6


def test_the_page_fits_the_width_of_a_phone(chromium, report):
    page = Opened(chromium, report[0].as_uri(), viewport={'width': 360, 'height': 740},
                  is_mobile=True, has_touch=True)
    page.wait('magTracking.drawn > 0')
    assert page.value('document.documentElement.scrollWidth') <= 360
    small = page.value('''[...document.querySelectorAll('p, td, th, li, h2, output, text')]
        .filter(e => e.textContent && e.getClientRects().length)
        .map(e => parseFloat(getComputedStyle(e).fontSize)).filter(size => size < 11)''')
    assert small == []
    page.page.close()


def test_the_table_selects_each_track(chromium, vehicle_replays, road_network, tmp_path):
    """The second track is a later copy of the first track at another position."""
    run, _ = vehicle_replays[RECORDING]
    later = second_track(run.logs[1])
    summary = {**run.summary, 'tracks': [*run.summary['tracks'],
                                         {**run.summary['tracks'][0], 'id': 2}]}
    two_tracks = replace(run, summary=summary, logs={1: run.logs[1], 2: later})
    page = Opened(chromium, write_report(two_tracks, road_network, tmp_path).as_uri())
    page.wait('magTracking.drawn > 0')
    shown = page.value('''[...new Set(document.getElementById('overview').data
        .flatMap(d => d.customdata || []))]''')
    assert shown == [1, 2]
    for track_id, log in ((2, later), (1, run.logs[1])):
        page.page.click(f'#tracks button:text-is("{track_id}")')
        page.wait(f'magTracking.current === {track_id}')
        assert page.value('document.querySelector("#tracks tr.chosen").cells[0].innerText') \
            == str(track_id)
        assert f'Track {track_id}:' in page.value('document.getElementById("readout").textContent')
        x, y = page.pose_on_map()
        assert np.hypot(*(np.array(log.position)[:, :2] - [x, y]).T).min() < 1e-9
    assert page.page_errors == []
    page.page.close()


def second_track(log):
    """Copy of a track log with id 2, one minute later and displaced by (1.0, 0.5, 0.0) m."""
    from copy import deepcopy

    later = deepcopy(log)
    later.id = 2
    later.stamp_ns = [stamp + 60_000_000_000 for stamp in log.stamp_ns]
    later.position = [p + [1.0, 0.5, 0.0] for p in log.position]
    return later


def test_markup_in_names_is_shown_literally(chromium, road_network, tmp_path):
    """Names of arrivals and files, which users choose, are not interpreted as HTML."""
    settings = settings_for('vehicle', QUICK | {
        'track.vehicle.arrival_names': [MARKUP, 'right', 'rear']})
    recording = Recording(vehicle_path('straight_small_left'))
    run = replay(recording, road_network, settings, tmp_path)
    run.summary['recording'] = MARKUP
    page = Opened(chromium, write_report(run, road_network, tmp_path).as_uri())
    page.wait('magTracking.drawn > 0')
    page.move_slider(0.0)
    assert page.value('window.broken === undefined')
    assert MARKUP in page.value('document.getElementById("title").textContent')
    assert page.value('document.querySelectorAll("b, .plot b").length') == 0
    assert MARKUP in page.value('document.getElementById("weights").textContent')
    assert page.page_errors == []
    page.page.close()


def test_notes_tables_and_missing_values_are_shown(chromium, tmp_path):
    path = tmp_path / 'page.html'
    path.write_text(report_html(Page(
        'nothing', notes=[Note('warning', 'nothing on <i>/mag_1</i>')],
        tables=[Table('Sensors', ['sensor', 'noise'], [['mag_1', None], ['mag_2', 12.3456]])])),
        encoding='utf-8')
    page = Opened(chromium, path.as_uri())
    assert page.value('document.getElementById("notes").innerText').strip() \
        == 'nothing on <i>/mag_1</i>'
    cells = page.value('[...document.querySelectorAll("td")].map(td => td.textContent)')
    assert cells == ['mag_1', '–', 'mag_2', '12.35']
    assert not page.value('document.getElementById("scene").checkVisibility()')
    assert page.page_errors == []
    page.page.close()


def test_a_report_of_very_many_poses_is_thinned_with_a_note(vehicle_replays, road_network,
                                                            tmp_path):
    """A report of 600 tracks stays below `MAX_MB`."""
    run, _ = vehicle_replays[RECORDING]
    n = 600
    logs = {}
    for k in range(1, n + 1):
        log = second_track(run.logs[1])
        log.id = k
        logs[k] = log
    entry = run.summary['tracks'][0]
    many = replace(run, summary={**run.summary, 'tracks': [{**entry, 'id': k} for k in logs]},
                   logs=logs, smoothed={})
    path = write_report(many, road_network, tmp_path)
    assert path.stat().st_size < MAX_MB * 1e6
    text = path.read_text(encoding='utf-8')
    data = json.loads(text.split('id="data">')[1].split('</script>')[0])
    assert any('per track' in note['text'] for note in data['notes'])
    assert len(data['scene']['tracks']) == n
