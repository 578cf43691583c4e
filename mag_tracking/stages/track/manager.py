"""Track: a bank of extended Kalman filters, from a detection to its release.

Source: ICASSP11 section 2, T10 Alg. 2 and 3; PHD15 Paper A for the magnet.
"""

from collections import Counter, deque
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from mag_tracking.errors import NetworkError, SettingsError
from mag_tracking.inference.axes import whitened_energy
from mag_tracking.stages.track.bank_filter import BankFilter, NoTarget
from mag_tracking.stages.track.initiation_magnet import magnet_model, start_magnet
from mag_tracking.stages.track.initiation_vehicle import start_vehicle, vehicle_model
from mag_tracking.stages.track.observation import MOST_TURNED
from mag_tracking.stages.track.published_pose import (
    is_ambiguous,
    magnet_orientation,
    published_track,
    smoothed_pose,
    vehicle_orientation,
)
from mag_tracking.stages.track.relinearisation import Relinearisation
from mag_tracking.stages.track.sensor_rejection import Contradiction
from mag_tracking.stages.track.sensor_selection import (
    AHEAD_S,
    hand_on,
    nearest,
    part_of_frame,
    widened,
)
from mag_tracking.stages.track.smoothing import FixedLag, WholeTrack
from mag_tracking.units import NS

WATCHED = 0.5
"""A track that begins with less than this share of its lookback is ambiguous."""
ALONE_S = 0.5
"""[s] A track that one sensor of several has carried alone for longer stays ambiguous."""


class TrackStage:
    """Frames with a verdict to `Track`s, one a frame while a target is present.

    With them come `SmoothedPose`s: each track's when it ends, and those of a fixed lag.
    """

    def __init__(self, network, settings):
        self.counts = Counter()
        self._whole_network, self._settings = network, settings
        self._is_large = len(network) > settings.most_sensors
        if settings.target == 'vehicle':
            v = settings.vehicle
            self._model = vehicle_model(v, network)
            self._orientation = vehicle_orientation
            # A vehicle starts on an arrival line; a magnet that was lost is found anywhere.
            self._starts_anywhere = False
            self.arrivals, self.kinds = v.arrival_names, v.kinds
        elif settings.target == 'magnet':
            if not any(settings.magnet.axis):
                raise SettingsError('track.magnet.axis: the zero vector has no direction')
            self._model = magnet_model(settings.magnet)
            self._orientation = partial(magnet_orientation, axis=settings.magnet.axis)
            self.arrivals, self.kinds = ('',), ('',)
            self._starts_anywhere = True
        else:
            raise SettingsError(f'track.target: expected vehicle or magnet, '
                                f'got {settings.target!r}')
        self._use(np.arange(min(len(network), settings.most_sensors)))
        hardly = sum(bool(s is not None and s.max() > MOST_TURNED)
                     for s in network.orientation_std)
        if hardly:
            self.counts['sensors whose orientation is hardly known'] = hardly
        self._whole = WholeTrack(settings.smooth_longest_s)
        self._anew = Relinearisation(settings.relinearise_interval_s, settings.relinearise_window_s,
                                     settings.relinearise_most)
        self._lag = FixedLag(settings.smoothing_lag_s) if settings.smoothing_lag_s else None
        self._next_id = 1
        self._bank = None
        # Evidence for a target against backgrounds that wander, and the filter of the latter.
        self._log_odds, self._surest, self._strange = 0.0, np.inf, 0
        # How long one sensor has carried the track; whether the whole of it may be wrong.
        self._alone_s, self._doubted = 0.0, False
        self._no_target = None
        self._recent = deque()
        # A target that was lost is not to be started anew in the tail of its own detection.
        self._out_of_reach = False
        self._last = None
        self._last_ns = None
        self._next_network = self._to_follow = None

    def use_network(self, network):
        """Go on with another calibration of the same sensors, as soon as no track runs.

        Raises NetworkError where they are others.
        """
        if network.names != self._whole_network.names:
            raise NetworkError(f'a network of {", ".join(network.names)} in place of one of '
                               f'{", ".join(self._whole_network.names)}')
        self._next_network = network

    def configure(self, settings):
        """Take new values of the live settings; the running bank goes on with them."""
        self._settings = settings
        self._filter.configure(settings)
        self._anew.begin_anew()

    @property
    def bank(self):
        """The running `FilterBank`, or None."""
        return self._bank

    def feed(self, frame):
        """A `FieldFrame` gives the `Track`s that follow from it."""
        self.settle()
        out = []
        if self._next_network is not None and self._bank is None:
            self._whole_network, self._next_network = self._next_network, None
            self._use(self._rows)
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
            return out + self._step(self._near(frame), (frame.stamp_ns - previous) / NS)
        if frame.target_present:
            return out if self._out_of_reach else out + self._start(frame)
        out += self._end('released')
        self._out_of_reach = False
        self._remember(frame)
        return out

    def settle(self):
        """Do what could wait until the latest frame's track was published; else `feed` does it."""
        best, self._to_follow = self._to_follow, None
        if best is not None and self._bank is not None:
            self._follow(best)

    def _use(self, rows):
        """From now on a track is of the sensors `rows` of the whole network."""
        self._rows = rows
        self._network = self._whole_network.part(rows) if self._is_large else self._whole_network
        self._filter = BankFilter(self._network, self._model, self._settings)
        self._contradiction = Contradiction(self._network.names)

    def _near(self, frame):
        """What of a frame of the whole network the track uses."""
        return part_of_frame(frame, self._rows) if self._is_large else frame

    def _follow(self, best):
        """Take the sensors near to where hypothesis `best` is going, if those used are others."""
        x, positions = self._bank.x[best], self._whole_network.positions
        place, n = x[:2] + AHEAD_S * x[3:5], self._settings.most_sensors
        if np.isin(nearest(positions, place, n // 2), self._rows).all():
            return
        before = self._rows
        self._use(nearest(positions, place, n))
        observation, std = self._filter.observation, self._settings.background_std
        hand_on(self._bank, observation.n_own, before, self._rows, observation.own_covariance, std)
        self._no_target = NoTarget(len(self._network), std)
        self._whole.give_up()
        self._anew.begin_anew()
        if self._lag is not None:
            self._lag.clear()
        self.counts['tracks handed on to other sensors'] += 1

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

    def give_up(self, reason):
        """End the running track, as nothing is known of what came since; see `feed`."""
        return self._forget(reason)

    def flush(self):
        """End the running track."""
        return self._end('input ended')

    def _start(self, frame):
        """Make the first hypotheses and run them through the frames before the detection."""
        s = self._settings
        if self._is_large:
            strongest = int(np.argmax(whitened_energy(frame.field, frame.covariance)[0]))
            self._use(nearest(self._whole_network.positions,
                              self._whole_network.positions[strongest, :2], s.most_sensors))
            frame = self._near(frame)
        known = self._network, frame, s.background_std, self._filter.observation.own_covariance
        self._bank = start_vehicle(s.vehicle, *known) if s.target == 'vehicle' else \
            start_magnet(s.magnet, *known, s.field_error)
        recent = [self._near(f) for f in self._recent
                  if frame.stamp_ns - f.stamp_ns <= s.lookback_s * NS]
        self._recent.clear()
        if self._bank is None:
            self.counts['frames without a start'] += 1
            return []
        self.counts['tracks'] += 1
        self._log_odds, self._surest, self._strange, self._alone_s = 0.0, np.inf, 0, 0.0
        self._no_target = NoTarget(len(self._network), s.background_std)
        # Whom nobody saw come may be past the place where its field is first so strong.
        watched_ns = frame.stamp_ns - recent[0].stamp_ns if recent else 0
        self._doubted = (watched_ns < WATCHED * s.lookback_s * NS) and not self._starts_anywhere
        if recent:
            self._filter.predict(self._bank, (recent[0].stamp_ns - frame.stamp_ns) / NS)
        self._whole.begin(self._bank, self._filter)
        if s.relinearise_window_s:
            self._anew.begin(self._bank)
        dt = 0.0
        for before, after in pairwise([*recent, frame]):
            self._step(before, dt, publish=False)
            dt = (after.stamp_ns - before.stamp_ns) / NS
        return self._step(frame, dt)

    def _step(self, frame, dt, publish=True):
        """Predict, update, weigh, publish; the `Track` of the frame if it is to be published."""
        bank = self._bank
        if bank is None:
            return []
        if dt > 0.0:
            self._filter.predict(bank, dt)
        predicted = bank.x.copy()
        log_likelihood, frame, left_out = self._contradiction.update(self._filter, bank, frame, dt)
        self.counts.update(left_out)
        # Where no majority is left it may as well have been the track that was wrong.
        if left_out and np.count_nonzero(frame.n_samples) <= len(left_out):
            self._doubted = True
        evidence = bank.reweight(log_likelihood)
        if not np.isfinite(evidence):
            self.counts['banks lost'] += 1
            return self._end('no hypothesis explains the field')
        self._log_odds += evidence - self._no_target.log_density(
            frame, dt, self._settings.background_drift)
        self._anew.add(bank, predicted, log_likelihood, frame, dt)
        s = self._settings
        self.counts['hypotheses dropped'] += bank.prune(
            -np.log(s.prune_ratio),
            s.most_hypotheses if publish else max(s.most_hypotheses, s.most_at_start))
        self.counts.update(self._anew.improve(self._filter, bank))
        self._whole.add(bank, frame, dt, publish)
        if not publish and self._lag is None:
            return []
        best = bank.best()
        late = [] if self._lag is None else self._smoothed(best, False, self._lag.smoothed(
            self._filter, bank, best, frame, dt, publish))
        if not publish:
            return []
        self._last = self._published(frame, dt, best)
        self.counts['poses'] += 1
        self._to_follow = best if self._is_large else None
        reason = self._reason_to_end(self._last)
        if reason:
            # In the tail of its own detection a vehicle would be started on the wrong line.
            self._out_of_reach = not self._starts_anywhere
            return [self._last, *late, *self._end(reason)]
        return [self._last, *late]

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

    def _smoothed(self, best, complete, states, doubtful=False):
        """The `SmoothedPose`s of states (stamp_ns, x, P) of the hypothesis `best`."""
        bank = self._bank
        ambiguous = doubtful or is_ambiguous(bank, best)
        return [smoothed_pose(
            self._model, self._orientation, x, P, stamp_ns=stamp_ns, id=self._next_id,
            kind=self.kinds[bank.kind[best]], complete=complete, ambiguous=ambiguous)
            for stamp_ns, x, P in states]

    @property
    def _is_doubtful(self):
        """Whether the field contradicted the track at its end, or all of it may be wrong."""
        return self._strange > 0 or self._doubted

    def _smoothed_at_the_end(self):
        """What is left of a fixed lag, and the whole track."""
        best = self._bank.best()
        out = [] if self._lag is None else self._smoothed(best, False, self._lag.rest(
            self._filter, self._bank, best), self._is_doubtful)
        states, left_out = self._whole.smoothed(self._bank, best)
        self.counts['frames left out of smoothing'] += left_out
        self.counts['tracks too long to smooth'] += self._whole.too_long
        return out + self._smoothed(best, True, states, self._is_doubtful)

    def _published(self, frame, dt, best):
        """The `Track` of the hypothesis `best`, with what it says of the sensors."""
        bank, observation = self._bank, self._filter.observation
        there = ~np.isnan(frame.field)
        n_y = int(np.count_nonzero(there))
        # One alone of several tells neither scale nor mirror image, and what has gone astray by it
        # the others, when they are back, do not always put right.
        alone = len(self._network) > 1 and np.count_nonzero(there.any(axis=1)) == 1
        self._alone_s += dt if alone else 0.0
        self._doubted = self._doubted or self._alone_s > ALONE_S
        track = published_track(
            bank, best, self._model, self._orientation, self.arrivals, self.kinds,
            stamp_ns=frame.stamp_ns,
            id=self._next_id, ended=False,
            existence=float(1.0 / (1.0 + np.exp(-np.clip(self._log_odds, -700.0, 700.0)))),
            degrees_of_freedom=n_y,
            strange=self._filter.is_strange(bank, best, frame) or alone or self._doubted,
            predicted=self._filter.predicted_field(bank, best, frame, dt),
            mounting=observation.angles(bank.x[best]),
            mounting_covariance=observation.angle_covariances(bank.P[best]))
        return widened(track, self._rows, self._whole_network, self._settings) \
            if self._is_large else track

    def _end(self, reason):
        """Close the running track: its last record once more, marked as ended, then it smoothed."""
        if self._bank is None:
            return []
        last, self._last = self._last, None
        smoothed = [] if last is None else self._smoothed_at_the_end()
        self._whole.clear()
        self._anew.clear()
        self._contradiction.clear()
        if self._lag is not None:
            self._lag.clear()
        self._bank = None
        self.counts[f'tracks ended: {reason}'] += 1
        self._next_id += 1
        return [] if last is None else [replace(last, ended=True), *smoothed]
