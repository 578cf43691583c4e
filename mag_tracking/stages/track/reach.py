"""Energy of a target's whitened field at the sensors, from the states of its track."""

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.inference.covariances import whitened_energy
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_filter import BankFilter
from mag_tracking.stages.track.relinearisation import Window

NEGLIGIBLE_ENERGY, WEAK_ENERGY = 0.1, 1.0
"""Squared norm of the whitened field per frame below which a target that moves away is removed
from a joint track. The larger limit applies if the track has the maximum number of targets. Up to
the larger limit, the field of a target does not disturb other targets."""

DETECTABLE_ENERGY = 4.0
"""Minimum squared norm of the whitened field of a detectable target. For a tracked vehicle, it
applies to the last frame. For a new vehicle, it applies to the sum over a window at each sensor.
For a path in a search, it applies to the energy in the window that the prior of the moments
predicts."""


def field_energies(bank_filter: BankFilter, target: int, state: FloatArray, frame: FieldFrame
                ) -> FloatArray:
    """Squared norm (n_sensors,) of the whitened field of a target of `state` (n_x,) at each
    sensor."""
    field = bank_filter.observation.field_of(state, [target], np.zeros(len(frame.field)))
    return whitened_energy(np.where(np.isnan(frame.field), np.nan, field), frame.covariance)[0]


def field_energy(bank_filter: BankFilter, target: int, state: FloatArray, frame: FieldFrame
                 ) -> float:
    """Squared norm of the whitened field of a target of `state` (n_x,), summed over all sensors."""
    return float(field_energies(bank_filter, target, state, frame).sum())


def first_weak_frame(bank_filter: BankFilter, target: int, window: Window | None, origin: int
                     ) -> int:
    """Index in the window of the frame after the last one in which the energy of a target exceeds
    `WEAK_ENERGY`; 0 without a window, or if it never does.

    `origin` selects the hypothesis whose path is used.
    """
    if window is None:
        return 0
    row = int(np.searchsorted(window.anchor.origin, origin))
    are_strong = [field_energy(bank_filter, target, path[row], frame) > WEAK_ENERGY
                  for path, frame in zip(window.paths, window.frames, strict=True)]
    return max((k for k, is_strong in enumerate(are_strong) if is_strong), default=-1) + 1
