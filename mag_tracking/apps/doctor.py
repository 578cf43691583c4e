"""Diagnosis of a sensor network and its readings, for the command `mag-tracking doctor`."""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping

import numpy as np

from mag_tracking.apps.doctor_covariances import covariance_findings
from mag_tracking.apps.doctor_rejections import driver_findings, rejection_findings
from mag_tracking.apps.host_stalls import HostStalls
from mag_tracking.apps.prescan import prescan_of
from mag_tracking.arrays import FloatArray
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.quantities import occurrences
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import ZERO_STAMP, SampleReader
from mag_tracking.records import Readings
from mag_tracking.stages.align.frame_period import frame_period_warning
from mag_tracking.stages.calibrate.field_comparison import (
    compared_with_earth,
    earth_field_findings,
)
from mag_tracking.stages.calibrate.stage import FAULTS_FOUND, Calibrate
from mag_tracking.stages.health.clocks import clock_findings
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.health.sensor_health import SensorHealth
from mag_tracking.stages.survey.settings import SurveySettings
from mag_tracking.stages.track.low_rate import low_rate_fault
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.units import NS

MAX_FROZEN_S = 30.0
"""Time for which a background may be frozen before it is reported [s]."""

MIN_MISSED_TARGETS = 3
"""Number of consecutive missed targets at which a sensor is reported."""

LEVEL_STEP = 1e-8
"""Resolution to which levels are rounded before sensors are compared [T]; nearby iron changes the
field by about fifty times as much."""


def level_of(calibrate: Calibrate, name: str, health: SensorHealth) -> FloatArray:
    """Field (3,), T, sensor frame, that a sensor measures without a target: the background if it
    was learnt from readings, otherwise the median of the latest readings."""
    background = calibrate.backgrounds()[name]
    if background.measured and calibrate.last_stamp_ns(name) is not None:
        return calibrate.background(name)
    return health.field


def network_findings(network: SensorNetwork, survey: SurveySettings, calibrate: Calibrate,
                     sensors: Mapping[str, SensorHealth]) -> list[Finding]:
    """Diagnose faults that are visible only by comparing sensors."""
    clocks = {name: health.clock for name, health in sensors.items()}
    findings = list(clock_findings({name: c for name, c in clocks.items() if c is not None}))
    levels = np.array([level_of(calibrate, name, sensors[name]) for name in network.names])
    # Rounded levels stay equal during small changes, so that no new comparison is needed.
    levels = LEVEL_STEP * np.round(levels / LEVEL_STEP)
    try:
        return findings + earth_field_findings(compared_with_earth(network, survey, levels))
    except ValueError as error:
        return [*findings, Finding(False, 'network', f'sensors were not compared: {error}',
                                   'add earth_field or site to the network file',
                                   Cause.NOT_COMPARED)]


def background_findings(name: str, calibrate: Calibrate, frozen_since_ns: int | None,
                        n_reported: int = 0) -> Iterator[Finding]:
    """Diagnose the background of a sensor, frozen since `frozen_since_ns` or not (None).

    `n_reported` is the number of relearnt backgrounds that were reported earlier.
    """
    background, last = calibrate.backgrounds()[name], calibrate.last_stamp_ns(name)
    if last is not None and not background.ready and background.stuck:
        yield Finding(True, name, 'its readings do not change, and the sensor is not used', 'move '
                      'iron near it to check whether it is stuck or too coarse; to use it, set '
                      'background and noise_std in the network file', Cause.CONSTANT)
    elif last is not None and not background.ready:
        yield Finding(True, name, 'no background was learnt', 'keep targets away during the '
                      'first seconds, or set background and noise_std in the network file',
                      Cause.NO_BACKGROUND)
    if background.doubtful:
        yield Finding(False, name, 'its background is doubtful, which makes tracks ambiguous',
                      'keep targets away during the first seconds, or set background and '
                      'noise_std in the network file', Cause.DOUBTFUL_BACKGROUND)
    if background.n_relearnt > n_reported:
        n_times = occurrences(background.n_relearnt - n_reported)
        yield Finding(False, name, f'its background was relearnt {n_times} after a lasting change '
                      'of the field', 'check for a parked vehicle or an object near it; '
                      'calibrate.relearn_s: 0 disables relearning', Cause.RELEARNT_BACKGROUND)
    if last is not None and frozen_since_ns is not None \
            and (last - frozen_since_ns) / NS > MAX_FROZEN_S:
        yield Finding(False, name, 'its background has been frozen for '
                      f'{(last - frozen_since_ns) / NS:.0f} s', 'remove any target near it; if the '
                      'field has changed permanently, call the service calibrate',
                      Cause.FROZEN_BACKGROUND)


def rate_findings(name: str, rate: float, network: SensorNetwork,
                  settings: TrackSettings) -> Iterator[Finding]:
    """Report a sensor whose rate [Hz; NaN or inf if unknown] is too low for tracks."""
    fault = low_rate_fault(rate, network, settings)
    if fault is not None:
        yield Finding(True, name, fault, 'raise the rate of the sensor; for parked vehicles, use '
                      'mag-tracking events', Cause.RATE_TOO_LOW)


class MissedTargets:
    """Counts targets that other sensors detect while the readings of a sensor stay constant."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._missed: dict[str, Counter[str]] = {name: Counter() for name in names}

    def add_target(self, name: str, begin_ns: int, sensors: Mapping[str, SensorHealth]) -> None:
        """Add a target that has passed and that sensor `name` detected from `begin_ns` on."""
        for other, health in sensors.items():
            since_ns = health.unchanged_since_ns
            if since_ns is not None and since_ns < begin_ns:
                self._missed[other][name] += 1
            else:
                self._missed[other].clear()

    def findings(self) -> Iterator[Finding]:
        """Report each sensor that missed several consecutive targets."""
        for name, missed in self._missed.items():
            for other, n in missed.most_common(1):
                if n >= MIN_MISSED_TARGETS:
                    yield Finding(True, name, f'its readings did not change while {other} detected '
                                  f'{n} targets', 'move iron near the sensor to check whether it '
                                  'is stuck, too far away, or too coarse', Cause.MISSED_TARGETS)


class Doctor:
    """Diagnoses a network from its readings."""

    def __init__(self, network: SensorNetwork, settings: Settings) -> None:
        self.network, self._settings = network, settings
        self.sensors = {name: SensorHealth() for name in network.names}
        self.calibrate = Calibrate(network, settings.calibrate, survey=settings.survey)
        self._clock_ns = dict(zip(network.names, network.clock_offset_ns.tolist(), strict=True))
        self._frozen_since_ns: dict[str, int] = {}
        self._missed = MissedTargets(network.names)
        self._n_faults_found, self._stalls = 0, HostStalls()

    def feed(self, readings: Readings, received_ns: int | None = None) -> None:
        """Add raw readings, with the time of reception of their message if known."""
        names, stamps = readings.sensor_names(), readings.stamp_ns.tolist()
        if received_ns is not None:
            self._stalls.add(received_ns, names)
        self.calibrate.feed(readings)
        if self.calibrate.counts[FAULTS_FOUND] != self._n_faults_found:
            self._n_faults_found = self.calibrate.counts[FAULTS_FOUND]
            for name, health in self.sensors.items():
                if health.faults != self.calibrate.driver_faults.of(name):
                    self.sensors[name] = SensorHealth(faults=self.calibrate.driver_faults.of(name))
        for name, stamp, field in zip(names, stamps, readings.field, strict=True):
            self.sensors[name].add(stamp - self._clock_ns[name], field, received_ns)
        backgrounds = self.calibrate.backgrounds()
        for name, stamp in zip(names, stamps, strict=True):
            if backgrounds[name].frozen:
                self._frozen_since_ns.setdefault(name, stamp)
            elif (begin_ns := self._frozen_since_ns.pop(name, None)) is not None:
                self._missed.add_target(name, begin_ns, self.sensors)

    def findings(self) -> list[Finding]:
        """Findings from all readings so far, without ranking (`stages.health.diagnosis.ranked`)."""
        found = list(self._stalls.findings())
        for j, (name, health) in enumerate(self.sensors.items()):
            found += health.findings(name, self.network.noise_std[j],
                                     self._settings.calibrate.max_field)
            found += background_findings(name, self.calibrate, self._frozen_since_ns.get(name))
            found += covariance_findings(name, self.network.absolute_topics[j], self.calibrate)
            found += driver_findings(name, self.calibrate)
            found += rejection_findings(name, self.calibrate)
            found += rate_findings(name, self.calibrate.lowest_rate(name), self.network,
                                   self._settings.track)
        found += self._missed.findings()
        found += network_findings(self.network, self._settings.survey, self.calibrate,
                                  self.sensors)
        warning = frame_period_warning(self._settings.align, self.network)
        if warning:
            found.append(Finding(True, 'align', warning, 'set align.period_s to 0 (automatic)',
                                 Cause.FRAMES_TOO_LONG))
        return found


def examine(recording: Recording, network: SensorNetwork, settings: Settings,
            progress: Callable[[int], object] | None = None,
            stopped: Callable[[], bool] | None = None) -> tuple[Doctor, list[Finding]]:
    """Diagnose a network from a recording.

    The findings returned with the doctor are damage to the recording, which `doctor.findings` does
    not include.
    """
    reader, doctor = SampleReader(recording, network), Doctor(network, settings)
    prescan_of(recording, network, settings.calibrate, stopped).apply(doctor.calibrate)
    for readings, received_ns in reader.readings_as_received(progress):
        doctor.feed(readings, received_ns)
        if stopped is not None and stopped():
            break
    return doctor, recording_findings(recording, reader)


def recording_findings(recording: Recording, reader: SampleReader) -> list[Finding]:
    """Report the parts of a recording that could not be read; `reader` is at its end."""
    name, found = recording.path.name, []
    without_time = {fault: n for fault, n in reader.rejected.items()
                    if fault.startswith(ZERO_STAMP)}
    for counts, advice, cause in (
            (recording.losses, 'the recording is damaged; mag-tracking repair adds the missing '
             'index of a truncated file, but cannot restore lost data', Cause.DAMAGED_RECORDING),
            (without_time, 'set the timestamps in the driver', Cause.ZERO_STAMPS),
            (reader.rejected - Counter(without_time), 'the messages are damaged or incomplete, or '
             'their encoding or type is not supported: check the driver and the program that '
             'recorded them',
             Cause.UNDECODABLE)):
        if counts:
            found.append(Finding(cause is Cause.DAMAGED_RECORDING, name, ', '.join(
                f'{fault}: {n}' for fault, n in counts.items()), advice, cause))
    return found
