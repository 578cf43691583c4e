"""The tables of an archive: their columns, with kind, unit and meaning."""

from mag_tracking.recording.parquet_table import Column, columns_of


def _axes(prefix: str, unit: str, meaning: str) -> tuple[Column, ...]:
    """Three, x y z."""
    return tuple(Column(f'{prefix}{axis}', 'f', unit, f'{meaning}, {axis}') for axis in 'xyz')


_WHERE = (
    Column('recording', 's', '', 'name of the recording: the stem of its file'),
    Column('source', 's', '', 'path of the recording'),
    Column('stamp_ns', 'i', 'ns', 'timestamp, since 1970'),
    Column('time', 't', '', 'the timestamp as a time of UTC'))
_TRACK = (Column('track_id', 'i', '', 'number of the track within the recording'),)
_STATE = (*_axes('', 'm', 'position in the frame of the network'), *_axes('v', 'm/s', 'velocity'))
_STATE_SD = (*_axes('sd_', 'm', 'standard deviation of the position'),
             *_axes('sd_v', 'm/s', 'standard deviation of the velocity'))
_MOMENT = _axes('m', 'A m^2', 'magnetic moment')
_KIND = (Column('kind', 's', '', 'car or truck; empty for magnets'),)

_POSES = (
    *_WHERE, *_TRACK, *_STATE, *_STATE_SD, *_MOMENT,
    Column('covariance', 'C', 'm, m/s', 'covariance of position and velocity'),
    *_KIND, Column('length', 'f', 'm', 'length of the row of dipoles'),
    Column('ambiguous', 'b', '', 'whether the pose is not to be relied on'))

TABLES: dict[str, tuple[Column, ...]] = {
    'tracks': (
        *_WHERE, *_TRACK, Column('end_ns', 'i', 'ns', 'timestamp of the last pose'),
        *columns_of('i', '', poses='number of published poses'),
        *columns_of('s', '', arrival='most probable arrival', kind='most probable kind',
                  verdict='unique or ambiguous', doubts='all doubts that there were'),
        *columns_of('f', '', arrival_weight='probability of the arrival',
                  kind_weight='probability of the kind',
                  ambiguous_share='share of poses that are ambiguous',
                  nis_per_axis='mean normalised innovation squared; about one is right'),
        *columns_of('f', 'm', length='length of the row of dipoles',
                  smallest_sd='smallest standard deviation of the position'),
        *columns_of('f', 'm/s', speed='speed at the surest pose'),
        *columns_of('f', 'deg', heading_deg='direction there, from x towards y'),
        *_MOMENT, *columns_of('f', 'A m^2', moment_size='length of the moment'),
        *columns_of('f', 'm/s', smoothed_speed='speed of the smoothed track; null without one'),
        *columns_of('f', 'A m^2',
                    smoothed_moment_size='length of the moment of the smoothed track')),
    'poses': (
        *_POSES, *columns_of('f', '', weight='weight of the hypothesis',
                  kind_weight='probability of the kind'),
        *columns_of('s', '', arrival='arrival that it assumes', doubts='names of the doubts')),
    'smoothed': _POSES,
    'passes': (
        *_WHERE, *columns_of('i', '', number='number of the detection in the recording',
                           vehicle='number of the vehicle among those of the detection',
                           n_vehicles='vehicles that were fitted together',
                           n_dipoles='dipoles of the fitted row', n_values='measurements'),
        *columns_of('s', '', reason='why the fit is not to be believed; empty where it is',
                  trusted='what is to be believed all the same',
                  notes='what was left out of the measurements'),
        *columns_of('f', '', normalised_cost='about one where the model is right',
                  explained='share of the energy that the fit explains'),
        *_STATE, *_STATE_SD,
        *columns_of('f', 'm/s', speed='speed of the fit', sd_speed='its standard deviation'),
        *columns_of('f', 'deg', heading_deg='direction of the fit',
                  sd_heading_deg='its standard deviation'),
        *columns_of('f', 'm', length='length of the row of dipoles',
                  sd_length='its standard deviation'),
        *_MOMENT, *_axes('sd_m', 'A m^2', 'standard deviation of the moment'),
        *columns_of('f', 'm/s', delay_speed='speed by the delay between sensors, without a model',
                  sd_delay_speed='its standard deviation'),
        *columns_of('f', 'deg', delay_heading_deg='direction by the delay',
                  sd_delay_heading_deg='its standard deviation')),
    'health': (
        *_WHERE, *columns_of('s', '', sensor='name of the sensor'),
        *columns_of('i', '', accepted='readings used since the row before',
                  rejected='readings rejected since then', times_relearnt='of the background'),
        *columns_of('b', '', ready='whether the background is known',
                  stuck='whether the sensor repeats itself',
                  doubtful='whether the background is doubtful'),
        *_axes('background_', 'T', 'background, sensor frame'),
        *_axes('drift_', 'T/s', 'drift of the background'),
        *_axes('noise_', 'T', 'standard deviation of one reading')),
    'recordings': (
        *_WHERE, *columns_of('s', '', error='why the recording failed; empty where it did not',
                           lost='what could not be read', rejected='readings that were not used',
                           missing_topics='topics of the network that are not in it',
                           no_detection_reason='one sentence where nothing was detected'),
        *columns_of('i', 'ns', end_ns='timestamp of the last frame'),
        *columns_of('i', '', frames='frames of the network', tracks='number of tracks',
                  passes='rows of `passes`',
                  segments='stretches in which a target was near'),
        *columns_of('i', 'bytes', size='size of the recording')),
}
"""{table: columns}. Values that are not known are null."""
