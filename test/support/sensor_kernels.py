"""Compiled functions on the state of one sensor, callable from Python."""

import numpy as np
from numba import njit

from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.blocks import begin_block_if_due, collect
from mag_tracking.calibration.resolution import LONGEST_REST_NS
from mag_tracking.calibration.screening import is_stuck, screen_spike
from mag_tracking.calibration.sensor_state import new_sensors


@njit
def find_repetition(sensors, j, field):
    """`is_stuck` of sensor `j` of (n,) SENSOR."""
    return is_stuck(sensors[j], field)


@njit
def find_spike(sensors, j, threshold, stamp, field):
    """`screen_spike` of a reading without its own covariance."""
    return screen_spike(sensors[j], threshold, stamp, field, 0, np.empty((3, 3)), np.empty(3))


@njit
def _add(sensors, time, field):
    begin_block_if_due(sensors[0], time)
    collect(sensors[0], time, field)


class FedBackground(RunningBackground):
    """A background that is given its readings one by one, as the calibration does."""

    def __init__(self, *arguments, **named):
        self.sensors = new_sensors(1)
        super().__init__(*arguments, **named, sensors=self.sensors)

    def add(self, time, field):
        """Take a reading: `time` [s], `field` (3,) [T]."""
        self.judge_block()
        self.note(round(time * 1e9), field)
        self.collect(time, field)

    def collect(self, time, field):
        """Take a reading whose steps are noted."""
        self.judge_block()
        _add(self.sensors, time, np.array(field, dtype=float))
        if np.isnan(self.sensors[0]['phase']):
            self.judge_block()

    def note(self, stamp, raw):
        """`resolution.note_step` in plain Python."""
        s = self.sensors[0]
        for a in np.flatnonzero(~np.isnan(raw)):
            change = abs(raw[a] - s['raw'][a])
            if change <= 3e-7 * abs(raw[a]) and stamp >= s['rest_since_ns'][a]:
                s['n_rest'][a] += stamp - s['rest_since_ns'][a] <= LONGEST_REST_NS
                continue
            if change >= 0.0:
                s['n_same'][a] += s['n_rest'][a] - 1
                s['n_changed'][a] += 1
                s['step'][a] = min(s['step'][a], change)
            s['raw'][a], s['rest_since_ns'][a], s['n_rest'][a] = raw[a], stamp, 1
