"""mag-tracking plan."""

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mag_tracking.analysis.placement import PlannedTarget, Sampling
from mag_tracking.apps.plan import GOOD_PD, Area, Plan, detection_range, n_parts, plan
from mag_tracking.arrays import FloatArray
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.recording.result_folder import without_nan
from mag_tracking.settings import read_parameter_file
from mag_tracking.stages.track.initiation_vehicle import VehicleSettings
from mag_tracking.stages.track.settings import TrackSettings

_PLAN = '''
Before the first hole is drilled: where is a position good to what, where is a target
detected, and where would one more sensor help most. The bounds are Cramer-Rao bounds of
a point target at constant speed: no estimator does better, a good one comes near. What
sensors add beyond their noise (clocks, mountings, a vehicle that is no point) is in the
relative error of the field (--field-error; the tracker's own setting by default).

Writes to DIR:
  plan_position.png    map: standard deviation of the position, by a whole pass
  plan_detection.png   map: probability that one frame detects the target
  plan_sensor.png      map: what one more sensor would bring, and the best place
  plan_lanes.png       along the lanes: filter and whole pass; passes missed by distance
  plan.json            all of it in numbers

examples:
  mag-tracking plan --network network.yaml --target car --out plan
  mag-tracking plan --network network.yaml --target truck --speed 25 --heading 0 180 --out plan
  mag-tracking plan --network board.yaml --target magnet --moment 0.87 --height 0.03 --speed 0.05 \\
      --noise-std 1e-6 --out plan
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'plan', _plan, 'What a network of sensors will be able to tell.',
                    _PLAN)
    add_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder for the results')
    p.add_argument('--target', metavar='KIND', help='a kind of vehicle of the settings: small, '
                   'car or truck (default: car), which gives moment and height; or magnet')
    p.add_argument('--moment', type=float, metavar='A_M2', help='size of the moment instead')
    p.add_argument('--height', type=float, metavar='M', help='height of the '
                   'magnetic centre, z in the frame of the network')
    p.add_argument('--speed', type=float, default=10.0, metavar='M_S', help='(default: 10)')
    p.add_argument('--heading', type=float, nargs='+', metavar='DEG',
                   help='of the lanes, 0 = along x, anticlockwise (default: the arrivals of the '
                   'settings)')
    p.add_argument('--offset', type=float, nargs='+', metavar='M', help='of each lane, to the left '
                   'of the line through the middle of the sensors (default: 0)')
    p.add_argument('--noise-std', type=float, metavar='TESLA',
                   help='noise of one sample, where the network file has none (default: 1.2e-8)')
    p.add_argument('--rate', type=float, default=100.0, metavar='HZ',
                   help='samples per second and sensor (default: 100)')
    p.add_argument('--field-error', type=float, metavar='SHARE',
                   help='relative error of the field (default: track.field_error)')
    p.add_argument('--area', type=float, nargs=4, metavar=('X0', 'Y0', 'X1', 'Y1'),
                   help='of the maps (default: as far as half of the targets are detected)')
    p.add_argument('--clearance', type=float, metavar='M', help='no further sensor nearer to the '
                   'line of a lane (default: 2 for vehicles, 0 with --moment)')
    p.add_argument('--grid', type=int, default=41, metavar='N',
                   help='points of the maps on their longer side (default: 41)')
    p.add_argument('--params', type=Path, metavar='FILE', help='settings that differ')


def _within(name: str, value: float, low: float, high: float) -> float:
    """`value`, or a SettingsError."""
    if not low <= value <= high:
        raise SettingsError(f'{name}: expected {low:g} to {high:g}, got {value:g}')
    return value


def _target(args: argparse.Namespace, track: TrackSettings) -> PlannedTarget:
    """The `PlannedTarget` of the command line."""
    vehicle = track.vehicle
    speed = _within('--speed', args.speed, 1e-4, 1e3)
    if args.height is not None:
        _within('--height', args.height, -1e3, 1e3)
    if args.moment is not None:
        if args.target not in (None, 'magnet'):
            raise SettingsError('--target and --moment: give one of them')
        if args.height is None:
            raise SettingsError('--height: needed with --moment')
        return PlannedTarget(_within('--moment', args.moment, 1e-6, 1e6), args.height, speed)
    if args.target == 'magnet':
        raise SettingsError('--moment and --height: needed for a magnet')
    kind = args.target or 'car'
    if kind not in vehicle.kinds:
        raise SettingsError(f'--target: expected one of {", ".join(vehicle.kinds)}, magnet; got '
                            f'{kind!r}')
    k = vehicle.kinds.index(kind)
    height = vehicle.heights[k] if args.height is None else args.height
    return PlannedTarget(vehicle.moments[k], height, speed, vehicle.height_stds[k],
                         vehicle.climb_std)


def _lanes(args: argparse.Namespace,
           vehicle: VehicleSettings) -> list[tuple[str, float, float]]:
    """[(name, heading, offset)] of the command line."""
    names: Sequence[str]
    headings: Sequence[float]
    if args.heading is None:
        names, headings = vehicle.arrival_names, vehicle.arrival_headings_deg
    else:
        names, headings = [f'{heading:g} deg' for heading in args.heading], args.heading
    offsets = args.offset or [0.0] * len(headings)
    if len(offsets) != len(headings):
        raise SettingsError(f'--offset: expected {len(headings)} numbers, one a lane '
                            f'({", ".join(names)}), got {len(offsets)}')
    for value in (*headings, *offsets):
        _within('--heading, --offset', value, -1e5, 1e5)
    if args.offset:
        names = [f'{name}, {offset:+g} m' for name, offset in zip(names, offsets, strict=True)]
    lanes = list(zip(names, map(math.radians, headings), offsets, strict=True))
    if len(set(lanes)) < len(lanes):
        raise SettingsError('--heading: a lane is there twice; give each its --offset')
    return lanes


def _sampling(args: argparse.Namespace, network: SensorNetwork, settings: Settings) -> Sampling:
    """The `Sampling` of the command line, but for how long the target is followed.

    An error of the field that lasts tells as little in many frames as in one: it counts as so much
    more noise in each (the architecture page says why the tracker has it as a state).
    """
    rate, track = _within('--rate', args.rate, 1e-2, 1e5), settings.track
    period = max(settings.align.period_s, 1.0 / rate)
    given = args.noise_std
    if given is not None:
        _within('--noise-std', given, 1e-15, 1e-3)
    noise = np.array([given or 1.2e-8 if std is None or given
                      else float(np.sqrt(np.mean(np.square(std)))) for std in network.noise_std])
    error = track.field_error if args.field_error is None else args.field_error
    _within('--field-error', error, 0.0, 0.9)
    lasting = max(1.0, 2.0 * track.model_error_time_s / period)
    return Sampling(period, noise / math.sqrt(max(1.0, rate * period)), error * math.sqrt(lasting))


def _area(args: argparse.Namespace, network: SensorNetwork, reach: float) -> Area:
    """(x0, y0, x1, y1) of the maps."""
    low, high = network.positions[:, :2].min(axis=0), network.positions[:, :2].max(axis=0)
    x0, y0, x1, y1 = args.area or [*(low - reach), *(high + reach)]
    if not (x1 > x0 and y1 > y0):
        raise SettingsError(f'--area: expected X0 < X1 and Y0 < Y1, got {args.area}')
    for side in (x1 - x0, y1 - y0):
        _within('--area: a side', side, 1e-3, 1e5)
    _within('--area: its longer side over the other', max((x1 - x0) / (y1 - y0),
                                                          (y1 - y0) / (x1 - x0)), 1.0, 50.0)
    return x0, y0, x1, y1


def _plan(args: argparse.Namespace) -> int:
    """mag-tracking plan."""
    network = read_network(args.network)
    kind = 'magnet' if args.target == 'magnet' else 'vehicle'
    settings = settings_for(kind, read_parameter_file(args.params) if args.params else {})
    target, lanes = _target(args, settings.track), _lanes(args, settings.track.vehicle)
    _within('--grid', args.grid, 5, 200)
    sampling = _sampling(args, network, settings)
    noise = sampling.noise_std
    reach = detection_range(target, float(np.median(noise)), 3,
                            settings.detect.false_alarm_probability)
    sampling = replace(sampling, half_window=1.2 * reach / target.speed)
    area = _area(args, network, reach)
    clearance = args.clearance
    if clearance is None:
        clearance = 2.0 if args.moment is None else 0.0
    _within('--clearance', clearance, 0.0, 1e6)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f'cannot write to {args.out}: {error.strerror}') from error
    with tqdm(total=n_parts(lanes), desc='plan', disable=None) as bar:
        result = plan(network, target, sampling, lanes, area, settings, clearance, args.grid,
                      bar.update)
    _print(result, noise)
    _write(result, args.out)
    print(f'results in {args.out}')
    return 0


def _print(p: Plan, noise: FloatArray | float) -> None:
    """The answers in a few lines."""
    from mag_tracking.report.plan_figures import f_text

    print(f'{len(p.network)} sensors, noise of a frame {1e9 * float(np.median(noise)):.2g} nT; '
          f'target of {p.target.moment:g} A m^2 at {p.target.speed:g} m/s')
    o = p.observability
    seen = (f'not observable: {", ".join(o.unobservable)}' if o.unobservable
            else f'observable, condition number {o.condition_number:.3g}')
    print(f'one pass on lane {p.lanes[0].name}, without priors: {seen}')
    for name, (r, v, m) in p.blocks.items():
        print(f'  closest point, {name}: position {f_text(r)}, velocity {v:.3g} m/s, '
              f'moment {m:.3g} A m^2')
    for lane in p.lanes:
        good = np.flatnonzero(lane.detection >= GOOD_PD)
        first = (f'from {-lane.along[good[0]]:.3g} m before the middle on' if len(good)
                 else 'nowhere')
        closest = int(np.argmin(np.abs(lane.along)))
        print(f'lane {lane.name}: a frame detects it with {GOOD_PD:.0%} {first}; '
              f'at the middle a filter knows it to {f_text(lane.filter_std[closest])}, a whole '
              f'pass to {f_text(lane.pass_std[closest, 0])}')
    caught = p.missed[p.missed[:, 1] < 0.01, 0]
    print(f'99 % of passes are detected up to {caught.max():.3g} m from the middle' if len(caught)
          else 'nowhere are 99 % of the passes detected')
    print('(bounds of a point: real vehicles are followed several times less well)')
    if not np.isfinite(p.with_one_more).any():
        print('one more sensor: nowhere in the area is it clear of the lanes')
    elif np.nanmin(p.with_one_more) > 0.99 * p.without:
        print('one more sensor helps nowhere in the area')
    else:
        x, y = p.best_place
        edge = ' (on the edge of the area)' if x in p.x[[0, -1]] or y in p.y[[0, -1]] else ''
        print(f'one more sensor helps most at ({x:.2f}, {y:.2f}) m{edge}: the median bound near '
              f'the sensors becomes {f_text(np.nanmin(p.with_one_more))}, now {f_text(p.without)}')


def _write(p: Plan, out: Path) -> None:
    """The figures and `plan.json`."""
    content = {
        'x': p.x.tolist(), 'y': p.y.tolist(), 'position_std': p.position_std.tolist(),
        'detection': p.detection.tolist(), 'with_one_more': p.with_one_more.tolist(),
        'without': p.without, 'best_place': list(p.best_place),
        'bounds_at_closest': {k: v.tolist() for k, v in p.blocks.items()},
        'unobservable': list(p.observability.unobservable), 'missed': p.missed.tolist(),
        'lanes': [{'name': lane.name, 'along': lane.along.tolist(),
                   'filter_std': lane.filter_std.tolist(), 'pass_std': lane.pass_std.tolist(),
                   'detection': lane.detection.tolist()} for lane in p.lanes]}
    with open(out / 'plan.json', 'w', encoding='utf-8') as stream:
        json.dump(without_nan(content), stream, indent=1, allow_nan=False)
        stream.write('\n')
    # Drawing needs matplotlib, which the other commands should not wait for.
    from mag_tracking.report import plan_figures

    for name in ('position', 'detection', 'sensor', 'lane'):
        figure = getattr(plan_figures, f'{name}_figure')(p)
        figure.savefig(out / f'plan_{name}{"s" * (name == "lane")}.png', dpi=110)
