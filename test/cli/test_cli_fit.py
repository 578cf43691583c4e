"""`fit --same-vehicle` on simulated passes whose hard and soft iron are known."""

import json

import numpy as np
import pytest

from mag_tracking.cli import main
from mag_tracking.cli.fit import iron_warnings
from mag_tracking.inference.identification import Iron
from support.bundled import NETWORK_FILE
from support.iron_passes import HARD, SOFT, recorded

HEADINGS = {'east': 0.0, 'west': 180.0, 'north_east': 50.0, 'south_east': -40.0}


@pytest.fixture(scope='module')
def passes(tmp_path_factory):
    """{name: recording} of the vehicle at each heading."""
    rng = np.random.default_rng(5)
    folder = tmp_path_factory.mktemp('iron')
    recordings = {}
    for name, heading in HEADINGS.items():
        (folder / name).mkdir()
        recordings[name] = recorded(folder / name, heading, rng)
    return recordings


def iron_of(names, passes, out):
    """Fit the passes `names`; return `iron` of the results."""
    assert main(['fit', *(str(passes[n]) for n in names), '--network', str(NETWORK_FILE),
                 '--orders', '1', '--same-vehicle', '--no-figures', '--out', str(out)]) == 0
    return json.loads((out / 'fits.json').read_text())['iron']


def test_passes_at_several_headings_separate_hard_and_soft_iron(passes, tmp_path, capsys):
    iron = iron_of(HEADINGS, passes, tmp_path)
    estimate = np.array([*iron['hard'], iron['soft']])
    std, simulated = np.array(iron['std']), np.array([*HARD, SOFT])
    output = capsys.readouterr().out
    print(f'm0, D: {estimate.round(3)} ({std.round(3)}), simulated {simulated}')
    # Errors are within four standard deviations, which are small compared with the values.
    assert np.all(np.abs(estimate - simulated) < 4.0 * std)
    assert np.all(std[:3] < 0.05 * np.linalg.norm(HARD)) and std[3] < 0.05 * SOFT
    assert iron['passes'] == len(HEADINGS) and 0.1 < iron['normalised_cost'] < 5.0
    assert 'hard iron m0 =' in output and '4 passes' in output and 'warning' not in output


def test_passes_of_different_vehicles_cause_a_warning(passes, tmp_path, capsys):
    (tmp_path / 'other').mkdir()
    other = recorded(tmp_path / 'other', 50.0, np.random.default_rng(6), hard=[-300.0, 200.0, 90.0])
    names = ['east', 'west', 'other']
    iron = iron_of(names, {**passes, 'other': other}, tmp_path / 'out')
    assert iron['normalised_cost'] > 10.0
    assert 'contradict' in capsys.readouterr().out
    assert any('contradict' in warning for warning in iron['warnings'])


@pytest.mark.parametrize('soft, n', [(-0.29, 0), (-0.31, 1)])
def test_only_a_significantly_negative_soft_iron_causes_a_warning(soft, n):
    iron = Iron(np.zeros(3), soft, np.eye(4), 1.0)
    assert len([w for w in iron_warnings(iron, 2, 0.1) if 'negative' in w]) == n


def test_hard_and_soft_iron_are_not_separated_at_a_single_heading(passes, tmp_path, capsys):
    assert iron_of(['east'], passes, tmp_path) is None
    assert 'separated' in capsys.readouterr().out
