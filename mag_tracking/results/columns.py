"""Columns of the tables of results: name, type, unit, meaning and value.

CSV files, DataFrames, Parquet files and the reference are created from these columns.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

DIRECTIONS = {True: 'forward', False: 'backward'}

_CONVERSIONS: Mapping[str, Callable[[Any], Any]] = {
    'i': int, 'f': float, 'b': bool, 'C': lambda v: v.ravel().tolist(),
    's': lambda v: ' '.join(v) if isinstance(v, tuple) else str(v)}


class Column(NamedTuple):
    """Description of a column of a table."""

    name: str
    kind: str
    """Type: 't' for UTC time, 'i' for integer, 'f' for float, 's' for string, 'b' for boolean, and
    'C' for a (6, 6) matrix in row-major order, which is NaN if it is unknown."""
    unit: str
    """Unit; empty for a dimensionless column."""
    meaning: str
    get: Callable[[Any], Any] | None = None
    """Function that returns the value of a record; None for the attribute `name`."""

    def of(self, record: Any) -> Any:
        """Value of a record, or values (n,) of an object whose attributes are arrays (n, ...)."""
        return self.get(record) if self.get else getattr(record, self.name)


def columns_of(kind: str, unit: str, /, **meanings: str) -> tuple[Column, ...]:
    """Create columns of the same type and unit from their descriptions by name."""
    return tuple(Column(name, kind, unit, meaning) for name, meaning in meanings.items())


def axes(name: str, unit: str, meaning: str, get: Callable[..., Any] | None = None
         ) -> tuple[Column, ...]:
    """Create columns for x, y and z, which replace {} in `name`; `get(record, k=axis)`."""
    return tuple(Column(name.format(axis), 'f', unit, f'{meaning}, {axis}',
                        get and partial(get, k=k)) for k, axis in enumerate('xyz'))


def pick(columns: Iterable[Column], names: str) -> tuple[Column, ...]:
    """Columns with the given names, separated by spaces, in that order."""
    by_name = {c.name: c for c in columns}
    return tuple(by_name[name] for name in names.split())


def names_of(columns: Iterable[Column]) -> tuple[str, ...]:
    """Names of columns."""
    return tuple(c.name for c in columns)


def row_of(columns: Iterable[Column], record: Any, known: Mapping[str, Any] | None = None
           ) -> dict[str, Any]:
    """Values of a record by column; `known` values replace those of the record."""
    known = known or {}
    return {c.name: known[c.name] if c.name in known else _CONVERSIONS[c.kind](c.of(record))
            for c in columns}


_RECORDING = columns_of('s', '', recording='name of the recording')
_STAMP = columns_of('i', 'ns', stamp_ns='timestamp, measured from 1970-01-01 UTC')
_TRACK_ID = Column('track_id', 'i', '', 'identifier of the track within the recording',
                   lambda p: p.id)
_VELOCITY = axes('v{}', 'm/s', 'velocity', lambda p, k: p.velocity[..., k])
_STATE_AND_SD = (
    *axes('{}', 'm', 'position in the world frame', lambda p, k: p.position[..., k]), *_VELOCITY,
    *axes('sd_{}', 'm', 'standard deviation of the position',
          lambda p, k: np.sqrt(p.covariance[..., k, k])),
    *axes('sd_v{}', 'm/s', 'standard deviation of the velocity',
          lambda p, k: np.sqrt(p.covariance[..., 3 + k, 3 + k])))
MOMENT = axes('m{}', 'A m^2', 'magnetic moment', lambda p, k: p.moment[..., k])
STATE = (*_STATE_AND_SD, *MOMENT)
_LENGTH = (
    Column('length', 'f', 'm', 'length of the row of dipoles; 0 for a point target'),
    Column('sd_length', 'f', 'm', 'standard deviation of the length', lambda p: p.length_std))
_AMBIGUOUS = columns_of(
    'b', '', ambiguous='whether the pose is ambiguous and must not be relied on')
_KIND = columns_of('s', '', kind='kind of vehicle, such as car or truck; empty for magnets')
_DELAY_SPEED = columns_of(
    'f', 'm/s', delay_speed='model-free speed from the delay between sensors',
    sd_delay_speed='standard deviation of the model-free speed')

POSES = (
    *_STAMP, _TRACK_ID, *STATE,
    *columns_of('f', '', weight='probability of the published hypothesis'), *_AMBIGUOUS, *_KIND,
    *columns_of('f', '', kind_weight='probability of the kind'), *_LENGTH,
    *columns_of('s', '', doubts='reasons why the pose is ambiguous'))
SMOOTHED = (*_STAMP, _TRACK_ID, *STATE, *_AMBIGUOUS, *_KIND, *_LENGTH)
COMPLETE = columns_of('b', '', complete='whether the pose is smoothed over the whole track')
HYPOTHESES = (
    *_STAMP, _TRACK_ID,
    *columns_of('s', '', arrival='assumed arrival direction', kind='assumed kind of vehicle'),
    *columns_of('f', '', weight='probability of the hypothesis'), *STATE)
DETECTIONS = (
    *_STAMP, Column('id', 'i', '', 'number of the detection'),
    Column('event', 's', '', 'onset or release', lambda d: np.where(d.onset, 'onset', 'release')),
    *columns_of('f', '', statistic='whitened energy of the frame'),
    *columns_of('i', '', degrees_of_freedom='degrees of freedom of the statistic'),
    *columns_of('f', '', threshold='threshold of the statistic for an onset',
                false_alarm_probability='probability that noise alone exceeds the threshold'),
    *columns_of('s', '', strongest_sensor='sensor with the largest whitened energy per axis'))
DISTURBANCES = (
    *_STAMP, Column('id', 'i', '', 'number of the disturbance'),
    *columns_of('b', '', ended='whether the disturbance has ended'),
    *columns_of('i', 'ns', begin_ns='beginning of the disturbance'),
    *columns_of('f', 'T', largest='largest magnitude of the field at any sensor'),
    *columns_of('s', '', sensors='affected sensors, the strongest first'),
    *columns_of('f', '', uniform='probability of one common field across the network'),
    *columns_of('i', '', track_id='latest track that the disturbance has made ambiguous'))

RESULT_TABLES = {'poses.csv': POSES, 'poses_smoothed.csv': SMOOTHED, 'detections.csv': DETECTIONS,
                 'disturbances.csv': DISTURBANCES, 'hypotheses.csv': HYPOTHESES}

EVENTS = (
    *columns_of('s', '', sensor='name of the sensor'),
    *columns_of('i', '', number='number of the event at the sensor, from 1'),
    *columns_of('b', '', ended='whether the target has left the range of the sensor'),
    *columns_of('i', 'ns', onset_ns='time of the onset', release_ns='end of the detection',
                peak_ns='time of the largest field'),
    *axes('peak_{}_nt', 'nT', 'largest field, sensor frame', lambda e, k: 1e9 * e.peak[k]),
    Column('energy_nt2_s', 'f', 'nT^2 s', 'energy of the field', lambda e: 1e18 * e.energy),
    *columns_of('s', '', axes='measured axes'),
    *columns_of('i', 'ns', closest_ns='time of the closest point of approach'),
    Column('sd_closest_s', 'f', 's', 'standard deviation of the time of the closest point',
           lambda e: e.closest_std),
    Column('time_scale_s', 'f', 's', 'range at the closest point divided by the speed',
           lambda e: e.time_scale),
    Column('left_to_right', 'f', '', 'probability of a motion from left to right, as seen from the '
           'sensor', lambda e: round(e.left_to_right, 4)))
SIGNATURES = (*pick(EVENTS, 'sensor number'), *columns_of('f', 's', time_s='time since the onset'),
              *axes('{}_nt', 'nT', 'field, sensor frame'))

FIT_STATE = (
    *_STATE_AND_SD,
    *columns_of('f', 'm/s', speed='speed from the fit', sd_speed='standard deviation of the speed'),
    *columns_of('f', 'deg', heading_deg='heading from the fit, anticlockwise from x',
                sd_heading_deg='standard deviation of the heading'),
    *columns_of('f', 'm', length='length of the row of dipoles',
                sd_length='standard deviation of the length'),
    *MOMENT, *axes('sd_m{}', 'A m^2', 'standard deviation of the moment'))
FITS = (
    *_RECORDING, Column('pass', 'i', '', 'index of the detection in the recording, from 1'),
    *columns_of('i', '', vehicle='index of the vehicle within the detection, from 1',
                n_vehicles='number of vehicles fitted jointly',
                n_dipoles='number of dipoles in the fitted row'),
    *columns_of('b', '', chosen='whether the fit is chosen among those of its pass'),
    *columns_of('s', '', reason='reason why the fit is not trusted; empty if it is trusted'),
    *_STAMP, *columns_of('i', '', n_values='number of measured field components',
                         n_unknowns='number of unknowns'),
    *columns_of('f', '', normalised_cost='cost of the fit per degree of freedom; about 1 for '
                                         'a correct model',
                explained='fraction of the field energy that the fit explains',
                residual_elsewhere='unexplained fraction of the energy outside the reach of the '
                                   'vehicle',
                velocity_change='apparent relative change of the velocity during the pass'),
    *columns_of('s', '', trusted='quantities that are valid even if the fit is not trusted'),
    *columns_of('b', '', ambiguous='whether a different path is possible'),
    *FIT_STATE,
    *columns_of('f', 's', cpa_time='time of the closest point of approach (CPA) to the centre of '
                                   'the sensors, after `stamp_ns`',
                sd_cpa_time='standard deviation of the time of the CPA'),
    *columns_of('f', 'm', cpa_range='range at the CPA',
                sd_cpa_range='standard deviation of the range at the CPA'),
    *columns_of('f', '1/s', rate='speed divided by the range at the CPA, for a single sensor',
                sd_rate='standard deviation of the rate'),
    *_DELAY_SPEED,
    *columns_of('f', 'deg', delay_heading_deg='model-free heading from the delays',
                sd_delay_heading_deg='standard deviation of the model-free heading'),
    *columns_of('s', '', no_delay='reason why there is no velocity from the delays'))
"""Columns of `fits.csv`. For a fit that is not trusted as a whole, only the trusted quantities are
written, and only if the fit is reported for its pass."""

_CLASS = Column('class', 's', '', 'class of the vehicles', lambda p: p.vehicle_class)
_DIRECTION = Column('direction', 's', '', 'direction across the line: forward or backward',
                    lambda p: DIRECTIONS[p.forward])
PASSAGES = (
    *_RECORDING,
    *columns_of('i', '', number='index of the passage in chronological order, from 1'),
    *columns_of('i', 'ns', stamp_ns='time at which the middle of the vehicle was on the line'),
    *columns_of('s', '', line='name of the counting line'),
    *columns_of('i', '', track_id='identifier of the track'), _DIRECTION,
    *columns_of('f', '', direction_error='probability that the direction is wrong'),
    *axes('{}', 'm', 'position on the line', lambda p, k: p.position[k]),
    *columns_of('f', 'm', lateral='distance from the middle of the line, positive to the left of '
                                  'the forward direction'), *_VELOCITY,
    Column('heading_deg', 'f', 'deg', 'direction of the velocity, anticlockwise from x',
           lambda p: np.degrees(np.arctan2(p.velocity[1], p.velocity[0]))),
    Column('sd_heading_deg', 'f', 'deg', 'standard deviation of the heading',
           lambda p: np.degrees(p.heading_std)),
    *columns_of('f', 'm/s', speed='horizontal speed'),
    Column('sd_speed', 'f', 'm/s', 'standard deviation of the speed', lambda p: p.speed_std),
    *_DELAY_SPEED,
    *columns_of('b', '',
                speeds_contradict='whether the speeds of track and delay contradict each other'),
    *_LENGTH, *MOMENT,
    Column('moment_size', 'f', 'A m^2', 'magnitude of the magnetic moment',
           lambda p: np.linalg.norm(p.moment)),
    _CLASS._replace(meaning='most probable class, or unknown'))
INTERVALS = (
    *_RECORDING,
    *columns_of('i', 'ns', begin_ns='beginning of the interval', end_ns='end of the interval'),
    *pick(PASSAGES, 'line'),
    *columns_of('f', 's', observed_s='time within the interval that is covered by frames'),
    _DIRECTION, _CLASS, *columns_of('i', '', count='number of vehicles'),
    Column('n_ambiguous', 'i', '', 'number of ambiguous passages', lambda c: c.ambiguous),
    *columns_of('f', 'm/s', mean_speed='mean speed of the vehicles'),
    *columns_of('f', 's', mean_headway='mean headway of the vehicles'))


def traffic_tables(class_names: Sequence[str], with_fleet: bool) -> dict[str, tuple[Column, ...]]:
    """Columns of the tables `passages` and `intervals`, with a probability per class."""
    classes = tuple(Column(f'p_{name}', 'f', '', f'probability of the class {name}')
                    for name in class_names)
    vehicle = (
        *columns_of('s', '', vehicle='name of the matching enrolled vehicle, or unknown'),
        *columns_of('f', '', p_vehicle='probability of the vehicle among the enrolled vehicles '
                                       'that can be compared at this heading'))
    return {'passages': (
        *PASSAGES, *classes, *(vehicle if with_fleet else ()),
        *columns_of('f', 's', headway='time since the previous vehicle in the same direction'),
        *columns_of('b', '', ambiguous='whether the passage is ambiguous'),
        *columns_of('s', '', doubts='reasons why the passage is ambiguous')),
        'intervals': INTERVALS}
