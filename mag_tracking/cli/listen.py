"""Command `mag-tracking listen`."""

import argparse
import math
import signal
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.drivers.configuration import read_drivers
from mag_tracking.drivers.driver import IGNORED, Driver, serve
from mag_tracking.drivers.sensor_checks import WEAK_FIELD
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network.file import read_network
from mag_tracking.quantities import quantity
from mag_tracking.records import AccelerationSample, Readings

Sample: TypeAlias = tuple[int, FloatArray | None]
"""Timestamp [ns], and field (3,) [T] or None for an acceleration."""

_LISTEN_HELP = '''
Opens the devices of a drivers file and prints, once per second, the state and error counts of
each device and the rate and field of each sensor. The command needs no ROS and is suitable as the
first test of a new connection. Ctrl-C ends the command. The exit status is 1 if a sensor has sent
no readings.

examples:
  mag-tracking listen config/drivers.yaml
  mag-tracking listen roadside.yaml --network site.yaml --seconds 10
'''

MAX_PLAUSIBLE_FIELD = 1e-3
"""[T] A larger field suggests a nearby magnet or a wrong unit."""


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'listen', _listen, _LISTEN_HELP)
    p.add_argument('drivers', type=Path, metavar='DRIVERS', help='file that lists the devices')
    add_network(p, False, 'network file; check that its sensors match the drivers file')
    p.add_argument('--seconds', type=float, default=math.inf, metavar='N',
                   help='exit after N seconds (default: at Ctrl-C)')


class _ReadingPrinter:
    """Runs one driver in a thread and formats the readings received since the last report."""

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self._samples: dict[str, deque[Sample]] = {
            sensor: deque(maxlen=20_000) for sensor in driver.sensors.values()
            if sensor != IGNORED}
        self.silent_sensors = set(self._samples)
        self._counts: Counter[str] = Counter()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=serve, daemon=True, args=(
            driver, self._add, self._stop.is_set))
        self._thread.start()

    def _add(self, readings: Readings, accelerations: Iterable[AccelerationSample]) -> None:
        for name, stamp, field in zip(readings.sensor_names(), readings.stamp_ns.tolist(),
                                      readings.field, strict=True):
            self._samples[name].append((stamp, field))
        for a in accelerations:
            self._samples[a.sensor].append((a.stamp_ns, None))

    def stop(self) -> None:
        """Stop the thread; it closes the device when it ends."""
        self._stop.set()
        self._thread.join(10.0)

    def lines(self, elapsed_s: float) -> list[str]:
        """Describe the device state and the samples of the `elapsed_s` [s] since the last call."""
        counts = self.driver.counts()
        errors = ', '.join(f'{count}: {n}' for count, n in sorted(counts.items())
                           if not count.startswith('samples: '))
        state = self.driver.fault or ('open' if self.driver.is_open else 'opening')
        out = [f'{self.driver.name}: {state}' + (f'  ({errors})' if errors else '')]
        out += [f'  {cause}, such as {example}' for cause, example in
                self.driver.examples().items() if counts[cause] > self._counts[cause]]
        self._counts = counts
        for sensor, queue in self._samples.items():
            samples = [queue.popleft() for _ in range(len(queue))]
            if not samples:
                out.append(f'  {sensor:12s} no readings')
                continue
            self.silent_sensors.discard(sensor)
            age_ms = (time.time_ns() - max(stamp for stamp, _ in samples)) / 1e6
            out.append(f'  {sensor:12s} {_sample_line(samples, elapsed_s)}  latest {age_ms:.0f} ms '
                       'ago')
        return out


def _sample_line(samples: Sequence[Sample], elapsed_s: float) -> str:
    """Format rate, mean field and warnings of one sensor for the last `elapsed_s` [s]."""
    fields = np.array([field for _, field in samples if field is not None])
    if not len(fields):
        return f'{len(samples) / elapsed_s:7.1f} Hz of accelerations'
    is_valid = ~np.isnan(fields)
    mean = np.array([1e6 * column[known].mean() if known.any() else np.nan
                     for column, known in zip(fields.T, is_valid.T, strict=True)])
    line = (f'{len(fields) / elapsed_s:7.1f} Hz  ' + ' '.join(f'{v:9.3f}' for v in mean)
            + f' uT  |B| {np.sqrt(np.nansum(mean**2)):8.3f}')
    n_missing = fields.size - np.count_nonzero(is_valid)
    if n_missing and is_valid.any(axis=0).all():
        line += f'  {quantity(n_missing, "value")} missing'
    strength = np.linalg.norm(fields, axis=1)
    if np.nanmax(np.abs(fields), initial=0.0) > MAX_PLAUSIBLE_FIELD:
        line += '  (very large; check `unit`)'
    elif np.nanmax(strength, initial=-1.0) < WEAK_FIELD and is_valid.all(axis=1).any():
        line += "  (below 10 uT, weaker than the Earth's field; check `unit`)"
    return line


def _listen(args: argparse.Namespace) -> int:
    if not args.seconds > 0.0:
        raise SettingsError(f'--seconds: expected a number above 0, got {args.seconds:g}')
    network = read_network(args.network) if args.network else None
    printers = [_ReadingPrinter(driver) for driver in read_drivers(args.drivers, network)]
    end = time.monotonic() + args.seconds
    last_report = time.monotonic()
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as signals:
        while not signals and last_report < end:
            while not signals and time.monotonic() < min(last_report + 1.0, end):
                time.sleep(0.02)
            now = time.monotonic()
            for line in [line for printer in printers for line in printer.lines(now - last_report)]:
                print(line, flush=True)
            last_report = now
    for printer in printers:
        printer.stop()
    return int(any(printer.silent_sensors for printer in printers))
