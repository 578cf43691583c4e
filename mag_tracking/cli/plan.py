"""mag-tracking plan."""

import json
import math
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mag_tracking.analysis.placement import PlannedTarget, Sampling
from mag_tracking.cli.options import add_command, add_network
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.io.network_file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.planning import GOOD_PD, detection_range, n_parts, plan
from mag_tracking.settings import read_parameter_file

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
  mag-tracking plan --network board.yaml --moment 0.87 --height 0.03 --speed 0.05 \\
      --noise-std 1e-6 --out plan
'''


def add(commands):
    """Register the command."""
    p = add_command(commands, 'plan', _plan, 'What a network of sensors will be able to tell.',
                    _PLAN)
    add_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='folder for the results')
    p.add_argument('--target', metavar='KIND', help='a kind of vehicle of the settings: small, '
                   'car or truck (default: car); gives moment and height')
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


def _positive(name, value):
    """`value`, or a SettingsError."""
    if not (math.isfinite(value) and value > 0.0):
        raise SettingsError(f'{name}: expected a positive number, got {value:g}')
    return value


def _target(args, vehicle):
    """The `PlannedTarget` of the command line."""
    speed = _positive('--speed', args.speed)
    if args.moment is not None:
        if args.target is not None:
            raise SettingsError('--target and --moment: give one of them')
        if args.height is None:
            raise SettingsError('--height: needed with --moment')
        return PlannedTarget(_positive('--moment', args.moment), args.height, speed)
    kind = args.target or 'car'
    if kind not in vehicle.kinds:
        raise SettingsError(f'--target: expected one of {", ".join(vehicle.kinds)}, got {kind!r}')
    k = vehicle.kinds.index(kind)
    height = vehicle.heights[k] if args.height is None else args.height
    return PlannedTarget(vehicle.moments[k], height, speed, vehicle.height_stds[k],
                         vehicle.climb_std)


def _lanes(args, vehicle):
    """{name: (heading, offset)} of the command line."""
    if args.heading is None:
        named = dict(zip(vehicle.arrival_names, vehicle.arrival_headings_deg, strict=True))
    else:
        named = {f'{heading:g} deg': heading for heading in args.heading}
    offsets = args.offset or [0.0] * len(named)
    if len(offsets) != len(named):
        raise SettingsError(f'--offset: expected {len(named)} numbers, one a lane '
                            f'({", ".join(named)}), got {len(offsets)}')
    if not np.isfinite([*named.values(), *offsets]).all():
        raise SettingsError('--heading, --offset: expected finite numbers')
    return {name: (math.radians(heading), offset)
            for (name, heading), offset in zip(named.items(), offsets, strict=True)}


def _sampling(args, network, settings, reach, speed):
    """The `Sampling` of the command line."""
    period = settings.align.period_s
    n = max(1.0, _positive('--rate', args.rate) * period)
    default = args.noise_std if args.noise_std is not None else 1.2e-8
    noise = np.array([_positive('--noise-std', default) if std is None or args.noise_std is not None
                      else float(np.sqrt(np.mean(np.square(std)))) for std in network.noise_std])
    error = settings.track.field_error if args.field_error is None else args.field_error
    if not 0.0 <= error < 1.0:
        raise SettingsError(f'--field-error: expected a share from 0 to 1, got {error:g}')
    return Sampling(period, noise / math.sqrt(n), error, half_window=1.2 * reach / speed)


def _plan(args):
    """mag-tracking plan."""
    network = read_network(args.network)
    settings = settings_for('vehicle', read_parameter_file(args.params) if args.params else {})
    target, lanes = _target(args, settings.track.vehicle), _lanes(args, settings.track.vehicle)
    if not 5 <= args.grid <= 400:
        raise SettingsError(f'--grid: expected 5 to 400 points, got {args.grid}')
    noise = _sampling(args, network, settings, 1.0, 1.0).noise_std
    reach = detection_range(target, float(np.median(noise)), 3,
                            settings.detect.false_alarm_probability)
    sampling = _sampling(args, network, settings, reach, target.speed)
    low, high = network.positions[:, :2].min(axis=0), network.positions[:, :2].max(axis=0)
    area = tuple(args.area or [*(low - reach), *(high + reach)])
    if not (np.isfinite(area).all() and area[2] > area[0] and area[3] > area[1]):
        raise SettingsError(f'--area: expected X0 < X1 and Y0 < Y1, got {list(area)}')
    clearance = args.clearance
    if clearance is None:
        clearance = 2.0 if args.moment is None else 0.0
    if not (math.isfinite(clearance) and clearance >= 0.0):
        raise SettingsError(f'--clearance: expected metres, got {clearance:g}')
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


def _print(p, noise):
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
    if not np.isfinite(p.with_one_more).any():
        print('one more sensor: nowhere in the area is it clear of the lanes')
        return
    print(f'one more sensor helps most at ({p.best_place[0]:.2f}, {p.best_place[1]:.2f}) m: the '
          f'median bound near the sensors becomes {f_text(np.nanmin(p.with_one_more))}, now '
          f'{f_text(p.without)}')


def _without_nan(a):
    """Nested lists of an array (n, m), null where it is no number."""
    return [[v if math.isfinite(v) else None for v in row] for row in a.tolist()]


def _write(p, out):
    """The figures and `plan.json`."""
    # Drawing needs matplotlib, which the other commands should not wait for.
    from mag_tracking.report import plan_figures

    for name in ('position', 'detection', 'sensor', 'lane'):
        figure = getattr(plan_figures, f'{name}_figure')(p)
        figure.savefig(out / f'plan_{name}{"s" * (name == "lane")}.png', dpi=110)
    finite = {name: [v if math.isfinite(v) else None for v in values.tolist()]
              for name, values in p.blocks.items()}
    content = {
        'x': p.x.tolist(), 'y': p.y.tolist(), 'position_std': p.position_std.tolist(),
        'detection': p.detection.tolist(), 'with_one_more': _without_nan(p.with_one_more),
        'without': p.without, 'best_place': p.best_place, 'bounds_at_closest': finite,
        'unobservable': p.observability.unobservable, 'missed': p.missed.tolist(),
        'lanes': [{'name': lane.name, 'along': lane.along.tolist(),
                   'filter_std': lane.filter_std.tolist(), 'pass_std': lane.pass_std.tolist(),
                   'detection': lane.detection.tolist()} for lane in p.lanes]}
    with open(out / 'plan.json', 'w', encoding='utf-8') as stream:
        json.dump(content, stream, indent=1, allow_nan=False)
        stream.write('\n')
