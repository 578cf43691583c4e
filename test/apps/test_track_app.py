"""Selection of a track in a result."""

import pytest

import mag_tracking as mt
from support.bundled import NETWORK_FILE, QUICK, vehicle_path


def test_an_unknown_track_is_reported_with_the_tracks_of_the_result():
    result = mt.track(vehicle_path('straight_car_right'), NETWORK_FILE, settings=QUICK)
    assert result.errors(1) == result.errors()
    with pytest.raises(mt.UnknownTrackError,
                       match='^track 7 .*: 1$'):
        result.errors(7)
    result.tracks.clear()
    for track_id in (None, 1):
        with pytest.raises(mt.UnknownTrackError, match='no tracks'):
            result.errors(track_id)
