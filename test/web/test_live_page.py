"""Live page in Chromium without ROS: values, reconnection and memory."""

from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.records import FieldFrame
from mag_tracking.report.page import ERROR, Note
from mag_tracking.web.live_scene import LiveScene
from mag_tracking.web.page_server import PageServer
from support.browser import Page as Opened
from support.browser import needs_browser
from support.live_records import feed, poses

SECOND_NS = 1_000_000_000


@needs_browser
def test_the_page_shows_all_tracked_poses(chromium, scene, server, records):
    """Poses published before and after the page is opened are shown."""
    half = len(records) // 2
    feed(scene, records[:half])
    page = Opened(chromium, server.url)
    page.wait('magTracking.connected && magTracking.scene?.tracks.length')
    feed(scene, records[half:])
    expected = poses(records)
    page.wait(f'magTracking.scene?.tracks[0]?.columns.t.length >= {len(expected)}')
    page.wait('magTracking.scene?.tracks[0]?.ended')
    for name, axis in (('x', 0), ('y', 1), ('z', 2)):
        np.testing.assert_array_equal(
            page.value(f'Array.from(magTracking.scene.tracks[0].columns.{name})'),
            [p.position[axis] for p in expected])
    begin_ns = int(page.value('magTracking.scene.begin_ns'))
    t = (expected[20].stamp_ns - begin_ns) / 1e9
    page.move_slider(t)
    np.testing.assert_allclose(page.pose_on_map(), expected[20].position[:2])
    assert not page.value('magTracking.follows')
    page.page.click('#latest')
    page.wait('magTracking.follows')
    assert page.page_errors == []
    page.page.close()


@needs_browser
def test_no_button_contacts_another_origin(chromium, scene, server, records):
    feed(scene, records)
    page = Opened(chromium, server.url)
    page.wait('magTracking.connected && magTracking.drawn > 0')
    page.assert_private()
    page.page.close()


@needs_browser
def test_the_map_keeps_an_extent_that_holds_the_vehicle(chromium, scene, server, records):
    """The extent changes at most once during a pass."""
    page, extents, n = Opened(chromium, server.url), [], 0
    page.wait('magTracking.connected')
    for record in records:
        feed(scene, [record])
        if isinstance(record, FieldFrame) or record.ended or record.ambiguous:
            continue
        page.wait(f'magTracking.latestDrawn === "{record.stamp_ns}"')
        assert page.is_within_map(['body', '90 % region'])
        extents.append(tuple(page.value('magTracking.scene.reach.map')))
        n += 1
    assert n > 10 and len(set(extents)) <= 2
    page.page.close()


@needs_browser
def test_fields_scroll_before_during_and_after_a_pass(chromium, scene, server, records):
    """The panels show the field of each frame, whether or not a target is tracked."""
    page = Opened(chromium, server.url)
    page.wait('magTracking.connected')
    frames = [r for r in records if isinstance(r, FieldFrame)]
    for n_s, with_track in ((-30, False), (-4, False), (0, True), (5, False), (30, False)):
        shown = records if with_track else [
            replace(f, stamp_ns=f.stamp_ns + n_s * SECOND_NS) for f in frames[-3:]]
        feed(scene, shown)
        last = [r for r in shown if isinstance(r, FieldFrame)][-1]
        page.wait(f'magTracking.latestDrawn === "{last.stamp_ns}"')
        t = (last.stamp_ns - int(page.value('magTracking.scene.begin_ns'))) / 1e9
        page.wait(f'''[...document.querySelectorAll('#field .plot')].every(plot =>
            Math.abs(plot.data[0].x.at(-1) - {t}) < 1e-6
            && plot.layout.xaxis.range[0] <= {t} && {t} <= plot.layout.xaxis.range[1])''')
        assert page.value(f'''Math.min(...[...document.querySelectorAll('#field .plot')]
            .map(plot => plot.data[0].x[0])) >= {t} - 20.001''')
    page.assert_complete()
    assert page.page_errors == []
    page.page.close()


@needs_browser
def test_a_phone_shows_map_and_curves_without_scrolling(chromium, scene, server, records):
    feed(scene, records)
    page = Opened(chromium, server.url, viewport={'width': 390, 'height': 844}, is_mobile=True,
                  has_touch=True)
    page.wait('magTracking.connected && document.querySelector("#field .plot .main-svg")')
    bottom = page.value('document.getElementById("time").getBoundingClientRect().top')
    for selector in ('#map', '#field .plot'):
        box = page.value(f'document.querySelector("{selector}").getBoundingClientRect().toJSON()')
        assert 0 <= box['top'] and box['bottom'] <= bottom, selector
    assert page.value('document.querySelectorAll(".modebar-btn").length') == 0
    page.page.close()


@needs_browser
def test_the_page_reconnects_after_a_restart_of_the_server(chromium, road_network, records):
    first = LiveScene('before', road_network)
    with PageServer(first, port=0) as server:
        port = server.port
        feed(first, records)
        page = Opened(chromium, server.url)
        page.wait('magTracking.connected && magTracking.scene?.tracks.length === 1')
    page.wait('!magTracking.connected')
    assert 'lost' in page.value('document.getElementById("connection").textContent')
    second = LiveScene('after', road_network)
    with PageServer(second, port=port):
        page.wait('magTracking.connected && document.title && '
                  'document.getElementById("title").textContent === "after"')
        assert page.value('magTracking.scene.tracks.length') == 0
        feed(second, records)
        page.wait('magTracking.scene?.tracks.length === 1')
        page.page.close()


@needs_browser
def test_markup_in_health_notes_is_shown_literally(chromium, scene, server):
    markup = '<img src=x onerror="window.broken = true">'
    scene.set_health([Note(ERROR, markup)], [])
    page = Opened(chromium, server.url)
    page.wait('document.getElementById("notes").children.length')
    assert page.value('document.getElementById("notes").textContent') == markup
    assert page.value('window.broken === undefined')
    page.page.close()


@needs_browser
def test_a_target_that_stays_for_hours_needs_bounded_memory(chromium, scene, server, records):
    """The poses in the browser and the snapshot of the server are bounded."""
    template = [r for r in records if isinstance(r, FieldFrame)][-1]
    pose, stamp = poses(records)[30], template.stamp_ns

    def publish_poses(n):
        nonlocal stamp
        for _ in range(n):
            stamp += SECOND_NS // 10
            scene.add_frame(replace(template, stamp_ns=stamp))
            scene.add_track(replace(pose, stamp_ns=stamp))

    publish_poses(8_500)
    page = Opened(chromium, server.url)
    page.wait('magTracking.connected && magTracking.scene?.tracks.length')
    for _ in range(2):
        publish_poses(1_000)
        page.wait(f'magTracking.scene.latestNs === "{stamp}"')
        assert page.value('magTracking.scene.tracks[0].columns.t.length') <= 8_000
    last = page.value('(t => t[t.length - 1])(magTracking.scene.tracks[0].columns.t)')
    begin_ns = int(page.value('magTracking.scene.begin_ns'))
    assert last == pytest.approx((stamp - begin_ns) / SECOND_NS)
    lengths = page.value("""(track => [...Object.values(track.columns), track.doubts,
        ...track.fields.flatMap(f => [...f.measured, ...f.predicted]),
        ...Object.values(track.arrivals).flatMap(Object.values)].map(v => v.length))
        (magTracking.scene.tracks[0])""")
    assert len(set(lengths)) == 1
    assert sum(len(message) for message in scene.snapshot()) < 10_000_000
    assert page.page_errors == []
    page.page.close()
