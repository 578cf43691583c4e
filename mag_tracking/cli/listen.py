"""mag-tracking listen."""

import argparse
import math
import signal
import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.drivers.configuration import read_drivers
from mag_tracking.drivers.driver import IGNORED, Driver, serve
from mag_tracking.errors import SettingsError
from mag_tracking.interrupts import recorded_signals
from mag_tracking.network.file import read_network
from mag_tracking.records import AccelerationSample, Readings

Sample: TypeAlias = tuple[int, FloatArray | None]
"""Timestamp [ns] and field (3,) [T], or None for an acceleration."""

_LISTEN = '''
Opens the devices of a drivers file and prints what they say, once a second:
each sensor's rate, its field and what was lost; each device's trouble. No ROS is
needed: it is the first thing to try with a new cable. Ctrl-C ends it. The exit
status is 1 where a sensor has said nothing.

examples:
  mag-tracking listen config/drivers.yaml
  mag-tracking listen roadside.yaml --network site.yaml --seconds 10
'''

LARGE = 1e-3
"""[T] Larger fields are those of magnets, or of a wrong unit."""


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'listen', _listen, _LISTEN)
    p.add_argument('drivers', type=Path, metavar='DRIVERS', help='which devices there are')
    add_network(p, False, 'compare with its sensors')
    p.add_argument('--seconds', type=float, default=math.inf, metavar='N',
                   help='end after so long (default: at Ctrl-C)')


class _ReadingPrinter:
    """Keeps one driver going in a thread, and what it said in the last second."""

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self._heard: dict[str, deque[Sample]] = {
            sensor: deque(maxlen=20_000) for sensor in driver.sensors.values()
            if sensor != IGNORED}
        self.silent = set(self._heard)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=serve, daemon=True, args=(
            driver, self._take, self._stop.is_set))
        self._thread.start()

    def _take(self, readings: Readings, accelerations: Iterable[AccelerationSample]) -> None:
        """Keep what was said."""
        for name, stamp, field in zip(readings.sensor_names(), readings.stamp_ns.tolist(),
                                      readings.field, strict=True):
            self._heard[name].append((stamp, field))
        for a in accelerations:
            self._heard[a.sensor].append((a.stamp_ns, None))

    def stop(self) -> None:
        """Close the device."""
        self._stop.set()
        self._thread.join(10.0)

    def lines(self, elapsed_s: float) -> list[str]:
        """What was said since the last time."""
        counts = self.driver.counts()
        odd = ', '.join(f'{what}: {n}' for what, n in sorted(counts.items())
                        if not what.startswith('samples: '))
        state = self.driver.fault or ('open' if self.driver.is_open else 'not open yet')
        out = [f'{self.driver.name}: {state}' + (f'  ({odd})' if odd else '')]
        for sensor, heard in self._heard.items():
            samples = [heard.popleft() for _ in range(len(heard))]
            if not samples:
                out.append(f'  {sensor:12s} nothing')
                continue
            self.silent.discard(sensor)
            behind_ms = (time.time_ns() - max(stamp for stamp, _ in samples)) / 1e6
            out.append(f'  {sensor:12s} {_said(samples, elapsed_s)}  latest {behind_ms:.0f} ms ago')
        return out


def _said(samples: Sequence[Sample], elapsed_s: float) -> str:
    """What the samples of one sensor say, in a line."""
    fields = np.array([field for _, field in samples if field is not None])
    if not len(fields):
        return f'{len(samples) / elapsed_s:7.1f} Hz of accelerations'
    there = ~np.isnan(fields)
    mean = np.array([1e6 * column[known].mean() if known.any() else np.nan
                     for column, known in zip(fields.T, there.T, strict=True)])
    text = (f'{len(fields) / elapsed_s:7.1f} Hz  ' + ' '.join(f'{v:9.3f}' for v in mean)
            + f' uT  |B| {np.sqrt(np.nansum(mean**2)):8.3f}')
    missing = fields.size - np.count_nonzero(there)
    if missing and there.any(axis=0).all():
        text += f'  {missing} axes missing'
    if np.nanmax(np.abs(fields), initial=0.0) > LARGE:
        text += '  (is `unit` right?)'
    return text


def _listen(args: argparse.Namespace) -> int:
    """mag-tracking listen."""
    if not args.seconds > 0.0:
        raise SettingsError(f'--seconds: {args.seconds:g} is not a number above 0')
    network = read_network(args.network) if args.network else None
    ears = [_ReadingPrinter(driver) for driver in read_drivers(args.drivers, network)]
    end = time.monotonic() + args.seconds
    last = time.monotonic()
    with recorded_signals(signal.SIGINT, signal.SIGTERM) as seen:
        while not seen and last < end:
            while not seen and time.monotonic() < min(last + 1.0, end):
                time.sleep(0.02)
            now = time.monotonic()
            for line in [line for ear in ears for line in ear.lines(now - last)]:
                print(line, flush=True)
            last = now
    for ear in ears:
        ear.stop()
    return int(any(ear.silent for ear in ears))
