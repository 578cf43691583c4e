"""The way of a new user from an own table to a table of vehicles, in three commands."""

import csv

import numpy as np
import pandas as pd

from mag_tracking.cli import main
from mag_tracking.physics.dipole import dipole_field

POSITIONS = {'north': (0.0, 4.5, 0.0), 'middle': (7.0, -4.5, 0.0), 'south': (14.0, 4.5, 0.0)}
EARTH = np.array([2.0e-6, 1.55e-5, -4.9e-5])
SPEEDS = (8.0, 12.0, -10.0, 15.0, -9.0)
"""Velocity along x of each car [m/s]; the cars pass every 20 s."""


def write_table(path):
    """Write the readings of three sensors in microtesla; five cars pass on a straight road."""
    rng, parts = np.random.default_rng(5), []
    t = np.arange(0.0, 115.0, 0.04)
    for name, position in POSITIONS.items():
        field = np.tile(EARTH, (len(t), 1))
        for k, speed in enumerate(SPEEDS):
            x = 7.0 + speed * (t - 17.0 - 20.0 * k)
            for offset in (-1.5, 0.0, 1.5):
                r = np.array(position) - np.column_stack(
                    [x + offset, np.full_like(t, -1.75 * np.sign(speed)), np.full_like(t, 0.5)])
                field += dipole_field(r, np.array([20.0, 40.0, -120.0]) / 3.0)
        field += 1.2e-8 * rng.standard_normal(field.shape)
        parts.append(pd.DataFrame({'Time (s)': t.round(3), 'sensor': name,
                                   **dict(zip(('Bx (uT)', 'By (uT)', 'Bz (uT)'),
                                              (1e6 * field).round(4).T, strict=True))}))
    pd.concat(parts).sort_values('Time (s)', kind='stable').to_csv(path, index=False)


def test_an_own_table_becomes_a_table_of_vehicles_in_three_commands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / 'own.csv')
    sensors = ''.join(f'  {name}: {{position: {list(position)}}}\n'
                      for name, position in POSITIONS.items())
    (tmp_path / 'network.yaml').write_text(
        f'earth_field: [2.0e-6, 1.55e-5, -4.9e-5]\nsensors:\n{sensors}')
    assert main(['import', 'own.csv', '--out', 'own']) == 0
    assert main(['doctor', 'own', '--network', 'network.yaml']) == 0
    assert main(['replay', 'own', '--network', 'network.yaml', '--tables', 'passages',
                 '--out', 'out']) == 0
    with open('out/passages.csv', newline='') as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(SPEEDS)
    for row, speed in zip(rows, SPEEDS, strict=True):
        assert row['direction'] == ('forward' if speed > 0.0 else 'backward')
        assert abs(float(row['speed']) - abs(speed)) < 3.0 * float(row['sd_speed'])
