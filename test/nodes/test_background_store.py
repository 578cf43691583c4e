"""The background file is written as soon as a background is known, and then at intervals."""

import json
from dataclasses import replace

import numpy as np
from rclpy.logging import get_logger

from mag_tracking.nodes.sensor_rounds import BackgroundStore
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.settings import CalibrateSettings
from support.networks import line_network
from support.samples import MagSample, one


def test_a_background_is_stored_as_soon_as_it_is_known(tmp_path):
    network = replace(line_network(2), background=(np.zeros(3),) * 2,
                      noise_std=(np.full(3, 1e-8),) * 2)
    path, settings = tmp_path / 'backgrounds.json', CalibrateSettings()
    stage = Calibrate(network, settings)
    store = BackgroundStore(path, stage, settings, get_logger('test'))

    def stored():
        for j in range(2):
            store.update(network, j)
        store.write_if_due(True)
        return path.exists() and {name: entry['stamp_ns'] for name, entry in json.loads(
            path.read_text())['sensors'].items()}

    assert stored() == {}
    stage.feed(one(MagSample(10**18, 'mag_1', np.full(3, 1e-8))))
    assert stored() == {'mag_1': 10**18}
    # A further reading of a sensor causes no write; the first reading of another sensor does.
    stage.feed(one(MagSample(10**18 + 10**7, 'mag_1', np.full(3, 2e-8))))
    assert stored() == {'mag_1': 10**18}
    stage.feed(one(MagSample(10**18, 'mag_2', np.full(3, 1e-8))))
    assert stored() == {'mag_1': 10**18 + 10**7, 'mag_2': 10**18}
