"""Fixtures for the tests of web pages."""

import pytest

from mag_tracking.web.live_scene import LiveScene
from mag_tracking.web.page_server import PageServer
from support.browser import browser
from support.live_records import records_of


@pytest.fixture(scope='module')
def chromium():
    with browser() as opened:
        yield opened


@pytest.fixture(scope='module')
def records(road_network):
    """Frames and tracks of a recording, in chronological order."""
    return records_of('straight_car_right', road_network)


@pytest.fixture
def scene(road_network):
    return LiveScene('road', road_network)


@pytest.fixture
def server(scene):
    with PageServer(scene, port=0) as running:
        yield running
