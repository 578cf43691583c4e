"""Inputs of a plan; missing values are taken from the network and the settings."""

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
from mag_tracking.stages.align.stage import frame_period
from mag_tracking.stages.track.initiation_vehicle import CLIMB_STD, VehicleSettings
from mag_tracking.stages.track.settings import TrackSettings

NOISE_STD = 1.2e-8
"""Default noise of one sample [T]."""

CLEARANCE = 2.0
"""Default minimum distance between a lane for vehicles and an additional sensor [m]."""


@dataclass(frozen=True)
class PlanInputs:
    """Checked arguments of `compute_plan`."""

    target: PlannedTarget
    """Assumed target."""
    sampling: Sampling
    """Noise and sampling of the sensors."""
    lanes: tuple[tuple[str, float, float], ...]
    """(name, heading [rad], lateral offset [m]) of each lane."""
    area: Area
    """Area of the maps (x0, y0, x1, y1) [m]."""
    clearance: float
    """Minimum distance of an additional sensor from a lane [m]."""
    n_grid: int
    """Number of points along the longer side of the maps."""

    @property
    def n_parts(self) -> int:
        """Number of times that `run` calls `progress`."""
        return n_parts(self.lanes)

    def run(self, network: SensorNetwork, settings: Settings,
            progress: Callable[[int], object] | None = None) -> Plan:
        """Compute the plan; `progress` is called with 1 for each of its `n_parts` parts."""
        return compute_plan(network, self.target, self.sampling, self.lanes, self.area, settings,
                            self.clearance, self.n_grid, progress)


def plan_inputs(network: SensorNetwork, settings: Settings, target: str | None = None, *,
                moment: float | None = None, height: float | None = None, speed: float = 10.0,
                heading: Sequence[float] | None = None, offset: Sequence[float] | None = None,
                noise_std: float | None = None, rate: float = 100.0,
                field_error: float | None = None, area: Sequence[float] | None = None,
                clearance: float | None = None, grid: int = 41) -> PlanInputs:
    """Check and complete the inputs of a plan, which are described in `plan`.

    Raises SettingsError if one is out of range; the message begins with its name.
    """
    planned_target = _target(settings.track, target, moment, height, speed)
    lanes = _lanes(settings.track.vehicle, _to_floats(heading), _to_floats(offset))
    _in_range('grid', grid, 5, 200)
    sampling = _sampling(network, settings, noise_std, rate, field_error)
    range_m = detection_range(planned_target, float(np.median(sampling.noise_std)), 3,
                              settings.detect.false_alarm_probability)
    sampling = replace(sampling, half_window=1.2 * range_m / planned_target.speed)
    if clearance is None:
        clearance = CLEARANCE if moment is None else 0.0
    return PlanInputs(planned_target, sampling, lanes, _area(network, range_m, _to_floats(area)),
                      _in_range('clearance', clearance, 0.0, 1e6), grid)


def plan(network: SensorNetwork | str | PathLike[str], target: str | None = None, *,
         moment: float | None = None, height: float | None = None, speed: float = 10.0,
         heading: Sequence[float] | None = None, offset: Sequence[float] | None = None,
         noise_std: float | None = None, rate: float = 100.0, field_error: float | None = None,
         area: Sequence[float] | None = None, clearance: float | None = None, grid: int = 41,
         settings: Mapping[str, Any] | None = None) -> Plan:
    """Predict accuracy, detection and the best position of an additional sensor.

    Parameters
    ----------
    network : SensorNetwork or path of a network file
    target : str, optional
        Kind of vehicle ('small', 'car' or 'truck'; default: 'car'), whose moment and height are in
        the settings; or 'magnet', which requires `moment` and `height`.
    moment : float, A m², optional
        Magnitude of the moment; requires `height`.
    height : float, m, optional
        Height of the magnetic centre, z in the frame of the network.
    speed : float, m/s
        Speed of the target.
    heading : sequence of float, deg, optional
        Heading of each lane, measured anticlockwise from x; default: the arrival directions in the
        settings.
    offset : sequence of float, m, optional
        Lateral offset of each lane from the centre of the sensors, positive to the left of the
        heading; default: 0.
    noise_std : float, T, optional
        Noise of one sample; default: the noise in the network file, or 12 nT.
    rate : float, Hz
        Sample rate of each sensor.
    field_error : float, optional
        Relative error of the field; default: `track.field_error`.
    area : (x0, y0, x1, y1), m, optional
        Area of the maps; default: the bounding box of the sensors, extended by the range at which a
        sensor detects half of the targets.
    clearance : float, m, optional
        Minimum distance of an additional sensor from a lane; default: 2, or 0 if
        `moment` is given.
    grid : int
        Number of points along the longer side of the maps.
    settings : {name: value}, optional
        Settings that differ from the defaults of the target.

    Returns
    -------
    Plan

    Raises
    ------
    SettingsError
        If an input is out of range; the message begins with its name.
    NetworkError
        If the network file is invalid.
    """
    network = network_of(network)
    full_settings = settings_for('magnet' if target == 'magnet' else 'vehicle', settings)
    inputs = plan_inputs(
        network, full_settings, target, moment=moment, height=height, speed=speed, heading=heading,
        offset=offset, noise_std=noise_std, rate=rate, field_error=field_error, area=area,
        clearance=clearance, grid=grid)
    return inputs.run(network, full_settings)


def _in_range(name: str, value: float, low: float, high: float) -> float:
    """Return `value`; raises SettingsError if it is out of range."""
    if not low <= value <= high:
        raise SettingsError(f'{name}: expected {low:g} to {high:g}, got {value:g}')
    return value


def _to_floats(values: Sequence[float] | None) -> list[float] | None:
    """Convert the values of a list or array to float."""
    return None if values is None else [float(v) for v in values]


def _target(track: TrackSettings, target: str | None, moment: float | None,
            height: float | None, speed: float) -> PlannedTarget:
    """Create the target from its kind, or from its moment and height."""
    vehicle = track.vehicle
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
           offset: Sequence[float] | None) -> tuple[tuple[str, float, float], ...]:
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
    for value in heading:
        _in_range('heading', value, -1e5, 1e5)
    for value in offsets:
        _in_range('offset', value, -1e5, 1e5)
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
    low, high = network.positions[:, :2].min(axis=0), network.positions[:, :2].max(axis=0)
    if area is not None and len(area) != 4:
        raise SettingsError(f'area: expected X0, Y0, X1, Y1, got {area}')
    x0, y0, x1, y1 = area or [*(low - range_m), *(high + range_m)]
    if not (x1 > x0 and y1 > y0):
        raise SettingsError(f'area: expected X0 < X1 and Y0 < Y1, got {area}')
    for side in (x1 - x0, y1 - y0):
        _in_range('area: a side', side, 1e-3, 1e5)
    _in_range('area: ratio of its sides', max((x1 - x0) / (y1 - y0),
                                              (y1 - y0) / (x1 - x0)), 1.0, 50.0)
    return x0, y0, x1, y1
