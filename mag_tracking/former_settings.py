"""Former settings of the pipeline, and what became of them."""

_CONSTANTS = {
    'calibrate': 'look_ahead_s memory_s guard_s block_s freeze_std max_forward_jump_s '
                 'max_backward_jump_s',
    'align': 'max_backward_jump_s',
    'detect': 'release_probability',
    'events': 'max_sensors',
    'track': 'prune_ratio max_initial_hypotheses relinearise_interval_s relinearise_max_hypotheses',
    'track.vehicle': 'lateral_std along_std max_start_distance speed_std cross_speed_std climb_std '
                     'turn_share',
    'track.magnet': 'start_margin grid_points starts near_field_length',
    'survey': 'compass_bias_std accelerometer_bias max_clock_offset_s max_accelerations'}
"""{group: settings that are constants now}."""

_COLUMNS = {
    ('track.vehicle.', 'track.vehicle.kinds.car.'): 'length length_std moment moment_std '
    'difference_std height height_std near_field_length',
    ('traffic.line_', 'traffic.lines.road.'): 'offset half_width',
    ('traffic.class_', 'traffic.classes.car.'): 'share moment moment_spread length length_spread'}
"""{(prefix of lists, prefix in a table): names, which had an s as lists}."""

FORMER_SETTINGS = {
    **{f'{group}.{name}': '' for group, names in _CONSTANTS.items() for name in names.split()},
    **{f'{old}{name}s': new + name for (old, new), names in _COLUMNS.items()
       for name in names.split()},
    'traffic.line_headings_deg': 'traffic.lines.road.heading_deg',
    'traffic.line_names': 'traffic.lines.names', 'traffic.class_names': 'traffic.classes.names'}
"""{former setting: its current name, for one row of a table; empty if it is a constant}."""
