"""Batch fits of several vehicles at once, and their assignment to the true vehicles."""

from typing import NamedTuple

import numpy as np

from mag_tracking.analysis.fitted_pass import FittedPass
from mag_tracking.apps.fit import fit
from mag_tracking.apps.readings import read_recording
from support.busy_recordings import BUSY, network_of_recording
from support.live_runs import fits_of

ORDERS = (1, 2, 3, 4)
MAX_ASSIGNMENT_M = 8.0
"""[m] Maximum distance of a fit from the vehicle that it is assigned to."""


class AssignedFit(NamedTuple):
    """Fit of a pass, and the true vehicle that it is assigned to."""

    fitted_pass: FittedPass
    vehicle: int
    speed: float
    """[m/s] True speed at the time of the strongest field."""
    error: float
    """[m] Horizontal error of the fitted position at that time."""


def fits_of_world(a_world, orders=ORDERS):
    """Fit all passes of a `World`; return [FittedPass]."""
    return fits_of(a_world.network, a_world.readings, orders)


def fits_of_recording(name, folder=BUSY, orders=ORDERS):
    """Fit a recording of several vehicles; return ([FittedPass], [AssignedFit])."""
    network = network_of_recording(name, folder)
    passes = fit(folder / f'{name}.mcap', network, orders=orders).passes
    truth = read_recording(folder / f'{name}.mcap', network).truth
    return passes, assigned_fits(passes, [
        (stamps / 1e9, position[:, :2]) for stamps, position, _ in truth.values()])


def assigned_fits(passes, vehicles):
    """Assign fits to vehicles [(t (n,) [s], positions (n, 2) [m])]; return [AssignedFit]."""
    candidates = []
    for i, one in enumerate(passes):
        fit = one.chosen
        if fit is None:
            continue
        time = fit.data.stamp_ns / 1e9
        for k, (t, position) in enumerate(vehicles):
            if not t[0] + 0.5 < time < t[-1] - 0.5:
                continue
            current, later, earlier = (np.array([np.interp(time + s, t, position[:, a])
                                                 for a in (0, 1)]) for s in (0.0, 0.2, -0.2))
            velocity = (later - earlier) / 0.4
            error = float(np.linalg.norm(fit.position[:2] - current))
            if error < MAX_ASSIGNMENT_M and velocity @ fit.velocity[:2] > 0.0:
                candidates.append((error, i, k, float(np.linalg.norm(velocity))))
    out, used = [], set()
    for error, i, k, speed in sorted(candidates):
        if ('fit', i) not in used and ('vehicle', k) not in used:
            used |= {('fit', i), ('vehicle', k)}
            out.append(AssignedFit(passes[i], k, speed, error))
    return out
