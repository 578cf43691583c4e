"""Recordings for archives, and the archive of them."""

import pytest

from mag_tracking.apps.archive import archive
from mag_tracking.pipeline import settings_for
from support.archives import archive_recordings
from support.bundled import NETWORK_FILE, QUICK


@pytest.fixture(scope='session')
def recordings(tmp_path_factory):
    """A folder of three recordings and a file that is no recording."""
    return archive_recordings(tmp_path_factory.mktemp('recordings'))


@pytest.fixture(scope='session')
def whole(tmp_path_factory, recordings):
    """The archive that nobody interrupted."""
    out = tmp_path_factory.mktemp('whole') / 'out'
    archive([recordings], NETWORK_FILE, settings_for('vehicle', QUICK), out)
    return out
