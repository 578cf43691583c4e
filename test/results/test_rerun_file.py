"""Recordings for the Rerun viewer."""

import importlib.util

import numpy as np
import pytest

from mag_tracking.cli import main
from mag_tracking.results.track_files import RERUN_FILE, write_rerun
from support.bundled import NETWORK_FILE, vehicle_path

NAME = 'straight_small_left'


def test_a_missing_rerun_sdk_is_reported_before_the_replay(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr('mag_tracking.results.track_files.find_spec', lambda _: None)
    assert main(['replay', str(vehicle_path(NAME)), '--network', str(NETWORK_FILE), '--rerun',
                 '--out', str(tmp_path / 'out')]) == 1
    assert 'rerun-sdk' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


@pytest.mark.skipif(importlib.util.find_spec('rerun') is None, reason='rerun-sdk is not installed')
def test_the_poses_in_the_file_equal_the_track(tmp_path, vehicle_replays, road_network):
    from rerun.chunk import RrdReader

    run, _ = vehicle_replays[NAME]
    write_rerun(tmp_path / RERUN_FILE, road_network, run.logs, run.smoothed)
    found = {}
    for chunk in RrdReader(str(tmp_path / RERUN_FILE)).stream():
        if chunk.entity_path == '/map/track_1/pose':
            batch = chunk.to_record_batch()
            found |= {stamp.value: points[0] for stamp, points in zip(
                batch['stamp'], batch['Points3D:positions'].to_pylist(), strict=True)}
    log = run.logs[1]
    np.testing.assert_allclose([found[ns] for ns in log.stamp_ns], log.position, atol=1e-4)
