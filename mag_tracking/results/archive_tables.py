"""Tables of an archive: columns with type, unit and meaning."""

from mag_tracking.results.columns import (
    FIT_STATE,
    FITS,
    POSES,
    STATE,
    Column,
    axes,
    columns_of,
    pick,
)

_COMMON = (
    Column('recording', 's', '', 'name of the recording: the stem of its file name'),
    Column('source', 's', '', 'path of the recording'), *pick(POSES, 'stamp_ns'),
    Column('time', 't', '', 'timestamp as UTC time, without a time zone'))
_POSES = (*_COMMON, *pick(POSES, 'track_id'), *STATE,
          Column('covariance', 'C', 'm, m/s', 'covariance of position and velocity'),
          *pick(POSES, 'kind length ambiguous'))

TABLES: dict[str, tuple[Column, ...]] = {
    'tracks': (
        *_COMMON, *pick(POSES, 'track_id'),
        Column('end_ns', 'i', 'ns', 'timestamp of the last pose'),
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
        *pick(POSES, 'mx my mz'), *columns_of('f', 'A m^2', moment_size='magnitude of the moment'),
        *columns_of('f', 'm/s', smoothed_speed='horizontal speed at the most certain pose of the '
                                               'smoothed track; null if there is no such track'),
        *columns_of('f', 'A m^2', smoothed_moment_size='magnitude of the moment at the most '
                                                       'certain pose of the smoothed track')),
    'poses': (
        *_POSES, *pick(POSES, 'weight kind_weight'),
        *columns_of('s', '', arrival='arrival direction of the published hypothesis'),
        *pick(POSES, 'doubts')),
    'smoothed': _POSES,
    'passes': (
        *_COMMON, Column('number', 'i', '', 'index of the detection in the recording, from 1'),
        *pick(FITS, 'vehicle n_vehicles n_dipoles n_values reason trusted'),
        Column('notes', 's', '', 'remarks, such as excluded measurements and the reason'),
        *pick(FITS, 'normalised_cost explained'), *FIT_STATE,
        *pick(FITS, 'delay_speed sd_delay_speed delay_heading_deg sd_delay_heading_deg')),
    'health': (
        *_COMMON, *columns_of('s', '', sensor='name of the sensor'),
        *columns_of('i', '', accepted='number of readings accepted since the previous row',
                    rejected='number of readings rejected since the previous row',
                    times_relearnt='number of times the background was relearnt'),
        *columns_of('b', '', ready='whether the background has been estimated',
                    stuck='whether the sensor repeats the same value',
                    doubtful='whether the background is doubtful'),
        *axes('background_{}', 'T', 'background, sensor frame'),
        *axes('drift_{}', 'T/s', 'drift of the background, sensor frame'),
        *axes('noise_{}', 'T', 'standard deviation of one reading, sensor frame')),
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
