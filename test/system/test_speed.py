"""Quick benchmarks: imports, speed ratios and comparison of figures. `make bench` runs all."""

import json
import subprocess
import sys

import numpy as np
import pytest

from bench import figures
from bench.bench import Peer, bank_ratio
from support.bundled import NETWORK_FILE, vehicle_path

HEAVY_MODULES = ('dask', 'distributed', 'pyarrow', 'scipy', 'matplotlib', 'rclpy',
                 'google.protobuf', 'rosbags')
RECORDING = str(vehicle_path('straight_car_right'))
IMPORT_SCRIPT = '''
import contextlib, io, json, sys
from mag_tracking.cli import main
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main(sys.argv[1:])
print(json.dumps(sorted(sys.modules)))
'''


@pytest.mark.parametrize('args, excluded', [
    (['--help'], ('numpy',)), (['--version'], ('numpy',)), (['info', '--help'], ()),
    (['info', RECORDING], ()), (['info', RECORDING, '--network', str(NETWORK_FILE)], ()),
    (['ros', 'topics', '--help'], ()),
    (['import', '--help'], ('mcap', 'mag_tracking.apps', 'mag_tracking.recording')),
    (['record', '--help'], ('websockets', 'mag_tracking.pipeline', 'mag_tracking.recording')),
    (['calibrate', 'tumble', '--help'], ('mag_tracking.calibration', 'mag_tracking.pipeline'))])
def test_a_command_imports_only_what_it_needs(args, excluded):
    done = subprocess.run([sys.executable, '-c', IMPORT_SCRIPT, *args], capture_output=True,
                          text=True, check=True)
    imported = json.loads(done.stdout)
    assert [m for m in imported if m.startswith((*HEAVY_MODULES, *excluded))] == []


def test_the_tracker_imports_no_rarely_needed_modules():
    done = subprocess.run(
        [sys.executable, '-c', 'import sys, mag_tracking.pipeline; print("\\n".join(sys.modules))'],
        capture_output=True, text=True, check=True)
    imported = done.stdout.split()
    assert 'mag_tracking.stages.track.core' in imported
    assert not {'scipy.stats', 'scipy.signal', 'scipy.optimize', 'matplotlib'} & {*imported}


@pytest.mark.parametrize('n_sensors, min_ratio', [(2, 80.0), (8, 40.0)])
def test_the_bank_is_many_times_faster_than_a_loop_over_filterpy(n_sensors, min_ratio):
    """The aims are 350 and 120 (`bench.bench`); the limits are lower because other tests may run
    meanwhile."""
    _, _, ratio, *_ = bank_ratio(Peer, n_sensors, False, rounds=4, repeats=20)
    assert ratio >= min_ratio


def run(value, more_is_better=False, name='a frame, mean'):
    """Figures of a benchmark run with the single figure `name`."""
    return {'replay': {name: {'value': value, 'unit': 'ms', 'aim': None,
                              'more_is_better': more_is_better}}}


@pytest.mark.parametrize('more_is_better, values, now, is_worse', [
    (False, [5.0, 4.0, 6.0], 4.5, False), (False, [5.0, 4.0, 6.0], 4.7, True),
    (True, [50.0, 40.0], 44.0, False), (True, [50.0, 40.0], 43.0, True),
    # The best value is older than five runs.
    (False, [1.0, 5.0, 5.0, 5.0, 5.0, 5.0], 5.5, False), (False, [], 9.0, False),
    # NaN is worse than any number, and no later value is compared with it.
    (False, [5.0], np.nan, True), (False, [np.nan, 5.0], 45.0, True),
    (False, [np.nan], 9.0, False)])
def test_a_figure_is_compared_with_the_best_of_recent_runs(more_is_better, values, now, is_worse):
    before = [{'figures': run(v, more_is_better)} for v in values]
    found = figures.worse_figures(run(now, more_is_better), before)
    assert bool(found) == is_worse
    assert figures.worse_figures(run(now, more_is_better, 'a new one'), before) == []


def test_figures_are_saved_and_regressions_are_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(figures, 'FOLDER', tmp_path)
    for name in ('LATEST', 'HISTORY'):
        monkeypatch.setattr(figures, name, tmp_path / getattr(figures, name).name)
    monkeypatch.setattr(figures, 'ROOT', tmp_path)
    assert figures.main() == 1 and 'no benchmark' in capsys.readouterr().out
    for value, status in ((4.0, 0), (4.4, 0), (5.0, 1)):
        measured = figures.Figures('replay')
        measured.add('a frame, mean', value, 'ms', 4.5)
        measured.add('times real time', 40.0, '', 50.0, True)
        assert measured.missed == 1 + (value > 4.5) and measured.save() == 1
        assert figures.main() == status
    out = capsys.readouterr().out
    assert 'worse: replay: a frame, mean: 5 ms' in out
    assert [r['figures']['replay']['a frame, mean']['value']
            for r in figures.read_history()] == [4.0, 4.4, 5.0]
    # Runs of another machine are not compared.
    monkeypatch.setattr(figures, 'machine', lambda: 'another')
    measured = figures.Figures('replay')
    measured.add('a frame, mean', np.nan, 'ms', 9.0)
    assert measured.missed == 1 and measured.save() == 1 and figures.main() == 0
    assert '(another)' in capsys.readouterr().out
