"""Recordings for archive tests, and an archive of these recordings."""

import pytest

from mag_tracking.apps.archive import archive
from mag_tracking.pipeline import settings_for
from support.archives import archive_recordings
from support.bundled import NETWORK_FILE, QUICK


@pytest.fixture(scope='session')
def recordings(tmp_path_factory):
    """Folder of three recordings and an invalid file."""
    return archive_recordings(tmp_path_factory.mktemp('recordings'))


@pytest.fixture(scope='session')
def complete_archive(tmp_path_factory, recordings):
    """Archive of an uninterrupted run."""
    out = tmp_path_factory.mktemp('complete') / 'out'
    archive([recordings], NETWORK_FILE, settings_for('vehicle', QUICK), out)
    return out
