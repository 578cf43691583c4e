"""Track: a bank of extended Kalman filters, from a detection to its release.

Source: ICASSP11 section 2, T10 Alg. 2 and 3; PHD15 Paper A for the magnet.
"""

from collections import Counter, deque
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise

import numpy as np

from mag_tracking.errors import SettingsError
from mag_tracking.inference import kalman
from mag_tracking.physics.dipole import sensor_fields
from mag_tracking.physics.mounting import turned_fields
from mag_tracking.settings import param
from mag_tracking.stages.magnet_start import MagnetSettings, magnet_model, start_magnet
from mag_tracking.stages.pose import magnet_orientation, published_track, vehicle_orientation
from mag_tracking.stages.stage import NS
from mag_tracking.stages.vehicle_start import VehicleSettings, start_vehicle, vehicle_model

SAME_TIME_S = 1e-3
"""[s] Samples closer than this are taken together: at 20 m/s a target moves two centimetres."""


ONE_TIME = 0.05
"""A frame that is shorter than this share of the time since the frame before is one time, and so
is the first of a track: velocities are better learnt from frame to frame than within one."""


@dataclass(frozen=True)
class TrackSettings:
    """Settings of the tracker."""

    target: str = param('vehicle', 'What moves: vehicle or magnet.')
    near_field_length: float = param(
        1.0, 'Length of the target: the noise near it grows by the first neglected multipole '
        'term (ICASSP11 eq. (9), there lambda).', 'm', (0.0, 1000.0), live=True)
    field_error: float = param(
        0.04, 'Error of the predicted field relative to its size: gains, axes, shape.',
        '', (0.0, 10.0), live=True)
    model_error_time_s: float = param(
        0.1, 'Model errors stay alike for so long: at a shorter frame period they count once, '
        'not once a frame (their variance is multiplied by this time over the period).',
        's', (0.0, 60.0), live=True)
    background_std: float = param(
        2e-8, 'What a background may be off by when a track starts.', 'T', (0.0, 1e-3), live=True)
    background_drift: float = param(
        1e-8, 'Random walk of a background during a track.', 'T/s^0.5', (0.0, 1e-3), live=True)
    mounting_std_deg: float = param(
        5.0, 'How far a sensor may be turned from its orientation in the network file, about '
        'each axis; the angles are estimated with each track (to first order: at 15 degrees the '
        'field is 3 % too long). 0 = as the file says; with dozens of sensors that is several '
        'times faster.',
        'deg', (0.0, 15.0))
    iterations: int = param(
        1, 'Linearisations an update: more than one helps when the field says far more than the '
        'prediction (magnets); for vehicles it locks into the wrong side.', '', (1, 20), live=True)
    prune_ratio: float = param(
        1e-12, 'A hypothesis lighter than the heaviest by this ratio is dropped (T10 Alg. 3).',
        '', (1e-300, 0.5), live=True)
    most_hypotheses: int = param(
        600, 'No more than the heaviest so many are kept.', '', (1, 100000), live=True)
    merge_distance: float = param(
        0.3, 'Hypotheses of one arrival closer than this (deviations per dimension) become one; '
        '0 = never.', '', (0.0, 10.0), live=True)
    lookback_s: float = param(
        1.0, 'A track begins so long before its detection, with the frames kept since: what is '
        'too weak to detect still tells where the target came from.', 's', (0.0, 60.0))
    end_std: float = param(
        5.0, 'A track ends when its horizontal position is less certain than this (one standard '
        'deviation): the target is out of reach.', 'm', (1e-6, 1e6), live=True)
    end_nis: float = param(
        25.0, 'A track ends when its normalised innovation is larger than this per axis, twice '
        'running: it has lost its target. Once makes it ambiguous.', '', (1.0, 1e12), live=True)
    end_gap_s: float = param(
        2.0, 'A track ends where the frames have a longer gap than this.', 's', (1e-3, 86400.0))
    vehicle: VehicleSettings = field(default_factory=VehicleSettings)
    magnet: MagnetSettings = field(default_factory=MagnetSettings)


class TrackStage:
    """Frames with a verdict to `Track`s, one a frame while a target is present."""

    def __init__(self, network, settings):
        self.counts = Counter()
        self._network = network
        self._positions = np.ascontiguousarray(network.positions, dtype=float)
        self._R_sw = network.R_sw
        self._settings = settings
        if settings.target == 'vehicle':
            v = settings.vehicle
            if len(v.arrival_names) != len(v.arrival_headings_deg):
                raise SettingsError(
                    f'track.vehicle.arrival_headings_deg: expected {len(v.arrival_names)} values '
                    f'(one per arrival_names), got {len(v.arrival_headings_deg)}')
            self._model = vehicle_model(v, network)
            self._orientation = vehicle_orientation
            # A vehicle starts on an arrival line; a magnet that was lost is found anywhere.
            self._starts_anywhere = False
            self.arrivals = v.arrival_names
        elif settings.target == 'magnet':
            if not any(settings.magnet.axis):
                raise SettingsError('track.magnet.axis: the zero vector has no direction')
            self._model = magnet_model(settings.magnet)
            self._orientation = partial(magnet_orientation, axis=settings.magnet.axis)
            self.arrivals = ('',)
            self._starts_anywhere = True
        else:
            raise SettingsError(f'track.target: expected vehicle or magnet, '
                                f'got {settings.target!r}')
        self._mounting_std = np.deg2rad(settings.mounting_std_deg)
        self._n_own = 3 if self._mounting_std else 0
        self._next_id = 1
        self._bank = None
        # Evidence for a target against backgrounds that wander, and the filter of the latter.
        self._log_odds, self._surest, self._strange = 0.0, np.inf, 0
        self._noise_x = self._noise_P = None
        self._recent = deque()
        # A target that was lost is not to be started anew in the tail of its own detection.
        self._out_of_reach = False
        self._last = None
        self._last_ns = None

    def configure(self, settings):
        """Take new values of the live settings; the running bank goes on with them."""
        self._settings = settings

    @property
    def bank(self):
        """The running `FilterBank`, or None."""
        return self._bank

    def feed(self, frame):
        """A `FieldFrame` gives the `Track`s that follow from it."""
        out = []
        if self._last_ns is not None:
            dt = (frame.stamp_ns - self._last_ns) / NS
            if dt <= 0.0:
                self.counts['time jumped back'] += 1
                out = self._forget('time jumped back')
            elif dt > self._settings.end_gap_s:
                out = self._forget('gap in the frames')
        previous, self._last_ns = self._last_ns, frame.stamp_ns
        self.counts['frames'] += 1
        if frame.target_present and self._bank is not None:
            return out + self._step(frame, (frame.stamp_ns - previous) / NS)
        if frame.target_present:
            return out if self._out_of_reach else out + self._start(frame)
        out += self._end('released')
        self._out_of_reach = False
        self._remember(frame)
        return out

    def _forget(self, reason):
        """What came before has nothing to do with what comes."""
        self._recent.clear()
        self._out_of_reach = False
        return self._end(reason)

    def _remember(self, frame):
        """Keep a frame without a target for a track that may begin soon."""
        self._recent.append(frame)
        oldest = frame.stamp_ns - self._settings.lookback_s * NS
        while self._recent and self._recent[0].stamp_ns < oldest:
            self._recent.popleft()

    def flush(self):
        """End the running track."""
        return self._end('input ended')

    def _start(self, frame):
        """Make the first hypotheses and run them through the frames before the detection."""
        s = self._settings
        if s.target == 'vehicle':
            self._bank = start_vehicle(s.vehicle, self._network, frame, s.background_std,
                                       self._mounting_std)
        else:
            self._bank = start_magnet(s.magnet, self._network, frame, s.background_std,
                                      self._mounting_std, s.field_error)
        recent = [f for f in self._recent if frame.stamp_ns - f.stamp_ns <= s.lookback_s * NS]
        self._recent.clear()
        if self._bank is None:
            self.counts['frames without a start'] += 1
            return []
        self.counts['tracks'] += 1
        self._log_odds, self._surest, self._strange = 0.0, np.inf, 0
        n_background = 3 * len(self._network)
        self._noise_x = np.zeros((1, n_background))
        self._noise_P = s.background_std**2 * np.eye(n_background)[None]
        if recent:
            self._predict((recent[0].stamp_ns - frame.stamp_ns) / NS)
        dt = 0.0
        for before, after in pairwise([*recent, frame]):
            self._step(before, dt, publish=False)
            dt = (after.stamp_ns - before.stamp_ns) / NS
        return self._step(frame, dt)

    def _predict(self, dt):
        """Time update of the bank; backwards in time without process noise."""
        bank, n_t = self._bank, len(self._model.state_names)
        x_target, F, Q = self._model.propagate(bank.x[:, :n_t], dt, bank.P[:, :n_t, :n_t])
        walk = np.zeros(bank.x.shape[1] - n_t)
        walk[self._n_own * len(self._network):] = self._settings.background_drift**2 * max(dt, 0.0)
        kalman.predict(bank.x, bank.P, x_target, F, Q if dt > 0.0 else 0.0 * Q, walk)

    def _fields(self, x, time_offset):
        """Fields of the target of states `x` as the sensors see them; see `turned_fields`.

        Each sensor sees the target where it is at the sensor's own time.
        """
        n_hyp, n, n_t = len(x), len(self._network), len(self._model.state_names)
        h, H = np.empty((n_hyp, n, 3)), np.empty((n_hyp, n, 3, n_t))
        gradient_power = np.empty((n_hyp, n))
        steps = np.round(time_offset / SAME_TIME_S)
        for step in np.unique(steps):
            j = np.flatnonzero(steps == step)
            moved, F, _ = self._model.propagate(x[:, :n_t], step * SAME_TIME_S)
            h[:, j], H_moved, gradient_power[:, j] = sensor_fields(
                self._positions[j], self._R_sw[j], *self._model.dipoles(moved))
            H[:, j] = H_moved @ (F if F.ndim == 2 else F[:, None])
        if self._n_own:
            h, H = turned_fields(h, H, self._angles(x))
        return h, H, gradient_power

    def _angles(self, x):
        """(n_hyp, n_sensors, 3) [rad] mounting angles among the states `x`."""
        n_t, n = len(self._model.state_names), len(self._network)
        return x[:, n_t:n_t + 3 * n].reshape(len(x), n, 3)

    def _step(self, frame, dt, publish=True):
        """Predict, update, weigh, publish; the `Track` of the frame if it is to be published."""
        bank = self._bank
        if bank is None:
            return []
        if dt > 0.0:
            self._predict(dt)
        if np.ptp(frame.time_offset) < ONE_TIME * dt or dt <= 0.0:
            frame = replace(frame, time_offset=np.zeros(len(self._network)))
        covariance = np.where(np.isnan(frame.covariance), np.eye(3), frame.covariance)
        log_likelihood = self._update(frame, covariance, dt)
        evidence = bank.reweight(log_likelihood)
        if not np.isfinite(evidence):
            self.counts['banks lost'] += 1
            return self._end('no hypothesis explains the field')
        self._log_odds += evidence - self._log_density_of_noise(frame, covariance, dt)
        self._thin_out()
        if not publish:
            return []
        self._last = self._published(frame)
        self.counts['poses'] += 1
        reason = self._reason_to_end(self._last)
        if reason:
            # In the tail of its own detection a vehicle would be started on the wrong line.
            self._out_of_reach = not self._starts_anywhere
            return [self._last, *self._end(reason)]
        return [self._last]

    def _reason_to_end(self, track):
        """Why the running track is over after its pose `track`; None while it goes on."""
        s, spread = self._settings, float(np.trace(track.covariance[:2, :2])) ** 0.5
        strange = track.nis > s.end_nis * track.degrees_of_freedom
        self._strange = self._strange + 1 if strange else 0
        if self._strange > 1:
            return 'lost its target'
        if spread > s.end_std > self._surest:
            return 'out of reach'
        self._surest = min(self._surest, spread)
        return None

    def _thin_out(self):
        """Drop and merge hypotheses."""
        s = self._settings
        gone = self._bank.prune(-np.log(s.prune_ratio), s.most_hypotheses)
        if s.merge_distance:
            gone += self._bank.merge(len(self._model.state_names), s.merge_distance)
        self.counts['hypotheses dropped'] += gone

    def _update(self, frame, covariance, dt):
        """Measurement update of the bank, relinearised as often as the settings say."""
        s, bank = self._settings, self._bank
        x_prior, P_prior, x_lin = bank.x.copy(), bank.P.copy(), bank.x.copy()
        repeat = max(1.0, s.model_error_time_s / dt) if dt > 0.0 else 1.0
        for _ in range(s.iterations):
            bank.x, bank.P = x_prior.copy(), P_prior.copy()
            h, H, gradient_power = self._fields(x_lin, frame.time_offset)
            inflation = repeat * (s.near_field_length**2 * gradient_power
                                  + s.field_error**2 * np.einsum('pji,pji->pj', h, h))
            # A dipole on a sensor has no field: such a hypothesis is as good as ruled out.
            lost = ~(np.isfinite(h).all(axis=(1, 2)) & np.isfinite(inflation).all(axis=1))
            h[lost], H[lost], inflation[lost] = 0.0, 0.0, 0.0
            log_likelihood, bank.nis = kalman.update(bank.x, bank.P, frame.field, h, H, covariance,
                                                inflation, x_lin, self._n_own)
            log_likelihood[lost] = -np.inf
            x_lin = bank.x.copy()
        if np.isnan(frame.field).all():
            bank.nis[:] = np.nan
        return log_likelihood

    def _published(self, frame):
        """The `Track` of the hypothesis to publish, with what it says of the sensors."""
        bank, n = self._bank, len(self._network)
        best = bank.best()
        x = bank.x[best:best + 1]
        own = slice(len(self._model.state_names), bank.x.shape[1] - 3 * n)
        n_y = int(np.count_nonzero(~np.isnan(frame.field)))
        return published_track(
            bank, best, self._model, self._orientation, self.arrivals, stamp_ns=frame.stamp_ns,
            id=self._next_id, ended=False,
            existence=float(1.0 / (1.0 + np.exp(-np.clip(self._log_odds, -700.0, 700.0)))),
            degrees_of_freedom=n_y, strange=bank.nis[best] > self._settings.end_nis * n_y,
            predicted=self._fields(x, frame.time_offset)[0][0] + x[0, -3 * n:].reshape(n, 3),
            mounting=x[0, own].reshape(-1, 3),
            mounting_std=np.sqrt(np.diagonal(bank.P[best])[own]).reshape(-1, 3))

    def _log_density_of_noise(self, frame, covariance, dt):
        """Log-density of the frame if there is no target, only backgrounds that wander."""
        n = len(self._network)
        i = np.arange(3 * n)
        self._noise_P[0, i, i] += self._settings.background_drift**2 * dt
        log_likelihood, _ = kalman.update(
            self._noise_x, self._noise_P, frame.field, np.zeros((1, n, 3)),
            np.zeros((1, n, 3, 0)), covariance, np.zeros((1, n)))
        return float(log_likelihood[0])

    def _end(self, reason):
        """Close the running track; its last record goes out once more, marked as ended."""
        if self._bank is None:
            return []
        self._bank = None
        self.counts[f'tracks ended: {reason}'] += 1
        self._next_id += 1
        last, self._last = self._last, None
        return [] if last is None else [replace(last, ended=True)]
