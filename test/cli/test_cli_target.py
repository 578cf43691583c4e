"""The target of a command: given by an option, by parameters, or by the network."""

from argparse import Namespace
from dataclasses import replace

import numpy as np
import pytest

from mag_tracking.cli.options import settings_of
from mag_tracking.errors import SettingsError
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import settings_for
from support.bundled import NETWORK_FILE
from support.magnet_boards import board
from support.networks import line_network


def chosen(network, target=None, params=None):
    return settings_of(Namespace(target=target, params=params, network='board.yaml'), network)


def test_a_board_selects_a_magnet_and_says_so(capsys):
    assert chosen(board()) == settings_for('magnet')
    assert 'board.yaml: 9 sensors within 1 m' in capsys.readouterr().out


@pytest.mark.parametrize('target', ['vehicle', 'magnet', 'bench'])
def test_a_given_target_is_used_without_a_line(target, capsys):
    assert chosen(board(), target) == settings_for(target)
    assert capsys.readouterr().out == ''


def test_a_target_in_the_parameters_is_used(tmp_path, capsys):
    params = tmp_path / 'mine.yaml'
    params.write_text('track: {target: magnet}')
    assert chosen(read_network(NETWORK_FILE), params=params) == settings_for('magnet')
    with pytest.raises(SettingsError, match='remove one'):
        chosen(board(), 'vehicle', params)
    assert capsys.readouterr().out == ''


@pytest.mark.parametrize('network', [
    read_network(NETWORK_FILE), line_network(1),
    replace(line_network(2), positions=np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]))],
    ids=['road', 'one sensor', 'pair'])
def test_other_networks_select_a_vehicle(network, capsys):
    assert chosen(network) == settings_for('vehicle')
    assert capsys.readouterr().out == ''
