"""Searches of a window for vehicles without a track: samples, path prior and start grid."""

from functools import cached_property

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.stages.track.pass_samples import PassSamples
from mag_tracking.stages.track.relinearisation import Window
from mag_tracking.stages.track.steady_search import PathPrior, StartGrid, SteadySearch
from mag_tracking.stages.track.vehicle_state import VehicleState
from mag_tracking.stages.track.window_start import KnownVehicleHypothesis
from mag_tracking.units import NS

MAX_SAMPLES = 320
"""Maximum number of samples of a search. Windows with more samples are decimated."""

KNOWN_STD, KNOWN_MOMENT_RATIO = 0.7, 0.3
"""[m], [m/s] Standard deviation of the positions and velocities of tracked vehicles in a search,
and relative standard deviation of their moments."""


class WindowSearch:
    """Samples of a relinearisation window, prepared for searches for vehicles.

    Attributes
    ----------
    times : (n,) array, times of the frames relative to the last frame, s
    """

    def __init__(self, window: Window, vehicles: VehicleState) -> None:
        network, frames = vehicles.network, window.frames
        self._window, self._vehicles = window, vehicles
        self.times: FloatArray = np.array([(f.stamp_ns - frames[-1].stamp_ns) / NS
                                           for f in frames])
        step = -(-len(frames) * len(network) // MAX_SAMPLES)
        self._frame_indices = np.arange(len(frames))[::-1][::step][::-1]
        self.prior = PathPrior.of(vehicles.settings, network)
        self.samples = PassSamples.of(network, [frames[k] for k in self._frame_indices],
                                      frames[-1].stamp_ns, len(network))

    @cached_property
    def grid(self) -> StartGrid:
        """Grid of start paths for the searches in this window."""
        return StartGrid(self.samples, self.prior,
                         self.prior.starts(self._vehicles.settings, self._vehicles.network))

    def beside(self, known: KnownVehicleHypothesis) -> SteadySearch:
        """Search for a vehicle in addition to known vehicles."""
        samples = self.samples
        if known.filter is None:
            return SteadySearch(samples, self.prior, np.zeros(len(samples.y)), self._backgrounds())
        path, t = known.path[self._frame_indices], self.times[self._frame_indices]
        n, kind = len(path), np.array([known.kind])
        fields = [known.filter.fields_at(path[k], kind, self._window.frames[i],
                                         self._window.intervals[i])
                  for k, i in enumerate(self._frame_indices.tolist())]
        h, H = (np.array(part) for part in zip(*fields, strict=True))
        W = samples.M @ np.swapaxes(
            np.tile(self._vehicles.network.R_sw[samples.compared], (n, 1, 1)), 1, 2)
        h = h[:, samples.compared].reshape(-1, 3)
        columns = self._error_columns(H, path[-1], t, known.filter.observation.n_one)
        columns = columns[:, samples.compared].reshape(len(W), 3, -1)
        return SteadySearch(samples, self.prior, np.einsum('nij,nj->ni', W, h).ravel(),
                            np.hstack([self._backgrounds(), (W @ columns).reshape(3 * len(W), -1)]))

    def _backgrounds(self) -> FloatArray:
        """Whitened fields (3 n, q) of the backgrounds, each at one standard deviation."""
        return self._vehicles.background_std * self.samples.backgrounds

    def _error_columns(self, H: FloatArray, x: FloatArray, t: FloatArray, n_one: int) -> FloatArray:
        """Field errors (n, n_sensors, 3, q) due to one std of each position, velocity or moment of
        the known vehicles.

        `H` (n, n_sensors, 3, n_t) holds the derivatives of the fields with respect to the vehicle
        states. The times `t` (n,) [s] are relative to the end of the path; `x` (n_x,) is the state
        there.
        """
        out = []
        for first in range(0, H.shape[-1], n_one):
            H_one = H[..., first:first + n_one]
            H_velocity = H_one[..., 3:6] + t[:, None, None, None] * H_one[..., :3]
            hard = self._vehicles.hard_moments(x[first:first + n_one])
            H_moment = H_one[..., 6:6 + hard.size].reshape(*H_one.shape[:3], -1, 3).mean(axis=3)
            magnitude = float(np.linalg.norm(hard.sum(axis=0)))
            out += [KNOWN_STD * H_one[..., :3], KNOWN_STD * H_velocity,
                    KNOWN_MOMENT_RATIO * magnitude * H_moment]
        return np.concatenate(out, axis=3)
