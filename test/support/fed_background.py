"""Background that accepts individual readings, as in the calibration stage."""

from functools import partial

import numpy as np

from mag_tracking.calibration import core
from mag_tracking.calibration.background import RunningBackground
from mag_tracking.calibration.level_change import SharedChanges
from mag_tracking.calibration.sensor_state import new_sensors


class FedBackground(RunningBackground):
    """`RunningBackground` that accepts individual readings."""

    def __init__(self, *arguments, **named):
        self.sensors = new_sensors(1)
        named.setdefault('evaluate_change', partial(SharedChanges().evaluate_change, 0))
        super().__init__(*arguments, **named, sensors=self.sensors)

    def add(self, time, field):
        """Add a reading: `time` [s], `field` (3,) [T]."""
        self.evaluate_block()
        self.note(round(time * 1e9), field)
        self.collect(time, field)

    def collect(self, time, field):
        """Add a reading that `note` has already evaluated for quantisation steps."""
        self.evaluate_block()
        core.collect(self.sensors, time, np.array(field, dtype=float))
        if np.isnan(self.sensors[0]['phase']):
            self.evaluate_block()

    def note(self, stamp, raw):
        """Update the quantisation steps with a raw reading; Python version of `core.note_step`."""
        s = self.sensors[0]
        for a in np.flatnonzero(~np.isnan(raw)):
            change = abs(raw[a] - s['raw'][a])
            if change <= 3e-7 * abs(raw[a]) and stamp >= s['rest_since_ns'][a]:
                s['n_rest'][a] += stamp - s['rest_since_ns'][a] <= core.MAX_REST_NS
                continue
            if change >= 0.0:
                s['n_same'][a] += s['n_rest'][a] - 1
                s['n_changed'][a] += 1
                s['step'][a] = min(s['step'][a], change)
            s['raw'][a], s['rest_since_ns'][a], s['n_rest'][a] = raw[a], stamp, 1
