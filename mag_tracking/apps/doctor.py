"""Diagnosis of a network, its readings and the computer that receives them, for `doctor`."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping

import numpy as np

from mag_tracking.calibration.agreement import SurveySettings
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, Settings, Step
from mag_tracking.recording.message_block import Progress
from mag_tracking.records import Readings
from mag_tracking.run import RecordingSource, run
from mag_tracking.stages.align.stage import frame_period_warning
from mag_tracking.stages.calibrate.field_comparison import (
    compared_with_earth,
    earth_field_findings,
)
from mag_tracking.stages.calibrate.stage import FAULTS_FOUND, Calibrate
from mag_tracking.stages.health.clocks import clock_findings
from mag_tracking.stages.health.diagnosis import Cause, Finding
from mag_tracking.stages.health.findings import (
    background_findings,
    covariance_findings,
    driver_findings,
    rate_findings,
    rejection_findings,
    source_findings,
)
from mag_tracking.stages.health.sensor_health import SensorHealth
from mag_tracking.units import NS

STALL_S = 0.25
"""[s] Minimum interval without a message from any sensor that counts as a stall."""
BURST_S = 0.05
"""[s] Time after a stall in which the delayed messages arrive."""
MIN_BURST = 3.0
"""Minimum number of messages in this time, relative to the mean."""
MIN_STALLS = 2
"""Number of stalls at which a computer is considered overloaded."""
MAX_FRACTION = 0.5
"""Fraction of the messages that arrive after stalls above which devices send them in packets."""
MIN_MISSED_TARGETS = 3
"""Number of consecutive missed targets at which a sensor is reported."""
LEVEL_STEP = 1e-8
"""Resolution to which levels are rounded before sensors are compared [T]; nearby iron changes the
field by about fifty times as much."""
TIME_CAUSES = frozenset({Cause.LOST, Cause.DELAY_VARIES, Cause.DELAYED, Cause.CLOCK_STEPPED})
"""Causes that an overloaded computer explains."""


class HostStalls:
    """Detects that messages of all sensors stop together and then arrive in a burst, because an
    overloaded computer, or the link that they share, delays them."""

    def __init__(self) -> None:
        self._sensors: set[str] = set()
        self._first_ns: int | None = None
        self._last_ns, self._n = 0, 0
        # Time of the latest stall, messages since then, and whether it has been counted.
        self._stall_ns, self._n_burst, self._gap_s = 0, 0, 0.0
        self.n_stalls, self.longest_s, self._n_delayed = 0, 0.0, 0

    def add(self, received_ns: int, sensors: Collection[str]) -> None:
        """Add a message received at `received_ns` with readings of `sensors`."""
        self._sensors.update(sensors)
        if self._first_ns is None:
            self._first_ns = self._last_ns = received_ns
        gap_s, elapsed_s = (received_ns - self._last_ns) / NS, (received_ns - self._first_ns) / NS
        self._last_ns, self._n = received_ns, self._n + 1
        if gap_s > STALL_S:
            self._stall_ns, self._n_burst, self._gap_s = received_ns, 0, gap_s
        if not self._gap_s:
            return
        self._n_burst += 1
        if received_ns - self._stall_ns > BURST_S * NS:
            self._gap_s = 0.0
        elif self._n_burst >= MIN_BURST * (1.0 + BURST_S * self._n / max(elapsed_s, STALL_S)):
            self.n_stalls += 1
            self.longest_s = max(self.longest_s, self._gap_s)
            self._n_delayed += round(self._gap_s * self._n / max(elapsed_s, STALL_S))
            self._gap_s = 0.0

    def findings(self) -> Iterator[Finding]:
        """Report an overloaded computer."""
        if len(self._sensors) > 1 and self.n_stalls >= MIN_STALLS \
                and self._n_delayed < MAX_FRACTION * self._n:
            yield Finding(False, 'computer', f'the messages of all sensors stopped {self.n_stalls} '
                          f'times, for up to {self.longest_s:.2g} s, and then arrived together',
                          'the computer is overloaded, or the link that the sensors share stalls: '
                          'reduce the load of the computer that receives the messages',
                          Cause.OVERLOADED)


def load_findings(found: Collection[Finding], sensors: Collection[str], load: float,
                  n_processors: int) -> Iterator[Finding]:
    """Report a `load` (processes that run or wait) above the number of processors if readings of
    all sensors are late or lost."""
    late = {f.subject for f in found if f.cause in TIME_CAUSES}
    if load > n_processors and sensors and late.issuperset(sensors):
        yield Finding(False, 'computer', f'{load:.1f} processes compete for '
                      f'{n_processors} processors: the computer is overloaded', 'reduce the load '
                      'of this computer', Cause.OVERLOADED)


def network_findings(network: SensorNetwork, survey: SurveySettings, calibrate: Calibrate,
                     sensors: Mapping[str, SensorHealth]) -> list[Finding]:
    """Diagnose faults that are visible only by comparing the clocks and the fields of sensors."""
    clocks = {name: health.clock for name, health in sensors.items()}
    findings = list(clock_findings({name: c for name, c in clocks.items() if c is not None}))
    backgrounds = calibrate.backgrounds()
    levels = np.array([
        calibrate.background(name) if backgrounds[name].measured
        and calibrate.last_stamp_ns(name) is not None else sensors[name].field
        for name in network.names])
    # Rounded levels stay equal during small changes, so that no new comparison is needed.
    levels = LEVEL_STEP * np.round(levels / LEVEL_STEP)
    try:
        return findings + earth_field_findings(compared_with_earth(network, survey, levels))
    except ValueError as error:
        return [*findings, Finding(False, 'network', f'sensors were not compared: {error}',
                                   'add earth_field or site to the network file',
                                   Cause.NOT_COMPARED)]


class Doctor:
    """Sink that diagnoses a network from its raw readings."""

    def __init__(self, pipeline: Pipeline) -> None:
        network = pipeline.network
        self.network, self.calibrate, self.pipeline = network, pipeline.calibrate, pipeline
        self.sensors = {name: SensorHealth() for name in network.names}
        self._settings = pipeline.settings
        self._clock_ns = dict(zip(network.names, network.clock_offset_ns.tolist(), strict=True))
        self._frozen_since_ns: dict[str, int] = {}
        # Latest consecutive targets that each sensor missed: {sensor that detected it: number}.
        self._missed: dict[str, Counter[str]] = {name: Counter() for name in network.names}
        self._n_faults_found, self._stalls = 0, HostStalls()

    def feed(self, readings: Readings, received_ns: int | None = None) -> None:
        """Process live readings, received at `received_ns`, in the pipeline, and add them."""
        self.add(Step(readings, received_ns, self.pipeline.feed(readings)))

    def add(self, step: Step) -> None:
        """Add the raw readings of a step."""
        readings, received_ns = step.readings, step.received_ns
        names, stamps = readings.sensor_names(), readings.stamp_ns.tolist()
        if received_ns is not None:
            self._stalls.add(received_ns, names)
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
                self._add_target(name, begin_ns)

    def _add_target(self, name: str, begin_ns: int) -> None:
        """Add a target that has passed and that sensor `name` detected from `begin_ns` on; other
        sensors missed it if their readings stayed constant."""
        for other, health in self.sensors.items():
            since_ns = health.unchanged_since_ns
            if since_ns is not None and since_ns < begin_ns:
                self._missed[other][name] += 1
            else:
                self._missed[other].clear()

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
        for name, missed in self._missed.items():
            for other, n in missed.most_common(1):
                if n >= MIN_MISSED_TARGETS:
                    found.append(Finding(
                        True, name, f'its readings did not change while {other} detected {n} '
                        'targets', 'move iron near the sensor to check whether it is stuck, too '
                        'far away, or too coarse', Cause.MISSED_TARGETS))
        found += network_findings(self.network, self._settings.survey, self.calibrate,
                                  self.sensors)
        warning = frame_period_warning(self._settings.align, self.network)
        if warning:
            found.append(Finding(True, 'align', warning, 'set align.period_s to 0 (automatic)',
                                 Cause.FRAMES_TOO_LONG))
        return found


def examine(source: RecordingSource, network: SensorNetwork, settings: Settings,
            progress: Progress | None = None, stopped: Callable[[], bool] | None = None
            ) -> tuple[Doctor, list[Finding]]:
    """Diagnose a network from a recording that is read by message; return the doctor, and findings
    about the recording, which it lacks."""
    doctor = Doctor(Pipeline(network, settings, 'calibrate'))
    run(source, doctor.pipeline, [doctor], progress, stopped)
    return doctor, source_findings(source.name, source.lost, source.rejected)
