"""Command `mag-tracking plan`."""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from mag_tracking.apps.plan import Plan, compute_plan, n_parts
from mag_tracking.apps.plan_inputs import plan_inputs
from mag_tracking.cli.options import Commands, add_command, add_network
from mag_tracking.errors import SettingsError
from mag_tracking.files import output_folder, write_json
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from mag_tracking.settings import read_parameter_file

_PLAN_HELP = '''
Predicts, before installation, the position accuracy, the detection probability, and the best
position of an additional sensor. The accuracies are Cramer-Rao bounds for a point target at
constant speed: a good estimator approaches them, and no unbiased estimator is more accurate.
Errors other than noise (of clocks, mountings, the point model) are represented by a relative error
of the field (--field-error).

files written to DIR:
  plan_position.png    map: standard deviation of the position from a whole pass
  plan_detection.png   map: probability that one frame detects the target
  plan_sensor.png      map: benefit of an additional sensor, and its best position
  plan_lanes.png       curves along each lane: bounds of a filter and of the fit of a whole pass,
                       and the probability that a target is missed
  report.html          interactive report: maps and curves
  plan.json            all values

examples:
  mag-tracking plan --network network.yaml --target car --out plan
  mag-tracking plan --network network.yaml --target truck --speed 25 --heading 0 180 --out plan
  mag-tracking plan --network board.yaml --target magnet --moment 0.87 --height 0.03 --speed 0.05 \\
      --noise-std 1e-6 --out plan
'''


def add(commands: Commands) -> None:
    """Register the command."""
    p = add_command(commands, 'plan', _plan, _PLAN_HELP)
    add_network(p)
    p.add_argument('--out', required=True, type=Path, metavar='DIR', help='output folder')
    p.add_argument('--target', metavar='KIND', help='small, car or truck: a vehicle with the '
                   'moment and height given in the settings (default: car); magnet requires '
                   '--moment and --height')
    options: list[tuple[str, Any, str, dict[str, Any]]] = [
        ('moment', 'A_M2', 'magnitude of the moment [A m^2]; requires --height', {}),
        ('height', 'M', 'height of the magnetic centre, z in the frame of the network [m]', {}),
        ('speed', 'M_S', 'speed [m/s] (default: 10)', {'default': 10.0}),
        ('heading', 'DEG', 'heading of each lane, measured anticlockwise from x [deg] (default: '
         'the arrival directions of the settings)', {'nargs': '+'}),
        ('offset', 'M', 'lateral offset of each lane, to the left of the centre of the sensors [m] '
         '(default: 0)', {'nargs': '+'}),
        ('noise-std', 'TESLA', 'noise standard deviation of one sample [T] (default: noise_std of '
         'the network file, or 1.2e-8)', {}),
        ('rate', 'HZ', 'sample rate of each sensor (default: 100)', {'default': 100.0}),
        ('field-error', 'FRACTION', 'relative error of the field (default: track.field_error)', {}),
        ('area', ('X0', 'Y0', 'X1', 'Y1'), 'area of the maps [m] (default: where at least half of '
         'the targets are detected)', {'nargs': 4}),
        ('clearance', 'M', 'minimum distance of an additional sensor from a lane [m] (default: 2 '
         'for vehicles, 0 with --moment)', {})]
    for name, metavar, text, keywords in options:
        p.add_argument(f'--{name}', type=float, metavar=metavar, help=text, **keywords)
    p.add_argument('--grid', type=int, default=41, metavar='N',
                   help='number of points along the longer side of the maps (default: 41)')
    p.add_argument('--params', type=Path, metavar='FILE',
                   help='YAML file with the settings to override')


def _plan(args: argparse.Namespace) -> int:
    network = read_network(args.network)
    kind = 'magnet' if args.target == 'magnet' else 'vehicle'
    settings = settings_for(kind, read_parameter_file(args.params) if args.params else {})
    try:
        inputs = plan_inputs(
            network, settings, args.target, args.moment, args.height, args.speed, args.heading,
            args.offset, args.noise_std, args.rate, args.field_error, args.area, args.clearance,
            args.grid)
    except SettingsError as error:
        name, _, message = str(error).partition(':')
        raise SettingsError(f'--{name.replace("_", "-")}:{message}') from error
    output_folder(args.out)
    with tqdm(total=n_parts(inputs.lanes), desc='plan', disable=None) as bar:
        result = compute_plan(*inputs, bar.update)
    # Imported here because it loads matplotlib.
    from mag_tracking.apps.plan_report import summary_lines, write_report

    lines = summary_lines(result)
    for line in lines:
        print(line)
    _write(result, args.out)
    write_report(result, lines, args.out)
    print(f'results in {args.out}')
    return 0


def _write(p: Plan, out: Path) -> None:
    def values(source: object, names: str) -> dict[str, Any]:
        attributes = ((name, getattr(source, name)) for name in names.split())
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in attributes}

    content = {
        **values(p, 'x y position_std detection std_with_added_sensor std_without_added_sensor '
                 'best_position'),
        'bounds_at_closest': {k: v.tolist() for k, v in p.bounds_at_closest.items()},
        'unobservable': p.observability.unobservable, 'miss_curve': p.miss_curve.tolist(),
        'lanes': [values(lane, 'name along filter_std pass_std detection') for lane in p.lanes]}
    write_json(out / 'plan.json', content)
    # Imported here because it loads matplotlib.
    from mag_tracking.apps import plan_report
    from mag_tracking.report.style import save_figure

    save_figure(plan_report.position_figure(p), out / 'plan_position.png')
    save_figure(plan_report.detection_figure(p), out / 'plan_detection.png')
    save_figure(plan_report.sensor_figure(p), out / 'plan_sensor.png')
    save_figure(plan_report.lane_figure(p), out / 'plan_lanes.png')
