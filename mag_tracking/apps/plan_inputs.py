"""The inputs of a plan from few numbers: what is not given comes from network and settings."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np

from mag_tracking.analysis.placement import PlannedTarget, Sampling
from mag_tracking.apps.plan import Area, Plan, compute_plan, detection_range, n_parts
from mag_tracking.apps.readings import network_of
from mag_tracking.errors import SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.stages.align.frame_period import frame_period
from mag_tracking.stages.track.initiation_vehicle import VehicleSettings
from mag_tracking.stages.track.settings import TrackSettings

NOISE_STD = 1.2e-8
"""[T] of one sample, where neither the caller nor the network file has another."""

CLEARANCE = 2.0
"""[m] between a lane for vehicles and a further sensor."""


@dataclass(frozen=True)
class PlanInputs:
    """Checked arguments of `compute_plan`."""

    target: PlannedTarget
    sampling: Sampling
    lanes: tuple[tuple[str, float, float], ...]
    """(name, heading [rad], lateral offset [m])."""
    area: Area
    clearance: float
    """[m]"""
    n_grid: int

    @property
    def n_parts(self) -> int:
        """How often `run` calls its `progress`."""
        return n_parts(self.lanes)

    def run(self, network: SensorNetwork, settings: Settings,
            progress: Callable[[int], object] | None = None) -> Plan:
        """The plan; `progress` is called with 1 whenever a part is done."""
        return compute_plan(network, self.target, self.sampling, self.lanes, self.area, settings,
                            self.clearance, self.n_grid, progress)


def plan_inputs(network: SensorNetwork, settings: Settings, target: str | None = None, *,
                moment: float | None = None, height: float | None = None, speed: float = 10.0,
                heading: Sequence[float] | None = None, offset: Sequence[float] | None = None,
                noise_std: float | None = None, rate: float = 100.0,
                field_error: float | None = None, area: Sequence[float] | None = None,
                clearance: float | None = None, grid: int = 41) -> PlanInputs:
    """Check and complete the inputs of a plan; see `plan`, which takes the same."""
    planned = _target(settings.track, target, moment, height, speed)
    lanes = _lanes(settings.track.vehicle, _floats(heading), _floats(offset))
    _within('grid', grid, 5, 200)
    sampling = _sampling(network, settings, noise_std, rate, field_error)
    reach = detection_range(planned, float(np.median(sampling.noise_std)), 3,
                            settings.detect.false_alarm_probability)
    sampling = replace(sampling, half_window=1.2 * reach / planned.speed)
    if clearance is None:
        clearance = CLEARANCE if moment is None else 0.0
    return PlanInputs(planned, sampling, lanes, _area(network, reach, _floats(area)),
                      _within('clearance', clearance, 0.0, 1e6), grid)


def plan(network: SensorNetwork | str | PathLike[str], target: str | None = None, *,
         moment: float | None = None, height: float | None = None, speed: float = 10.0,
         heading: Sequence[float] | None = None, offset: Sequence[float] | None = None,
         noise_std: float | None = None, rate: float = 100.0, field_error: float | None = None,
         area: Sequence[float] | None = None, clearance: float | None = None, grid: int = 41,
         settings: Mapping[str, Any] | None = None) -> Plan:
    """Bounds and detection for a target that passes a network; one more sensor.

    Parameters
    ----------
    network : SensorNetwork or path of a network file
    target : str, optional
        A kind of vehicle of the settings ('small', 'car', 'truck'; default: 'car'), which gives
        moment and height; or 'magnet', which needs both.
    moment, height : float [A m^2], [m], optional
        Of the target instead.
    speed : float [m/s]
    heading, offset : sequence of float [deg], [m], optional
        Of the lanes: 0 = along x, anticlockwise; to the left of the line through the middle of
        the sensors. The arrivals of the settings and 0 if left out.
    noise_std : float [T], optional
        Noise of one sample. That of the network file, or 12 nT, if left out.
    rate : float [Hz]
        Samples per second and sensor.
    field_error : float, optional
        Relative error of the field; `track.field_error` if left out.
    area : (x0, y0, x1, y1) [m], optional
        Of the maps; as far as half of the targets are detected if left out.
    clearance : float [m], optional
        No further sensor nearer to a lane; 2 for vehicles, 0 with `moment`, if left out.
    grid : int
        Points of the maps on their longer side.
    settings : {name: value}, optional
        What differs from the defaults of the target.

    Returns
    -------
    Plan

    Raises
    ------
    SettingsError
        If an input is out of range; the message names it.
    NetworkError
        If the network file is not valid.
    """
    network = network_of(network)
    tree = settings_for('magnet' if target == 'magnet' else 'vehicle', settings)
    inputs = plan_inputs(
        network, tree, target, moment=moment, height=height, speed=speed, heading=heading,
        offset=offset, noise_std=noise_std, rate=rate, field_error=field_error, area=area,
        clearance=clearance, grid=grid)
    return inputs.run(network, tree)


def _within(name: str, value: float, low: float, high: float) -> float:
    """`value`, or a SettingsError."""
    if not low <= value <= high:
        raise SettingsError(f'{name}: expected {low:g} to {high:g}, got {value:g}')
    return value


def _floats(values: Sequence[float] | None) -> list[float] | None:
    """Numbers of a list or an array."""
    return None if values is None else [float(v) for v in values]


def _target(track: TrackSettings, target: str | None, moment: float | None,
            height: float | None, speed: float) -> PlannedTarget:
    """The target of a kind, or of a moment and a height."""
    vehicle = track.vehicle
    _within('speed', speed, 1e-4, 1e3)
    if height is not None:
        _within('height', height, -1e3, 1e3)
    if moment is not None:
        if target not in (None, 'magnet'):
            raise SettingsError('target: give one of target and moment')
        if height is None:
            raise SettingsError('height: needed with a moment')
        return PlannedTarget(_within('moment', moment, 1e-6, 1e6), height, speed)
    if target == 'magnet':
        raise SettingsError('moment: needed for a magnet, and height')
    kind = target or 'car'
    if kind not in vehicle.kinds:
        raise SettingsError(f'target: expected one of {", ".join(vehicle.kinds)}, magnet; got '
                            f'{kind!r}')
    k = vehicle.kinds.index(kind)
    return PlannedTarget(vehicle.moments[k], vehicle.heights[k] if height is None else height,
                         speed, vehicle.height_stds[k], vehicle.climb_std)


def _lanes(vehicle: VehicleSettings, heading: Sequence[float] | None,
           offset: Sequence[float] | None) -> tuple[tuple[str, float, float], ...]:
    """(name, heading [rad], offset [m]) of each lane."""
    names: Sequence[str]
    if heading is None:
        names, heading = vehicle.arrival_names, vehicle.arrival_headings_deg
    else:
        names = [f'{angle:g} deg' for angle in heading]
    offsets = offset or [0.0] * len(heading)
    if len(offsets) != len(heading):
        raise SettingsError(f'offset: expected {len(heading)} numbers, one a lane '
                            f'({", ".join(names)}), got {len(offsets)}')
    for value in heading:
        _within('heading', value, -1e5, 1e5)
    for value in offsets:
        _within('offset', value, -1e5, 1e5)
    if offset:
        names = [f'{name}, {value:+g} m' for name, value in zip(names, offset, strict=True)]
    lanes = tuple(zip(names, map(math.radians, heading), offsets, strict=True))
    if len(set(lanes)) < len(lanes):
        raise SettingsError('heading: a lane is there twice; give each its offset')
    return lanes


def _sampling(network: SensorNetwork, settings: Settings, noise_std: float | None, rate: float,
              field_error: float | None) -> Sampling:
    """The sampling, but for how long the target is followed.

    An error of the field that lasts tells as little in many frames as in one: it counts as so much
    more noise in each (the architecture page says why the tracker has it as a state).
    """
    track = settings.track
    period = max(frame_period(settings.align, network), 1.0 / _within('rate', rate, 1e-2, 1e5))
    if noise_std is not None:
        _within('noise_std', noise_std, 1e-15, 1e-3)
    noise = np.array([noise_std or NOISE_STD if std is None or noise_std
                      else float(np.sqrt(np.mean(np.square(std)))) for std in network.noise_std])
    error = _within('field_error', track.field_error if field_error is None else field_error,
                    0.0, 0.9)
    lasting = max(1.0, 2.0 * track.model_error_time_s / period)
    return Sampling(period, noise / math.sqrt(max(1.0, rate * period)), error * math.sqrt(lasting))


def _area(network: SensorNetwork, reach: float, area: Sequence[float] | None) -> Area:
    """(x0, y0, x1, y1) [m] of the maps."""
    low, high = network.positions[:, :2].min(axis=0), network.positions[:, :2].max(axis=0)
    if area is not None and len(area) != 4:
        raise SettingsError(f'area: expected X0, Y0, X1, Y1, got {area}')
    x0, y0, x1, y1 = area or [*(low - reach), *(high + reach)]
    if not (x1 > x0 and y1 > y0):
        raise SettingsError(f'area: expected X0 < X1 and Y0 < Y1, got {area}')
    for side in (x1 - x0, y1 - y0):
        _within('area: a side', side, 1e-3, 1e5)
    _within('area: its longer side over the other', max((x1 - x0) / (y1 - y0),
                                                        (y1 - y0) / (x1 - x0)), 1.0, 50.0)
    return x0, y0, x1, y1
