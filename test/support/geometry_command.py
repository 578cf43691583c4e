"""The command `mag-tracking calibrate board` with its input and output files."""

import csv

import numpy as np

from mag_tracking.cli import main
from mag_tracking.pipeline import settings_for
from mag_tracking.stages.calibrate.stage import Calibrate
from support.magnet_boards import MOMENT
from support.samples import MagSample, fed


def write_table(path, field, positions, axes):
    """Write a pose table with readings (K, n, 3), positions and axes (K, 3); return its path."""
    names = [f'{a}{j}' for j in range(field.shape[1]) for a in 'xyz']
    names += [f'mag_{v}0' for v in ('x', 'y', 'z', 'mx', 'my', 'mz')]
    with open(path, 'w', newline='') as stream:
        writer = csv.writer(stream)
        writer.writerow(names)
        writer.writerows(np.hstack([field.reshape(len(field), -1), positions, axes]).tolist())
    return path


def command(table, *options, out):
    """Run `board-geometry` on a pose table; return its exit status."""
    return main(['calibrate', 'board', str(table), '--moment', str(MOMENT), '--out', str(out),
                 *map(str, options)])


def calibrated_readings(network, readings):
    """Calibrate raw readings (K, n, 3) with a `Calibrate` stage; NaN where it returns no
    reading."""
    stage = Calibrate(network, settings_for('magnet').calibrate)
    out = np.full(readings.shape, np.nan)
    for k, frame in enumerate(readings):
        for j, (name, reading) in enumerate(zip(network.names, frame, strict=True)):
            for sample in fed(stage, MagSample(10**18 + k * 10**9, name, reading)):
                out[k, j] = sample.field
    return out
