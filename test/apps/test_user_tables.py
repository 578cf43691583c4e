"""Readings from DataFrames and arrays: the same tracks as from the recording, and clear errors."""

import numpy as np
import pandas as pd
import pytest

import mag_tracking as mt
from mag_tracking.apps.readings import source_of
from support.bundled import NETWORK_FILE, QUICK, vehicle_path

NETWORK = mt.read_network(NETWORK_FILE)
READINGS = mt.read_recording(vehicle_path('straight_car_right'), NETWORK).readings
NAMES = np.array(READINGS.sensor_names())
LONG = pd.DataFrame({'sensor': NAMES, 'time': READINGS.stamp_ns,
                     **dict(zip('xyz', READINGS.field.T, strict=True))})


FIELD = np.zeros((3, 3))


def arrays():
    """{sensor: (times, fields)} of the recording."""
    return {name: (READINGS.stamp_ns[NAMES == name], READINGS.field[NAMES == name])
            for name in NETWORK.names}


def with_datetimes(zone=None):
    """Long table with an index of datetimes."""
    return LONG.drop(columns='time').set_index(
        pd.to_datetime(LONG['time'], utc=True).dt.tz_convert(zone))


def wide(columns):
    """Table with a row per time and columns named by the function `columns`."""
    parts = []
    for name, (stamps, fields) in arrays().items():
        parts.append(pd.DataFrame(fields, index=pd.to_datetime(stamps),
                                  columns=[columns(name, axis) for axis in 'xyz']))
    return pd.concat(parts, axis=1).sort_index()


@pytest.fixture(scope='module')
def expected():
    return mt.track(READINGS, NETWORK, settings=QUICK)


@pytest.mark.parametrize('source', [
    LONG, LONG.rename(columns={'time': 'stamp_ns'}), with_datetimes(), with_datetimes('Asia/Tokyo'),
    wide(lambda name, axis: f'{name}_{axis}'), wide(lambda name, axis: f'{name}.B{axis}'),
    wide(lambda name, axis: (name, axis)), arrays()],
    ids=['long', 'stamp_ns', 'datetimes', 'zone', 'wide', 'with_a_dot', 'two_levels', 'arrays'])
def test_tables_and_arrays_give_the_tracks_of_the_recording(source, expected):
    found = mt.track(source, NETWORK, settings=QUICK)
    np.testing.assert_array_equal(found.poses['position'], expected.poses['position'])


def test_floats_need_a_unit(expected):
    seconds = LONG.assign(time=(LONG['time'] - LONG['time'].iloc[0]) / 1e9)
    found = mt.track(seconds, NETWORK, settings=QUICK, time_unit='s')
    np.testing.assert_allclose(found.poses['position'], expected.poses['position'], atol=1e-6)
    with pytest.raises(mt.ReadingsError, match='time_unit'):
        mt.track(seconds, NETWORK)
    with pytest.raises(mt.ReadingsError, match="'minutes'"):
        mt.track(seconds, NETWORK, time_unit='minutes')
    with pytest.raises(mt.ReadingsError, match='time_unit'):
        mt.track(READINGS, NETWORK, time_unit='s')


def test_all_functions_accept_a_table():
    table = with_datetimes()
    assert len(mt.events(table, NETWORK, QUICK).events) == 2
    assert len(mt.traffic(table, NETWORK, QUICK).vehicles) == 1
    assert len(mt.fit(table, NETWORK, QUICK, orders=(1,)).passes) == 1


WIDE = wide(lambda name, axis: f'{name}_{axis}')


def test_absent_sensors_and_unmeasured_axes_are_reported():
    alone = mt.track(LONG[LONG['sensor'] == 'mag_1'], NETWORK)
    assert alone.report.missing_topics == ('/mag_2/imu/mag',)
    assert any('mag_2' in line for line in alone.report.warnings())
    assert any('scale' in line for line in alone.report.warnings())
    planar = mt.track(LONG.assign(z=np.nan), NETWORK, settings=QUICK)
    assert len(planar.tracks) == 1


def test_names_of_sensors_may_end_like_an_axis():
    network = mt.SensorNetwork(('bx', 'gate_z'), NETWORK.positions, NETWORK.R_ws,
                               ('bx/mag', 'gate_z/mag'))
    for separator in ('', '_', '.'):
        table = WIDE.rename(columns=lambda c, separator=separator: c.replace(
            'mag_1_', f'bx{separator}').replace('mag_2_', f'gate_z{separator}'))
        source = source_of(table, network)
        assert not source.missing_topics() and set(source.readings.names) == {'bx', 'gate_z'}


MIXED = LONG.assign(time=[pd.Timestamp(t, tz='UTC' if k % 2 else 'Asia/Tokyo')
                          for k, t in enumerate(LONG['time'])])


@pytest.mark.parametrize('table, term', [
    (LONG.drop(columns='time'), 'no times'), (LONG.drop(columns=list('xyz')), 'x, y, z'),
    (LONG.assign(x=LONG['x'].astype(str)), "'x'"), (LONG.assign(time=LONG['time'].astype(str)),
                                                    'time: '),
    (MIXED.astype({'time': object}), 'time: '), (LONG.iloc[::-1], 'mag_'),
    (pd.concat([LONG, LONG]).sort_values('time'), 'mag_1: its reading 1 '),
    (LONG.assign(time=LONG['time'] / 1e9).assign(time=np.nan), 'time'),
    (wide(lambda name, axis: f'{name}_{axis}').assign(temperature=20.0), "'temperature'"),
    (LONG.assign(sensor='mag_9'), 'mag_9'), (LONG.drop(columns='z'), 'column for z'),
    (WIDE.drop(columns='mag_1_z'), 'mag_1: .*z'), (WIDE.assign(mag_1_X=0.0), 'mag_1_X'),
    (WIDE.assign(humidity=40.0), "'humidity'"), (LONG[['time']], 'no columns'),
    (pd.concat([LONG, LONG['sensor']], axis=1), "'sensor'"), (LONG.assign(t=1), 'time, t'),
    (LONG.assign(time=np.full(len(LONG), '2600-01-01', dtype='datetime64[s]')),
     'time: ')])
def test_tables_with_faults_are_refused(table, term):
    with pytest.raises(mt.ReadingsError, match=term):
        mt.track(table, NETWORK)


@pytest.mark.parametrize('unit, factor', [('s', 10**3), ('ms', 10**6)])
@pytest.mark.parametrize('number', [int, float])
def test_times_in_a_smaller_unit_than_stated_are_refused(unit, factor, number):
    times = (LONG['time'] // (1_000_000_000 // factor)).astype(number)
    with pytest.raises(mt.ReadingsError, match='time_unit'):
        mt.track(LONG.assign(time=times), NETWORK, time_unit=unit)


@pytest.mark.parametrize('source', [None, [1, 2], np.zeros((3, 3)), LONG['x']])
def test_other_types_of_sources_are_refused(source):
    with pytest.raises(mt.ReadingsError, match=type(source).__name__):
        mt.track(source, NETWORK)


@pytest.mark.parametrize('faulty, term', [
    ({'mag_1': (1, 2)}, 'mag_1'), ({'mag_1': 5}, 'mag_1'), ({1: (np.arange(3), FIELD)}, '1: '),
    ({}, 'no sensors'), ({'mag_1': (np.arange(3), np.zeros((3, 2)))}, r'mag_1: .*\(3, 3\)'),
    ({'mag_1': (np.arange(3), np.zeros((2, 3)))}, 'mag_1'),
    ({'mag_1': (np.arange(3),)}, 'mag_1'),
    ({'mag_1': (np.zeros(3, dtype=int), np.zeros((3, 3)))}, 'mag_1: its reading 1 '),
    ({'mag_1': (np.arange(3.0), np.zeros((3, 3)))}, 'time_unit')])
def test_arrays_with_faults_are_refused(faulty, term):
    with pytest.raises(mt.ReadingsError, match=term):
        mt.track(faulty, NETWORK)
