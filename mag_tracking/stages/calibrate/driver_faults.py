"""Faults of drivers, searched in the latest raw readings of each sensor."""

from dataclasses import replace

import numpy as np

from mag_tracking.arrays import StructArray
from mag_tracking.calibration import core
from mag_tracking.calibration.missing_marks import are_marked, describe_marks
from mag_tracking.calibration.reading_faults import ReadingFaults, reading_faults
from mag_tracking.calibration.sensor_state import FIRST_WINDOW, N_WINDOW
from mag_tracking.stages.health.diagnosis import Cause
from mag_tracking.units import NS


class DriverFaults:
    """Marks for missing readings, and repetitions, in the readings of several sensors.

    Parameters
    ----------
    sensors : (n,) SENSOR array
        State of the sensors. The compiled code leaves out the faults that are stored there.
    """

    def __init__(self, sensors: StructArray) -> None:
        self._sensors = sensors
        # Rate of the readings of each sensor [Hz] when its faults were found.
        self._rates = np.full(len(sensors), np.nan)

    def of(self, i: int) -> ReadingFaults:
        """Return the faults of sensor `i` that have been found so far.

        Parameters
        ----------
        i : int

        Returns
        -------
        ReadingFaults
        """
        s = self._sensors[i]
        return ReadingFaults(s['marks'][:s['n_marks']].copy(), float(s['repetition']),
                             float(self._rates[i]))

    def store(self, i: int, faults: ReadingFaults) -> None:
        """Leave out faults of sensor `i` from now on.

        Parameters
        ----------
        i : int
        faults : ReadingFaults
        """
        s, self._rates[i] = self._sensors[i], faults.rate
        s['n_marks'], s['marks'][:len(faults.marks)] = len(faults.marks), faults.marks
        s['repetition'] = faults.repetition
        # The steps and repetitions so far are those of the faults.
        s['step'] = np.inf
        s['n_same'] = s['n_changed'] = s['n_rest'] = 0
        s['repeats'] = s['changes'] = s['run'] = 0

    def examine(self, i: int, stamp_ns: int) -> float:
        """Search the latest raw readings of sensor `i`.

        Parameters
        ----------
        i : int
        stamp_ns : int, ns
            Timestamp of the first reading after the window.

        Returns
        -------
        float
            Fraction of the readings in the window with a mark if a fault was found and stored; NaN
            otherwise.
        """
        s, n = self._sensors[i], int(self._sensors[i]['n_window'])
        known = self.of(i)
        faults = known.merged(reading_faults(s['window'][:n]))
        if n < N_WINDOW:
            s['window_due'] += FIRST_WINDOW
        else:
            s['n_window'] = 0
        if faults == known:
            return float('nan')
        duration_s = (stamp_ns - int(s['window_begin_ns'])) / NS
        self.store(i, replace(faults, rate=n / duration_s if duration_s > 0.0 else float('nan')))
        return float(are_marked(s['window'][:n], faults.marks).any(axis=1).mean())

    def rejection(self, i: int, reason: int) -> tuple[Cause, str]:
        """Cause and description of the rejection of a reading of sensor `i`.

        Parameters
        ----------
        i : int
        reason : int
            MARKED or REPEATED.

        Returns
        -------
        cause : Cause
        description : str
            With the marks, or with the rates.
        """
        faults = self.of(i)
        if reason == core.MARKED:
            return (Cause.NO_READING_MARK,
                    f'mark for a missing reading: {describe_marks(faults.marks)}')
        return Cause.REPEATED, (
            f'repetition: measured at {faults.rate / faults.repetition:.3g} Hz, published at '
            f'{faults.rate:.3g} Hz')
