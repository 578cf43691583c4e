"""Whether the sensors feel a target, by the states of its track."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.axes import whitened_energy
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.relinearisation import Window

UNFELT, FAINT = 0.1, 1.0
"""A target whose field has less energy than this in a frame, in units of its noise, is not felt;
and with less than that it does not disturb others."""

DETECTABLE_ENERGY = 4.0
"""Least energy, in units of its noise, of a field that is felt: in the last frame, of a vehicle
that is sought again; in all frames of a window, by one sensor; in all frames at all sensors, as
expected from what is known of its moments, of a vehicle that is sought at all."""


def energies_of(bank_filter: BankFilter, target: int, state: FloatArray, frame: FieldFrame
                ) -> FloatArray:
    """(n_sensors,) energy of the field of a target of a state (n_x,) in a frame, in units of its
    noise."""
    field = bank_filter.observation.field_of(state, [target], np.zeros(len(frame.field)))
    return whitened_energy(np.where(np.isnan(frame.field), np.nan, field), frame.covariance)[0]


def energy_of(bank_filter: BankFilter, target: int, state: FloatArray, frame: FieldFrame) -> float:
    """As `energies_of`, of all sensors together."""
    return float(energies_of(bank_filter, target, state, frame).sum())


def weak_from(bank_filter: BankFilter, target: int, window: Window | None, origin: int) -> int:
    """The frame of a window from which on a target is hardly felt, by the path of a hypothesis."""
    if window is None:
        return 0
    row = int(np.searchsorted(window.anchor.origin, origin))
    felt = [energy_of(bank_filter, target, path[row], frame) > FAINT
            for path, frame in zip(window.paths, window.frames, strict=True)]
    return max((k for k, is_felt in enumerate(felt) if is_felt), default=-1) + 1
