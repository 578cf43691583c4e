"""Tables of an archive: columns with type, unit and meaning."""

from mag_tracking.results.parquet_table import Column, columns_of


def _axes(prefix: str, unit: str, meaning: str) -> tuple[Column, ...]:
    """Columns for the x, y and z components of a vector."""
    return tuple(Column(f'{prefix}{axis}', 'f', unit, f'{meaning}, {axis}') for axis in 'xyz')


_COMMON = (
    Column('recording', 's', '', 'name of the recording: the stem of its file name'),
    Column('source', 's', '', 'path of the recording'),
    Column('stamp_ns', 'i', 'ns', 'timestamp, measured from 1970-01-01 UTC'),
    Column('time', 't', '', 'timestamp as UTC time, without a time zone'))
_TRACK = (Column('track_id', 'i', '', 'identifier of the track within the recording'),)
_STATE = (*_axes('', 'm', 'position in the world frame'), *_axes('v', 'm/s', 'velocity'))
_STATE_SD = (*_axes('sd_', 'm', 'standard deviation of the position'),
             *_axes('sd_v', 'm/s', 'standard deviation of the velocity'))
_MOMENT = _axes('m', 'A m^2', 'magnetic moment')
_KIND = (Column('kind', 's', '', 'kind of vehicle, such as car or truck; empty for magnets'),)

_POSES = (
    *_COMMON, *_TRACK, *_STATE, *_STATE_SD, *_MOMENT,
    Column('covariance', 'C', 'm, m/s', 'covariance of position and velocity'),
    *_KIND, Column('length', 'f', 'm', 'length of the row of dipoles; 0 for a point target'),
    Column('ambiguous', 'b', '', 'whether the pose is ambiguous and must not be relied on'))

TABLES: dict[str, tuple[Column, ...]] = {
    'tracks': (
        *_COMMON, *_TRACK, Column('end_ns', 'i', 'ns', 'timestamp of the last pose'),
        *columns_of('i', '', poses='number of published poses'),
        *columns_of('s', '', arrival='most probable arrival direction',
                    kind='most probable kind of vehicle',
                    verdict='ambiguous if the last or the most certain pose is ambiguous, '
                            'otherwise unique',
                    doubts='reasons why poses of the track are ambiguous'),
        *columns_of('f', '', arrival_weight='probability of the arrival direction',
                    kind_weight='probability of the kind',
                    ambiguous_share='fraction of poses that are ambiguous',
                    nis_per_axis='mean normalised innovation squared per axis; about 1 or less '
                                 'for a consistent filter'),
        *columns_of('f', 'm', length='length of the row of dipoles; 0 for a point target',
                    smallest_sd='smallest standard deviation of the horizontal position'),
        *columns_of('f', 'm/s', speed='horizontal speed at the most certain pose'),
        *columns_of('f', 'deg',
                    heading_deg='heading at the most certain pose, anticlockwise from x'),
        *_MOMENT, *columns_of('f', 'A m^2', moment_size='magnitude of the moment'),
        *columns_of('f', 'm/s', smoothed_speed='horizontal speed at the most certain pose of the '
                                               'smoothed track; null if there is no such track'),
        *columns_of('f', 'A m^2', smoothed_moment_size='magnitude of the moment at the most '
                                                       'certain pose of the smoothed track')),
    'poses': (
        *_POSES, *columns_of('f', '', weight='probability of the published hypothesis',
                             kind_weight='probability of the kind'),
        *columns_of('s', '', arrival='arrival direction of the published hypothesis',
                    doubts='reasons why the pose is ambiguous')),
    'smoothed': _POSES,
    'passes': (
        *_COMMON, *columns_of('i', '', number='index of the detection in the recording, from 1',
                              vehicle='index of the vehicle within the detection, from 1',
                              n_vehicles='number of vehicles fitted jointly',
                              n_dipoles='number of dipoles in the fitted row',
                              n_values='number of measured field components'),
        *columns_of('s', '', reason='reason why the fit is not trusted; empty if it is trusted',
                    trusted='quantities that are valid even if the fit is not trusted',
                    notes='remarks, such as excluded measurements and the reason'),
        *columns_of('f', '', normalised_cost='cost of the fit per degree of freedom; about 1 for '
                                             'a correct model',
                    explained='fraction of the field energy that the fit explains'),
        *_STATE, *_STATE_SD,
        *columns_of('f', 'm/s', speed='speed from the fit',
                    sd_speed='standard deviation of the speed'),
        *columns_of('f', 'deg', heading_deg='heading from the fit, anticlockwise from x',
                    sd_heading_deg='standard deviation of the heading'),
        *columns_of('f', 'm', length='length of the row of dipoles',
                    sd_length='standard deviation of the length'),
        *_MOMENT, *_axes('sd_m', 'A m^2', 'standard deviation of the moment'),
        *columns_of('f', 'm/s',
                    delay_speed='model-free speed from the delay between sensors',
                    sd_delay_speed='standard deviation of the model-free speed'),
        *columns_of('f', 'deg', delay_heading_deg='model-free heading from the delays',
                    sd_delay_heading_deg='standard deviation of the model-free heading')),
    'health': (
        *_COMMON, *columns_of('s', '', sensor='name of the sensor'),
        *columns_of('i', '', accepted='number of readings accepted since the previous row',
                    rejected='number of readings rejected since the previous row',
                    times_relearnt='number of times the background was relearnt'),
        *columns_of('b', '', ready='whether the background has been estimated',
                    stuck='whether the sensor repeats the same value',
                    doubtful='whether the background is doubtful'),
        *_axes('background_', 'T', 'background, sensor frame'),
        *_axes('drift_', 'T/s', 'drift of the background, sensor frame'),
        *_axes('noise_', 'T', 'standard deviation of one reading, sensor frame')),
    'recordings': (
        *_COMMON, *columns_of('s', '', error='reason why processing failed; empty if it succeeded',
                              lost='parts of the recording that could not be read',
                              rejected='number of rejected readings by cause',
                              missing_topics='topics of the network that were not recorded',
                              no_detection_reason='reason why no target was detected; empty if '
                                                  'targets were detected'),
        *columns_of('i', 'ns', end_ns='timestamp of the last frame'),
        *columns_of('i', '', frames='number of frames', tracks='number of tracks',
                    passes='number of rows in `passes`',
                    segments='number of separately tracked segments, each with a target near '
                             'the sensors'),
        *columns_of('i', 'bytes', size='size of the recording')),
}
"""Columns by table. Unknown values are null, and NaN in a covariance."""
