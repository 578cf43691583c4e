"""Prediction of accuracy and coverage of a sensor network before its installation."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any, TypeAlias

import numpy as np

from mag_tracking.analysis.placement import (
    DIRECTIONS,
    STATES,
    PlannedTarget,
    Sampling,
    bounds_of,
    detection_probabilities,
    pass_fields,
    pass_information,
)
from mag_tracking.apps.readings import network_of
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import SettingsError
from mag_tracking.inference.crlb import Observability, observability, path_bound, snr_range
from mag_tracking.inference.detection_theory import energy_threshold, missed_detection_probability
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.motion import constant_velocity, integrator_noise
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.stages.align.frame_period import frame_period
from mag_tracking.stages.track.initiation_vehicle import CLIMB_STD, VehicleSettings
from mag_tracking.stages.track.settings import TrackSettings, acceleration_density

MAX_FRAMES = 1000
"""Maximum number of frames per pass in the calculation of the miss probability. Additional frames
of slower passes hardly change this probability."""

Area: TypeAlias = tuple[float, float, float, float]
"""Rectangle (x0, y0, x1, y1) [m]."""

GOOD_PD = 0.9
"""Detection probability per frame at which a target counts as detectable."""


@dataclass(frozen=True)
class Lane:
    """Straight lane, with Cramér-Rao bounds and detection probabilities along the lane."""

    name: str
    """Name in messages and figures."""
    heading: float
    """Heading, anticlockwise from x [rad]."""
    along: FloatArray
    """(n,) m, signed distance from the point nearest to the centre of the sensors."""
    points: FloatArray
    """(n, 2) m, points of the lane, world frame."""
    pass_std: FloatArray
    """(n, 3) m, m/s, A m²: bounds of position, velocity and moment from the whole pass; median over
    the directions of the moment."""
    filter_std: FloatArray
    """(n,) m, position bound of a filter that has processed the measurements up to the point."""
    detection: FloatArray
    """(n,) probability that a frame detects the target; mean over the directions of the moment."""


@dataclass(frozen=True)
class Plan:
    """Predicted performance of a network; maps are indexed [y, x]."""

    network: SensorNetwork
    """Planned network."""
    target: PlannedTarget
    """Assumed target."""
    sampling: Sampling
    """Noise and sampling of the sensors."""
    x: FloatArray
    """(nx,) m, coordinates of the maps."""
    y: FloatArray
    """(ny,) m, coordinates of the maps."""
    position_std: FloatArray
    """(ny, nx) m, bound of the position from a whole pass through the point; median over headings
    and directions of the moment."""
    detection: FloatArray
    """(ny, nx) probability that one frame detects the target at the point."""
    lanes: tuple[Lane, ...]
    """Lanes through the network."""
    std_with_added_sensor: FloatArray
    """(my, mx) m, coarser map of the median position bound on the lanes near the network if a
    sensor is added at the point; NaN where no sensor is allowed."""
    std_without_added_sensor: float
    """Median position bound on the lanes near the network without an additional sensor [m]; NaN if
    no additional sensor is allowed."""
    best_position: tuple[float, float]
    """Best position of the additional sensor (x, y) [m]; not valid if no sensor is allowed."""
    observability: Observability
    """Observability at the closest point of the first lane, for one direction of the moment,
    without priors."""
    bounds_at_closest: dict[str, FloatArray]
    """{'with prior' or 'without prior': (3,) bounds of position [m], velocity [m/s] and moment
    [A m²]} at the closest point of the first lane; medians over the directions of the moment."""
    miss_curve: FloatArray
    """(n, 2) lateral distance [m] of a pass with the heading of the first lane, and probability
    that the pass is missed."""


def detection_range(target: PlannedTarget, noise_std: float, n_axes: int,
                    false_alarm: float) -> float:
    """Approximate range [m] at which one sensor detects half of the targets in one frame, [T10]_
    eq. (5.20).

    `noise_std` [T] is that of one axis. The signal energy is averaged over all directions of the
    moment: twice the energy at a point perpendicular to the axis of the dipole.
    """
    return float(snr_range(np.sqrt(2.0) * target.moment, noise_std,
                           energy_threshold(false_alarm, n_axes)))


def compute_plan(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                 lanes: Sequence[tuple[str, float, float]], area: Area, settings: Settings,
                 clearance: float = 0.0, n_grid: int = 41,
                 progress: Callable[[int], object] | None = None) -> Plan:
    """Compute bounds, detection probabilities and the best position of an additional sensor.

    Parameters
    ----------
    lanes : (name, heading [rad], lateral offset [m] from the centre of the sensors, positive to the
        left of the heading)
    area : (x0, y0, x1, y1), m, of the maps
    clearance : minimum distance of an additional sensor from a lane, m
    n_grid : number of points along the longer side of the maps
    progress : called with 1 whenever one of the `n_parts` parts is completed
    """
    report_part = progress or (lambda n: None)
    x, y = _grid(area, n_grid)
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    bounds = []
    for heading in sorted({heading % np.pi for _, heading, _ in lanes}):
        bounds.append(_position_bounds(network, target, sampling, points, heading))
        report_part(1)
    detect = settings.detect
    probability = detection_probabilities(
        network.positions, network.R_sw, target, sampling, points, detect.false_alarm_probability,
        detect.background_std)
    report_part(1)
    planned = tuple(_lane(network, target, sampling, *lane, area, settings) for lane in lanes)
    report_part(1)
    # The effect of the additional sensor is evaluated where the lanes are near the network.
    half_length = 0.5 * max(np.ptp(network.positions[:, :2], axis=0).max(), 8.0 * target.height)
    near = [(lane.heading, lane.points[np.abs(lane.along) <= half_length][::4]) for lane in planned]
    coarse_x, coarse_y = _grid(area, max(11, n_grid // 2))
    sites = np.stack(np.meshgrid(coarse_x, coarse_y), axis=-1).reshape(-1, 2)
    is_allowed = np.all([_lane_distances(lane, sites) >= clearance for lane in planned], axis=0)
    median_bound = np.full(len(sites), np.nan)
    without, with_sensor = _added_sensor_bounds(network, target, sampling, near, sites[is_allowed])
    median_bound[is_allowed] = with_sensor
    report_part(1)
    best_index = int(np.nanargmin(median_bound)) if is_allowed.any() else 0
    lane_observability, closest_bounds = _closest_point_bounds(
        network, target, sampling, planned[0], half_length)
    shape = len(coarse_y), len(coarse_x)
    return Plan(
        network, target, sampling, x, y,
        np.median(np.concatenate(bounds, axis=1), axis=1).reshape(len(y), len(x)),
        probability.mean(axis=1).reshape(len(y), len(x)), planned,
        median_bound.reshape(shape), without,
        (float(coarse_x[best_index % shape[1]]), float(coarse_y[best_index // shape[1]])),
        lane_observability, closest_bounds,
        _miss_probabilities(network, target, sampling, planned[0], area, settings))


def _position_bounds(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                     points: FloatArray, heading: float) -> FloatArray:
    """Position bounds (n, n_directions) [m] of passes through points, per moment direction."""
    J = pass_information(network.positions, network.R_sw, target, sampling, points, heading)
    return bounds_of(J.sum(axis=2), target.prior())[..., 0]


def _closest_point_bounds(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                          lane: Lane, distance_scale: float,
                          ) -> tuple[Observability, dict[str, FloatArray]]:
    """Compute `Plan.observability`, with positions in units of `distance_scale` [m], and
    `Plan.bounds_at_closest`."""
    closest = lane.points[np.argmin(np.abs(lane.along))][None]
    J = pass_information(network.positions, network.R_sw, target, sampling, closest,
                         lane.heading)[0].sum(axis=1)
    scale = np.repeat([max(distance_scale, 1e-3), target.speed, target.moment], 3)
    return (observability(J[3], STATES, scale),
            {'with prior': np.median(bounds_of(J, target.prior()), axis=0),
             'without prior': np.median(bounds_of(J, np.zeros((9, 9))), axis=0)})


def _lane_distances(lane: Lane, points: FloatArray) -> FloatArray:
    """Distances (n,) [m] of `points` (n, 2) from the centre line of a lane."""
    u = lane.points[-1] - lane.points[0]
    r = points - lane.points[0]
    distance: FloatArray = np.abs(u[0] * r[:, 1] - u[1] * r[:, 0]) / np.hypot(*u)
    return distance


def n_parts(lanes: Sequence[tuple[str, float, float]]) -> int:
    """Number of times that `compute_plan` calls `progress`."""
    return len({heading % np.pi for _, heading, _ in lanes}) + 3


def _grid(area: Area, n: int) -> tuple[FloatArray, FloatArray]:
    """Coordinates (x, y) of a map with square cells and `n` points along the longer side."""
    x0, y0, x1, y1 = area
    cell = max(x1 - x0, y1 - y0) / (n - 1)
    return (np.linspace(x0, x1, max(2, int(round((x1 - x0) / cell)) + 1), dtype=float),
            np.linspace(y0, y1, max(2, int(round((y1 - y0) / cell)) + 1), dtype=float))


def _lane(network: SensorNetwork, target: PlannedTarget, sampling: Sampling, name: str,
          heading: float, offset: float, area: Area, settings: Settings) -> Lane:
    """Compute bounds and detection probabilities along one lane."""
    u = np.array([np.cos(heading), np.sin(heading)])
    half_length = 0.5 * np.hypot(area[2] - area[0], area[3] - area[1])
    n = int(np.clip(half_length / (target.speed * sampling.period), 10, 60))
    along = np.linspace(-half_length, half_length, 2 * n + 1)
    points = network.centre[:2] + offset * np.array([-u[1], u[0]]) + along[:, None] * u
    sensor_poses = network.positions, network.R_sw
    J = pass_information(*sensor_poses, target, sampling, points, heading).sum(axis=2)
    detect = settings.detect
    probability = detection_probabilities(*sensor_poses, target, sampling, points,
                                          detect.false_alarm_probability, detect.background_std)
    return Lane(name, heading, along, points,
                np.median(bounds_of(J, target.prior()), axis=1),
                _filter_bound(network, target, sampling, points, heading, settings),
                probability.mean(axis=1))


def _filter_bound(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                  points: FloatArray, heading: float, settings: Settings) -> FloatArray:
    """Position bound (n,) [m], at each point of a lane, of a filter that starts at the first point.

    The filter uses the motion model of the tracker and estimates the backgrounds. The bound is the
    median over the directions of the moment.
    """
    n_sensors, dt = len(network), np.hypot(*(points[1] - points[0])) / target.speed
    n_samples = dt / sampling.period
    frame_sampling = Sampling(sampling.period, sampling.noise_std, half_window=0.0)
    n_x = 9 + 3 * n_sensors
    F, Q, P0 = np.eye(n_x), np.zeros((n_x, n_x)), np.zeros((n_x, n_x))
    F[:6, :6] = constant_velocity(dt)
    Q[:6, :6] = integrator_noise(dt, acceleration_density(settings.track))
    information = np.diagonal(target.prior())[[2, 5]]
    prior_std = np.array([1.0, 1.0, 1.0, target.speed, target.speed, target.speed])
    prior_std[:3] *= np.hypot(*(points[-1] - points[0]))
    prior_std[[2, 5]] = np.where(
        information > 0.0, 1.0 / np.sqrt(np.maximum(information, 1e-30)), prior_std[[2, 5]])
    P0[range(6), range(6)] = prior_std**2
    P0[range(6, 9), range(6, 9)] = target.moment**2 / 3.0
    P0[range(9, n_x), range(9, n_x)] = min(sampling.background_std, 1e-6)**2
    _, h, H = zip(*pass_fields(network.positions, network.R_sw, target, frame_sampling, points,
                               heading), strict=True)
    h, H = np.concatenate(h), np.concatenate(H)
    std = np.empty((len(points), len(DIRECTIONS)))
    backgrounds = np.broadcast_to(np.eye(3 * n_sensors).reshape(n_sensors, 3, -1),
                                  (len(points), n_sensors, 3, 3 * n_sensors))
    for d in range(len(DIRECTIONS)):
        variance = (np.square(sampling.noise_std) + sampling.field_error**2 * np.square(
            h[:, d, 0]).sum(axis=-1)) / n_samples
        P = path_bound(F, Q, np.concatenate([H[:, d, 0], backgrounds], axis=-1),
                       variance[..., None, None] * np.eye(3), P0)
        std[:, d] = np.sqrt(P[:, 0, 0] + P[:, 1, 1])
    bound: FloatArray = np.median(std, axis=1)
    return bound


def _added_sensor_bounds(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                         near_lanes: Sequence[tuple[float, FloatArray]],
                         candidates: FloatArray) -> tuple[float, FloatArray]:
    """Median position bound [m] without and with an additional sensor at each of the candidates.

    If `near_lanes` or `candidates` is empty, the results are NaN and an empty array.
    """
    height = network.positions[:, 2].mean()
    candidate_positions = np.column_stack([candidates, np.full(len(candidates), height)])
    upright = np.tile(np.eye(3), (len(candidates), 1, 1))
    added_sampling = replace(sampling, noise_std=float(np.median(sampling.noise_std)))
    prior = target.prior()
    bounds_without, bounds_with = [], []
    for heading, points in near_lanes:
        if not len(candidates):
            continue
        J = pass_information(network.positions, network.R_sw, target, sampling, points,
                             heading).sum(axis=2)
        bounds_without.append(bounds_of(J, prior)[..., 0].ravel())
        added_information = pass_information(candidate_positions, upright, target, added_sampling,
                                             points, heading)
        bounds_with.append(bounds_of(J[:, :, None] + added_information, prior)[..., 0].reshape(
            -1, len(candidates)))
    if not bounds_without:
        return float('nan'), np.zeros(0)
    return (float(np.median(np.concatenate(bounds_without))),
            np.median(np.concatenate(bounds_with), axis=0))


def _miss_probabilities(network: SensorNetwork, target: PlannedTarget, sampling: Sampling,
                        lane: Lane, area: Area, settings: Settings) -> FloatArray:
    """Compute `Plan.miss_curve`: a pass is missed unless `detect.onset_frames` consecutive frames
    detect the target."""
    half_length = 0.5 * max(area[2] - area[0], area[3] - area[1])
    offsets = np.linspace(0.0, 2.0 * half_length, 25)
    u = np.array([np.cos(lane.heading), np.sin(lane.heading)])
    n = int(np.clip(4.0 * half_length / (target.speed * sampling.period), 1, MAX_FRAMES))
    along = np.linspace(-2.0 * half_length, 2.0 * half_length, n)[:, None]
    detect, rows = settings.detect, []
    for offset in offsets:
        points = network.centre[:2] + offset * np.array([-u[1], u[0]]) + along * u
        probability = detection_probabilities(
            network.positions, network.R_sw, target, sampling, points,
            detect.false_alarm_probability, detect.background_std)
        rows.append((offset, float(np.mean(
            missed_detection_probability(probability, detect.onset_frames)))))
    return np.array(rows)


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
