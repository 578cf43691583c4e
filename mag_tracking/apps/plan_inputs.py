"""Inputs of a plan; missing values are taken from the network and the settings."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

from mag_tracking.analysis.placement import PlannedTarget, Sampling
from mag_tracking.errors import SettingsError
from mag_tracking.inference.crlb import snr_range
from mag_tracking.inference.detection_theory import energy_threshold
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings
from mag_tracking.stages.align.stage import frame_period
from mag_tracking.stages.track.initiation_vehicle import CLIMB_STD, VehicleSettings

NOISE_STD = 1.2e-8
"""Default noise of one sample [T]."""
CLEARANCE = 2.0
"""Default minimum distance between a lane for vehicles and an additional sensor [m]."""
Area: TypeAlias = tuple[float, float, float, float]
"""Rectangle (x0, y0, x1, y1) [m]."""
LaneLine: TypeAlias = tuple[str, float, float]
"""Name, heading [rad], and lateral offset [m] from the centre of the sensors, positive to the left
of the heading."""


class PlanInputs(NamedTuple):
    """Checked arguments of `compute_plan`."""

    network: SensorNetwork
    target: PlannedTarget
    sampling: Sampling
    lanes: tuple[LaneLine, ...]
    area: Area
    settings: Settings
    clearance: float
    n_grid: int


def plan_inputs(network: SensorNetwork, settings: Settings, target: str | None,
                moment: float | None, height: float | None, speed: float,
                heading: Sequence[float] | None, offset: Sequence[float] | None,
                noise_std: float | None, rate: float, field_error: float | None,
                area: Sequence[float] | None, clearance: float | None, grid: int) -> PlanInputs:
    """Check and complete the inputs of `plan`; raises SettingsError that begins with the name of
    the invalid one."""
    planned_target = _target(settings.track.vehicle, target, moment, height, speed)
    lanes = _lanes(settings.track.vehicle, _to_floats(heading), _to_floats(offset))
    _in_range('grid', grid, 5, 200)
    sampling = _sampling(network, settings, noise_std, rate, field_error)
    # Range at which one sensor detects half of the targets in one frame, [T10]_ eq. (5.20). The
    # energy is averaged over all directions of the moment: twice that perpendicular to its axis.
    range_m = float(snr_range(np.sqrt(2.0) * planned_target.moment,
                              float(np.median(sampling.noise_std)),
                              energy_threshold(settings.detect.false_alarm_probability, 3)))
    sampling = replace(sampling, half_window=1.2 * range_m / planned_target.speed)
    if sampling.half_window < sampling.period:
        # A single frame does not separate the field from the unknown background.
        raise SettingsError(
            f'speed: expected less than {1.2 * range_m / sampling.period:.3g} m/s, got {speed:g}: '
            f'a faster target is within {1.2 * range_m:.3g} m of a sensor for less than two frames '
            f'of {sampling.period:.3g} s (align.period_s, rate)')
    if clearance is None:
        clearance = CLEARANCE if moment is None else 0.0
    return PlanInputs(network, planned_target, sampling, lanes,
                      _area(network, range_m, _to_floats(area)), settings,
                      _in_range('clearance', clearance, 0.0, 1e6), grid)


def _in_range(name: str, value: float, low: float, high: float) -> float:
    if not low <= value <= high:
        raise SettingsError(f'{name}: expected {low:g} to {high:g}, got {value:g}')
    return value


def _to_floats(values: Sequence[float] | None) -> list[float] | None:
    return None if values is None else [float(v) for v in values]


def _target(vehicle: VehicleSettings, target: str | None, moment: float | None,
            height: float | None, speed: float) -> PlannedTarget:
    _in_range('speed', speed, 1e-4, 1e3)
    if height is not None:
        _in_range('height', height, -1e3, 1e3)
    if moment is not None:
        if target not in (None, 'magnet'):
            raise SettingsError('target: give either target or moment, not both')
        if height is None:
            raise SettingsError('height: required together with moment')
        return PlannedTarget(_in_range('moment', moment, 1e-6, 1e6), height, speed)
    if target == 'magnet':
        raise SettingsError('moment: required for a magnet, together with height')
    name, kinds = target or 'car', {k.name: k for k in vehicle.kinds}
    if name not in kinds:
        raise SettingsError(f'target: expected one of {", ".join(kinds)}, magnet, got {name!r}')
    kind = kinds[name]
    return PlannedTarget(kind.moment, kind.height if height is None else height, speed,
                         kind.height_std, CLIMB_STD)


def _lanes(vehicle: VehicleSettings, heading: Sequence[float] | None,
           offset: Sequence[float] | None) -> tuple[LaneLine, ...]:
    """Create the lanes (name, heading [rad], offset [m])."""
    names: Sequence[str]
    if heading is None:
        names, heading = vehicle.arrival_names, vehicle.arrival_headings_deg
    else:
        names = [f'{angle:g} deg' for angle in heading]
    offsets = offset or [0.0] * len(heading)
    if len(offsets) != len(heading):
        raise SettingsError(f'offset: expected {len(heading)} numbers, one per lane '
                            f'({", ".join(names)}), got {len(offsets)}')
    for key, values in (('heading', heading), ('offset', offsets)):
        for value in values:
            _in_range(key, value, -1e5, 1e5)
    if offset:
        names = [f'{name}, {value:+g} m' for name, value in zip(names, offset, strict=True)]
    lanes = tuple(zip(names, map(math.radians, heading), offsets, strict=True))
    if len(set(lanes)) < len(lanes):
        raise SettingsError('heading: two lanes are equal; give them different offsets')
    return lanes


def _sampling(network: SensorNetwork, settings: Settings, noise_std: float | None, rate: float,
              field_error: float | None) -> Sampling:
    """Sampling of the sensors; the caller sets `half_window`.

    A field error that persists over many frames is not averaged out. It is represented here by
    additional noise in each frame, whereas the tracker estimates it as a state.
    """
    track = settings.track
    period = max(frame_period(settings.align, network), 1.0 / _in_range('rate', rate, 1e-2, 1e5))
    if noise_std is not None:
        _in_range('noise_std', noise_std, 1e-15, 1e-3)
    noise = np.array([noise_std or NOISE_STD if std is None or noise_std
                      else float(np.sqrt(np.mean(np.square(std)))) for std in network.noise_std])
    error = _in_range('field_error', track.field_error if field_error is None else field_error,
                      0.0, 0.9)
    n_frames = max(1.0, 2.0 * track.model_error_time_s / period)
    return Sampling(period, noise / math.sqrt(max(1.0, rate * period)), error * math.sqrt(n_frames))


def _area(network: SensorNetwork, range_m: float, area: Sequence[float] | None) -> Area:
    """Return the checked `area`; default: the sensors' bounding box extended by `range_m` [m]."""
    if area is not None and len(area) != 4:
        raise SettingsError(f'area: expected X0, Y0, X1, Y1, got {area}')
    r = network.positions[:, :2]
    x0, y0, x1, y1 = area or [*(r.min(axis=0) - range_m), *(r.max(axis=0) + range_m)]
    if not (x1 > x0 and y1 > y0):
        raise SettingsError(f'area: expected X0 < X1 and Y0 < Y1, got {area}')
    short, long = sorted((x1 - x0, y1 - y0))
    for side in (x1 - x0, y1 - y0):
        _in_range('area: a side', side, 1e-3, 1e5)
    _in_range('area: ratio of its sides', long / short, 1.0, 50.0)
    return x0, y0, x1, y1
