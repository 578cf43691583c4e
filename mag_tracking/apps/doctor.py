"""What is wrong with a network and its readings: what `mag-tracking doctor` finds."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from mag_tracking.apps.doctor_covariances import covariance_findings
from mag_tracking.apps.prescan import prescan_of
from mag_tracking.arrays import FloatArray
from mag_tracking.calibration.agreement import consensus, disagreements
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import Readings
from mag_tracking.stages.align.frame_period import frame_period_warning
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.health.sensor_health import Finding, SensorHealth
from mag_tracking.stages.stage import rejected
from mag_tracking.stages.survey.settings import SurveySettings
from mag_tracking.units import NS

STEADY_S = 30.0
"""[s] A background that has been frozen for longer is worth a word."""

APART_S = 60.0
"""[s] Stamps of sensors that are farther apart are not of one time."""

_ADVICE = (
    ('above', 'gauss or microtesla published as tesla? Near a magnet raise calibrate.max_field'),
    ('unknown sensor', 'it is not in the network file'),
    ('duplicate', 'the driver publishes readings twice, or stamps too coarsely'),
    ('out of order', 'two publishers on one topic, or a clock that was set'),
    ('stamp too far ahead', 'a clock stepped, or a message is corrupt'),
    ('no axis', 'look at the sensor and its driver'),
    ('infinite', 'look at the driver'),
    ('covariance', 'publish zeros where the noise is not known'),
    ('undecodable', 'the recording is damaged, or its type is another'))

MISSED = 3
"""Targets that another sensor felt while a reading stayed the same, at least."""

LEVEL_STEP = 1e-8
"""[T] A fiftieth of what iron near a sensor adds."""


def level_of(calibrate: Calibrate, name: str, health: SensorHealth) -> FloatArray:
    """(3,) [T] field of a sensor without a target, as well as it is known.

    Its background where that was learnt from readings, else the median of what it read last.
    """
    background = calibrate.backgrounds()[name]
    if background.measured and calibrate.last_stamp_ns(name) is not None:
        return calibrate.background(name)
    return health.field


def network_findings(network: SensorNetwork, survey: SurveySettings, calibrate: Calibrate,
                     sensors: Mapping[str, SensorHealth]) -> list[Finding]:
    """What is only seen by comparing sensors: list of `Finding`.

    Parameters
    ----------
    network : SensorNetwork
    survey : SurveySettings
    calibrate : Calibrate
    sensors : {name: SensorHealth}
    """
    found = list(_clock_findings(network, sensors))
    levels = np.array([level_of(calibrate, name, sensors[name]) for name in network.names])
    # What has hardly changed since the last time need not be compared anew.
    levels = LEVEL_STEP * np.round(levels / LEVEL_STEP)
    std = np.array([np.full(3, np.deg2rad(survey.stated_std_deg)) if s is None else s
                    for s in network.orientation_std])
    earth = network.earth_field
    if earth is None:
        try:
            earth = consensus(levels, network.R_ws)
        except ValueError as error:
            return [*found, Finding(False, 'network', f'sensors are not compared: {error}',
                                    'give earth_field or site in the network file')]
    return found + [
        Finding(True, d.sensor, str(d).removeprefix(f'{d.sensor} '),
                'mend it, or its orientation in the network file')
        for d in disagreements(network.names, levels, network.R_ws, std, earth,
                               survey.compass_bias_std)]


def _clock_findings(network: SensorNetwork,
                    sensors: Mapping[str, SensorHealth]) -> Iterator[Finding]:
    """Sensors whose clock is far from that of the others."""
    delays = {name: sensors[name].delay_s[0] for name in network.names}
    delays = {name: d for name, d in delays.items() if not np.isnan(d)}
    if not delays:
        return
    # The one nearest to the host's clock is right; in a replay all are as far from it.
    right = min(delays.values(), key=abs)
    for name, delay in delays.items():
        if abs(delay - right) > APART_S:
            yield Finding(True, name, f'its stamps are {right - delay:+.4g} s off those of other '
                          'sensors', 'set its clock (chrony, PTP); knocks compare only what is '
                          'within survey.max_clock_offset_s')


def background_findings(name: str, calibrate: Calibrate, frozen_since_ns: int | None,
                        n_known: int = 0) -> Iterator[Finding]:
    """What is wrong with the background of one sensor: iterator of `Finding`.

    `frozen_since_ns` is the stamp since which it has been frozen, or None; `n_known` of the
    backgrounds that were taken anew are no news.
    """
    background, last = calibrate.backgrounds()[name], calibrate.last_stamp_ns(name)
    if last is not None and not background.ready and background.stuck:
        yield Finding(True, name, 'its readings do not change, and it is not used', 'it hangs, or '
                      'its steps are coarser than all that it felt: move something of iron beside '
                      'it; with background and noise_std in the network file it is used')
    elif last is not None and not background.ready:
        yield Finding(True, name, 'no background was learnt', 'begin without a target for a few '
                      'seconds, or give background and noise_std in the network file')
    if background.doubtful:
        yield Finding(False, name, 'its background is doubtful, and its tracks are ambiguous',
                      'begin without a target for a few seconds, or give background and noise_std '
                      'in the network file')
    if background.n_relearnt > n_known:
        yield Finding(False, name, f'a steady change was taken for its background '
                      f'{background.n_relearnt - n_known} times', 'a parked vehicle, or something '
                      'that was put beside it; calibrate.relearn_s: 0 would wait for ever')
    if last is not None and frozen_since_ns is not None \
            and (last - frozen_since_ns) / NS > STEADY_S:
        yield Finding(False, name, f'its background has not been learnt for '
                      f'{(last - frozen_since_ns) / NS:.0f} s', 'a target stays near, or the field '
                      'has changed for good: call the service calibrate')


class MissedTargets:
    """Counts, for each sensor, the targets of another one during which its reading stays the same.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._missed: dict[str, Counter[str]] = {name: Counter() for name in names}

    def end(self, name: str, begin_ns: int, sensors: Mapping[str, SensorHealth]) -> None:
        """Take a target that sensor `name` felt from `begin_ns` until now."""
        for other, health in sensors.items():
            since_ns = health.unchanged_since_ns
            if since_ns is not None and since_ns < begin_ns:
                self._missed[other][name] += 1
            else:
                self._missed[other].clear()

    def findings(self) -> Iterator[Finding]:
        """`Finding` of each sensor that missed several targets in succession."""
        for name, missed in self._missed.items():
            for other, n in missed.most_common(1):
                if n >= MISSED:
                    yield Finding(True, name, f'its readings did not change while {other} felt {n} '
                                  'targets', 'it hangs, is too far away, or its steps are too '
                                  'coarse: move something of iron beside it')


class Doctor:
    """Looks at the readings of a network as they come, and says what is wrong."""

    def __init__(self, network: SensorNetwork, settings: Settings) -> None:
        self.network, self._settings = network, settings
        self.sensors = {name: SensorHealth() for name in network.names}
        self.calibrate = Calibrate(network, settings.calibrate)
        self._clock_ns = dict(zip(network.names, network.clock_offset_ns.tolist(), strict=True))
        self._frozen_ns: dict[str, int] = {}
        self._missed = MissedTargets(network.names)

    def feed(self, readings: Readings, received_ns: int | None = None) -> None:
        """Look at raw `Readings` of the network that were received at `received_ns`."""
        names, stamps = readings.sensor_names(), readings.stamp_ns.tolist()
        for name, stamp, field in zip(names, stamps, readings.field, strict=True):
            self.sensors[name].add(stamp - self._clock_ns[name], field, received_ns)
        self.calibrate.feed(readings)
        backgrounds = self.calibrate.backgrounds()
        for name, stamp in zip(names, stamps, strict=True):
            if backgrounds[name].frozen:
                self._frozen_ns.setdefault(name, stamp)
            elif (begin_ns := self._frozen_ns.pop(name, None)) is not None:
                self._missed.end(name, begin_ns, self.sensors)

    def findings(self) -> list[Finding]:
        """List of `Finding`, the serious ones first."""
        found: list[Finding] = []
        for j, (name, health) in enumerate(self.sensors.items()):
            found += health.findings(name, self.network.noise_std[j],
                                     self._settings.calibrate.max_field)
            found += background_findings(name, self.calibrate, self._frozen_ns.get(name))
            found += covariance_findings(name, self.network.absolute_topics[j], self.calibrate)
        found += self._missed.findings()
        found += network_findings(self.network, self._settings.survey, self.calibrate,
                                  self.sensors)
        for cause, n in rejected(self.calibrate.counts).items():
            advice = next((a for key, a in _ADVICE if key in cause), 'look at the driver')
            found.append(Finding(n > 100, 'calibrate', f'{n} readings rejected: {cause}', advice))
        warning = frame_period_warning(self._settings.align, self.network)
        if warning:
            found.append(Finding(True, 'align', warning, 'set align.period_s to 0 (auto)'))
        return sorted(found, key=lambda f: not f.serious)


def examine(recording: Recording, network: SensorNetwork, settings: Settings,
            progress: Callable[[int], object] | None = None,
            stopped: Callable[[], bool] | None = None) -> tuple[Doctor, list[Finding]]:
    """A `Doctor` that has seen a whole recording, and what the reading itself lost.

    Parameters
    ----------
    recording : Recording
    network : SensorNetwork
    settings : Settings
    progress : function, optional
        Called with the bytes done since the last call.
    stopped : function, optional
        Asked before every message; when it is true, what was read so far counts.

    Returns
    -------
    (Doctor, list of Finding)

    Raises RecordingError where the recording has none of the network's topics.
    """
    reader, doctor = SampleReader(recording, network), Doctor(network, settings)
    prescan_of(recording, network, settings.calibrate, stopped).apply(doctor.calibrate)
    for readings, received_ns in reader.readings_as_received(progress):
        doctor.feed(readings, received_ns)
        if stopped is not None and stopped():
            break
    lost = [Finding(True, recording.path.name, f'{what}: {n}', 'the recording is damaged: see '
                    'mag-tracking repair') for what, n in recording.losses.items()]
    lost += [Finding(False, 'recording', f'{n} times {what}', 'the recording is damaged, or its '
                     'type is another') for what, n in reader.rejected.items()]
    return doctor, lost
