"""Public Python interface: the names that `import mag_tracking` provides."""

import ast
import importlib
import inspect
import io
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import mag_tracking as mt
from mag_tracking.cli import main
from mag_tracking.results.columns import DETECTIONS, FITS, POSES, SMOOTHED, names_of
from mag_tracking.results.fit_folder import FitFolder
from support.bundled import NETWORK_FILE, QUICK, ROOT, vehicle_path

NAME = 'straight_car_fast_left'
HEAVY_MODULES = {'matplotlib', 'dask', 'mcap', 'numpy', 'pandas', 'rclpy', 'scipy', 'yaml'}


@pytest.fixture(scope='module')
def recorded():
    return mt.read_recording(vehicle_path(NAME), NETWORK_FILE)


@pytest.fixture(scope='module')
def result():
    return mt.track(vehicle_path(NAME), NETWORK_FILE)


@pytest.fixture(scope='module')
def readings():
    """Three readings from each of two sensors."""
    return mt.readings_from_arrays(['mag_1', 'mag_2'] * 3, np.arange(6) * 10_000_000,
                                   np.full((6, 3), 1e-6))


def run_python(code):
    """Run `code` in another interpreter; return its output."""
    return subprocess.run([sys.executable, '-c', code], check=True, capture_output=True, text=True,
                          cwd=ROOT).stdout.strip()


def are_identical(a, b):
    """Whether the arrays of two results are bitwise identical."""
    return all(getattr(a, name).dtype == getattr(b, name).dtype
               and getattr(a, name).tobytes() == getattr(b, name).tobytes()
               for name in ('poses', 'smoothed', 'detections'))


def read_csv(path):
    return pd.read_csv(path, float_precision='round_trip', keep_default_na=False)


@pytest.mark.parametrize('name', mt.__all__)
def test_a_public_name_resolves_and_is_documented(name):
    assert name in dir(mt) and inspect.getdoc(getattr(mt, name))


def test_type_checkers_see_the_public_names():
    """The imports under TYPE_CHECKING match the imports on first use."""
    tree = ast.parse((ROOT / 'mag_tracking' / '__init__.py').read_text())
    block = next(n for n in tree.body if isinstance(n, ast.If) and n.test.id == 'TYPE_CHECKING')
    seen = {alias.asname or alias.name: (node.module, alias.name)
            for node in block.body for alias in node.names}
    assert sorted(seen) == sorted(mt.__all__) and len(set(mt.__all__)) == len(mt.__all__)
    for name, (module, original_name) in seen.items():
        assert getattr(mt, name) is getattr(importlib.import_module(module), original_name)


def test_no_public_name_equals_the_name_of_a_module():
    """Importing a module of the same name would replace the public object."""
    assert not set(mt.__all__) & {p.stem for p in (ROOT / 'mag_tracking').iterdir()}


def test_an_unknown_name_raises_an_attribute_error():
    with pytest.raises(AttributeError, match='trakc'):
        mt.trakc  # noqa: B018


def test_importing_the_package_imports_nothing_else():
    loaded = run_python('import sys, mag_tracking; dir(mag_tracking); print(*sys.modules)').split()
    assert 'mag_tracking' in loaded
    assert not HEAVY_MODULES & {name.partition('.')[0] for name in loaded}
    assert not [name for name in loaded if name.startswith('mag_tracking.')]


def test_tracking_imports_neither_matplotlib_nor_pandas_nor_ros():
    loaded = run_python('import sys, mag_tracking; mag_tracking.track; print(*sys.modules)').split()
    assert 'mag_tracking.apps.track' in loaded
    assert not {'matplotlib', 'pandas', 'rclpy'} & {n.partition('.')[0] for n in loaded}


def test_figure_modules_do_not_change_the_matplotlib_backend():
    folder = ROOT / 'mag_tracking'
    modules = ['.'.join(p.relative_to(ROOT).with_suffix('').parts) for p in (
        *folder.glob('report/[a-z]*.py'), *folder.glob('apps/*_report.py'))]
    assert len(modules) > 4
    assert run_python('import matplotlib; matplotlib.use("svg"); import '
                      f'{", ".join(modules)}; print(matplotlib.get_backend())') == 'svg'


def test_a_recording_is_read_into_arrays(recorded):
    readings = recorded.readings
    n = len(readings)
    assert readings.names == mt.read_network(NETWORK_FILE).names == ('mag_1', 'mag_2')
    assert readings.stamp_ns.shape == readings.sensor.shape == (n,) and n == 2800
    assert readings.stamp_ns.dtype == np.int64 and readings.field.shape == (n, 3)
    # Order of magnitude of the Earth's field [T].
    assert 1e-6 < np.median(np.linalg.norm(readings.field, axis=1)) < 1e-4
    (name, (stamps, positions, quaternions)), = recorded.truth.items()
    assert name == 'vehicle_00' and (np.diff(stamps) > 0).all()
    assert positions.shape == (len(stamps), 3) and quaternions.shape == (len(stamps), 4)
    assert recorded.rejected == recorded.lost == {} and recorded.missing_topics == ()
    assert repr(recorded) == 'RecordedReadings(2800 readings of mag_1, mag_2; truth: vehicle_00)'


def test_tracking_a_recording_equals_a_replay(result, vehicle_replays):
    run, folder = vehicle_replays[NAME]
    pd.testing.assert_frame_equal(
        result.poses_dataframe().astype({'ambiguous': int}), read_csv(folder / 'poses.csv'),
        check_exact=True)
    pd.testing.assert_frame_equal(
        result.smoothed_dataframe().drop(columns='complete').astype({'ambiguous': int}),
        read_csv(folder / 'poses_smoothed.csv'), check_exact=True)
    pd.testing.assert_frame_equal(
        result.detections_dataframe(), read_csv(folder / 'detections.csv'), check_exact=True)
    assert len(result.poses) == len(result.smoothed) > 20 and result.smoothed['complete'].all()
    assert result.report.counts == run.summary['counts']
    assert result.report.rejected == run.summary['rejected']
    entry, = run.summary['tracks']
    assert result.tracks[1].summary() == {k: entry[k] for k in result.tracks[1].summary()}
    errors = result.errors()
    assert errors and errors == {k: entry['truth'][k] for k in errors}


def test_arrays_give_the_same_result_as_the_recording(result, recorded):
    assert are_identical(mt.track(recorded, mt.read_network(NETWORK_FILE)), result)
    r = recorded.readings
    arrays = mt.readings_from_arrays(np.array(r.names)[r.sensor], r.stamp_ns, r.field, r.covariance)
    from_arrays = mt.track(arrays, NETWORK_FILE)
    assert are_identical(from_arrays, result)
    assert from_arrays.truth == {} and from_arrays.errors() is None


def test_tracking_arrays_of_a_magnet_equals_a_replay(magnet_runs, magnet_replays):
    recording, network = magnet_runs[1]
    run, folder = magnet_replays[1]
    found = mt.track(mt.read_recording(recording, network).readings, network, 'magnet')
    pd.testing.assert_frame_equal(
        found.poses_dataframe().astype({'ambiguous': int}), read_csv(folder / 'poses.csv'),
        check_exact=True)
    assert len(found.poses) > 10 and found.report.counts == run.summary['counts']


def test_settings_override_the_defaults(recorded, result):
    found = mt.track(recorded, NETWORK_FILE, settings={'align.period_s': 0.2})
    assert found.settings.align.period_s == 0.2 and 0 < len(found.poses) < len(result.poses)
    with pytest.raises(mt.SettingsError, match='mean track.iterations'):
        mt.track(recorded, NETWORK_FILE, settings={'track.iteration': 2})
    with pytest.raises(mt.SettingsError, match='vehicle or magnet'):
        mt.track(recorded, NETWORK_FILE, 'tank')


def test_dataframes_have_units(result):
    for frame, columns, extra in (
            (result.poses_dataframe(), names_of(POSES), ()),
            (result.smoothed_dataframe(), names_of(SMOOTHED), ('complete',)),
            (result.detections_dataframe(), names_of(DETECTIONS), ())):
        assert tuple(frame.columns) == (*columns, *extra)
        assert set(frame.attrs['units']) <= set(frame.columns)
    units = result.poses_dataframe().attrs['units']
    assert units['stamp_ns'] == 'ns' and units['sd_y'] == 'm' and units['vx'] == 'm/s'
    assert units['mz'] == 'A m^2'
    dimensionless = {'track_id', 'weight', 'ambiguous', 'kind', 'kind_weight', 'doubts'}
    assert set(units) == set(names_of(POSES)) - dimensionless


def test_result_arrays_have_the_fields_of_the_records(result):
    n = len(result.poses)
    assert result.poses['covariance'].shape == (n, 6, 6)
    assert set(result.poses['kind']) <= {'small', 'car', 'truck'}
    assert result.poses['ambiguous'].dtype == bool
    assert ((result.poses['doubts'] != '') == result.poses['ambiguous']).all()
    assert result.disturbances == ()
    assert result.detections['onset'].tolist() == [True, False]
    seconds = np.diff(result.poses['stamp_ns']) / 1e9
    np.testing.assert_allclose(seconds, 0.08, atol=1e-6)


def test_a_long_arrival_name_is_not_truncated(recorded):
    long_name = 'from the right, where the road comes over the bridge'
    found = mt.track(recorded, NETWORK_FILE, settings=QUICK | {
        'track.vehicle.arrival_names': ['left', long_name, 'rear']})
    assert long_name in found.poses['arrival'] and found.smoothed['complete'].all()


@pytest.mark.parametrize('source', ['nothing', 'noise'])
def test_no_target_gives_empty_arrays(recorded, result, source):
    r = recorded.readings
    # The car arrives after 4 s.
    quiet = r.part(r.stamp_ns < r.stamp_ns[0] + (0 if source == 'nothing' else 4_000_000_000))
    found = mt.track(quiet, NETWORK_FILE)
    for name in ('poses', 'smoothed', 'detections'):
        assert getattr(found, name).shape == (0,)
        assert getattr(found, name).dtype == getattr(result, name).dtype
        frame = getattr(found, f'{name}_dataframe')()
        assert len(frame) == 0
        assert list(frame.columns) == list(getattr(result, f'{name}_dataframe')().columns)
    assert found.tracks == {} and found.report.rejected == {}
    assert found.report.sensors_without_background == (
        () if source == 'noise' else ('mag_1', 'mag_2'))
    assert ('/mag_1/imu/mag' in repr(found)) is (source == 'nothing')
    with pytest.raises(mt.UnknownTrackError, match='no tracks'):
        found.map_figure()


def test_rejected_readings_are_counted(recorded):
    r = recorded.readings
    field = r.field.copy()
    field[100:110] *= 1e4
    names = np.array(r.names)[r.sensor].astype('U8')
    names[500:520] = 'mag_9'
    found = mt.track(mt.readings_from_arrays(names, r.stamp_ns, field), NETWORK_FILE)
    assert sum(found.report.rejected.values()) == 30
    assert '20 unknown sensor' in repr(found) and 'not used' in repr(found)


def test_losses_of_a_damaged_recording_are_reported(tmp_path):
    damaged = tmp_path / 'damaged.mcap'
    content = vehicle_path(NAME).read_bytes()
    damaged.write_bytes(content[:len(content) // 2])
    assert mt.track(damaged, NETWORK_FILE).report.lost
    assert mt.read_recording(damaged, NETWORK_FILE).lost


FIELD, STAMPS = np.zeros((3, 3)), np.arange(3)


@pytest.mark.parametrize('sensor, stamp_ns, field, covariance, text', [
    (['a'] * 3, STAMPS, np.zeros((3, 2)), None, r'field: expected shape \(3, 3\).*got \(3, 2\)'),
    (['a'] * 3, STAMPS, np.zeros(9), None, r'field: expected shape \(3, 3\)'),
    (['a'] * 2, STAMPS, FIELD, None, r'stamp_ns: expected shape \(2,\).*got \(3,\)'),
    (['a'] * 3, 0.01 * STAMPS, FIELD, None, 'stamp_ns: .*time_unit'),
    (['a'] * 3, 5, FIELD, None, 'stamp_ns'),
    (['a'] * 3, STAMPS, FIELD.astype(str), None, 'field: expected floats, got <U'),
    (['a'] * 3, STAMPS, FIELD, np.eye(3), r'covariance: expected shape \(3, 3, 3\)'),
    (['a', 'b', 'a'], [5, 3, 7], FIELD, None, r'reading 1 \(b\) is 2e-09 s older .* sort'),
    ('abc', STAMPS, FIELD, None, "'abc'"),
    (['a'] * 3, np.arange(3, dtype=np.uint64) + 2**63, FIELD, None, 'stamp_ns: .* since 1970'),
    (['a'] * 3, np.full(3, -2**63), FIELD, None, 'stamp_ns: .* since 1970'),
])
def test_invalid_arrays_are_refused(sensor, stamp_ns, field, covariance, text):
    with pytest.raises(mt.ReadingsError, match=text) as caught:
        mt.readings_from_arrays(sensor, stamp_ns, field, covariance)
    assert isinstance(caught.value, ValueError) and isinstance(caught.value, mt.MagTrackingError)


def test_masked_axes_become_nan():
    field = np.ma.masked_greater(np.arange(9.0).reshape(3, 3), 6.0)
    found = mt.readings_from_arrays(['a'] * 3, STAMPS, field).field
    np.testing.assert_array_equal(np.isnan(found), np.arange(9.0).reshape(3, 3) > 6.0)
    assert len(mt.readings_from_arrays([], [], [])) == 0


def test_times_may_be_datetime64_with_or_without_a_time_zone():
    stamps = 1_777_852_561_123_456_789 + 10_000_000 * np.arange(3)
    utc = pd.Series(pd.to_datetime(stamps, utc=True))
    for times in (stamps.astype('M8[ns]'), pd.Series(stamps.astype('M8[ns]')), utc,
                  utc.dt.tz_convert('Europe/Stockholm'), pd.DatetimeIndex(utc)):
        found = mt.readings_from_arrays(['a'] * 3, times, np.ones((3, 3)))
        assert found.stamp_ns.tolist() == stamps.tolist()
    milliseconds = mt.readings_from_arrays(['a'] * 3, stamps.astype('M8[ns]').astype('M8[ms]'),
                                           np.ones((3, 3)))
    assert milliseconds.stamp_ns.tolist() == (stamps // 10**6 * 10**6).tolist()


@pytest.mark.parametrize('is_recording', [False, True])
def test_masked_timestamps_are_refused(
        recorded, is_recording):
    r = recorded.readings
    masked = replace(r, stamp_ns=np.ma.masked_equal(r.stamp_ns, r.stamp_ns[5]))
    with pytest.raises(mt.ReadingsError, match='stamp_ns: masked'):
        mt.track(replace(recorded, readings=masked) if is_recording else masked, NETWORK_FILE)


@pytest.mark.parametrize('changes, text', [
    ({'sensor': np.array([0, 1, 2, 0, 1, 2])}, r'\(0 \.\. 1\), got 0 \.\. 2'),
    ({'sensor': np.array([0, 1, -1, 0, 1, 0])}, r'got -1 \.\. 1'),
    ({'field': np.zeros((5, 3))}, r'field: expected shape \(6, 3\)'),
    ({'stamp_ns': np.arange(6.0)}, 'stamp_ns: expected integers, nanoseconds'),
    ({'names': ('left', 'right')}, 'left, right, .*mag_1, mag_2'),
    ({'stamp_ns': np.array([0, 60, 120, 1, 61, 121]) * 1_000_000_000},
     r'reading 3 \(mag_2\) is 119 s older'),
])
def test_invalid_readings_are_refused(readings, changes, text):
    with pytest.raises(mt.ReadingsError, match=text):
        mt.track(replace(readings, **changes), NETWORK_FILE)


def test_slightly_late_readings_are_tracked(recorded):
    """A recording stores readings in order of arrival, which may not be chronological."""
    r = recorded.readings
    delayed = replace(r, stamp_ns=r.stamp_ns + np.where(r.sensor == 1, -30_000_000, 0))
    assert (np.diff(delayed.stamp_ns) < 0).any()
    assert len(mt.track(delayed, NETWORK_FILE).tracks) == 1


def test_missing_files_are_refused(tmp_path):
    with pytest.raises(mt.RecordingError, match='none.mcap'):
        mt.track(tmp_path / 'none.mcap', NETWORK_FILE)
    with pytest.raises(mt.NetworkError):
        mt.read_recording(vehicle_path(NAME), tmp_path / 'none.yaml')


@pytest.mark.parametrize('name', ['poses', 'smoothed', 'detections'])
def test_the_error_without_pandas_names_the_extra(monkeypatch, result, name):
    monkeypatch.setitem(sys.modules, 'pandas', None)
    with pytest.raises(mt.MissingDependencyError, match=r'pip install mag_tracking\[pandas\]'):
        getattr(result, f'{name}_dataframe')()
    assert len(getattr(result, name))


def test_a_track_has_a_map_a_weights_and_a_field_figure(result):
    from matplotlib.figure import Figure
    titles = set()
    for name in ('map', 'weights', 'field'):
        figure = getattr(result, f'{name}_figure')()
        assert isinstance(figure, Figure)
        stream = io.BytesIO()
        figure.savefig(stream)
        assert stream.getvalue().startswith(b'\x89PNG')
        titles.add(figure.get_suptitle() or figure.axes[0].get_title())
    assert len(titles) == 3 and all('Track 1' in title for title in titles)
    labels = [line.get_label() for line in result.map_figure(1).axes[0].lines]
    assert {'truth', 'smoothed', 'magnetometers'} <= set(labels)
    assert isinstance(result.pass_figure(), Figure)
    with pytest.raises(mt.UnknownTrackError, match='track 7 .*: 1'):
        result.map_figure(7)


def test_the_fit_dataframe_equals_the_table_of_the_command(tmp_path):
    found = mt.fit(vehicle_path(NAME), NETWORK_FILE, orders=[1, 3])
    fitted_pass, = found.passes
    assert not found.report.warnings() and fitted_pass.chosen.n_dipoles == 3
    frame = found.to_dataframe()
    assert tuple(frame.columns) == names_of(FITS) and len(frame) == 2
    assert frame.attrs['units']['sd_mx'] == 'A m^2' and frame.attrs['units']['cpa_time'] == 's'
    with FitFolder(tmp_path) as folder:
        folder.add(fitted_pass)
    written = pd.read_csv(tmp_path / 'fits.csv', float_precision='round_trip',
                          keep_default_na=False, na_values=['nan'])
    pd.testing.assert_frame_equal(frame, written, check_exact=True, check_dtype=False)


def test_a_recording_without_a_pass_gives_an_empty_fit(tmp_path):
    cut = tmp_path / 'cut.mcap'
    content = vehicle_path(NAME).read_bytes()
    cut.write_bytes(content[:len(content) // 8])
    found = mt.fit(cut, NETWORK_FILE)
    assert found.passes == () and found.report.warnings()[0] in repr(found)
    assert tuple(found.to_dataframe().columns) == names_of(FITS) and len(found.to_dataframe()) == 0


@pytest.mark.parametrize('arguments, text', [
    ({'orders': [0]}, r'orders: .*\[0\]'),
    ({'orders': []}, 'orders'),
    ({'cpa_range': (4.0, 0.3)}, 'cpa_range: '),
])
def test_fit_refuses_invalid_arguments(arguments, text):
    with pytest.raises(mt.SettingsError, match=text):
        mt.fit(vehicle_path(NAME), NETWORK_FILE, **arguments)


def test_the_plan_from_python_equals_the_plan_of_the_command(tmp_path):
    assert main(['plan', '--network', str(NETWORK_FILE), '--target', 'truck', '--heading', '0',
                 '--grid', '9', '--out', str(tmp_path)]) == 0
    written = json.loads((tmp_path / 'plan.json').read_text())
    found = mt.plan(NETWORK_FILE, 'truck', heading=np.array([0.0]), grid=9)
    assert found.position_std.tolist() == written['position_std']
    assert list(found.best_position) == written['best_position']
    with pytest.raises(mt.SettingsError, match='^moment: '):
        mt.plan(NETWORK_FILE, 'magnet')
