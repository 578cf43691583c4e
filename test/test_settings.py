"""Settings: generated files, validation of values, and parameter files."""

import dataclasses
import importlib.util
import re

import pytest
import yaml

from mag_tracking.errors import SettingsError
from mag_tracking.pipeline import Settings, settings_for
from mag_tracking.settings import (
    EXPERT,
    FORMER_SETTINGS,
    USER,
    flatten,
    read_parameter_file,
    replace,
    to_yaml,
)
from mag_tracking.stages.track.manager import TrackManager
from support.bundled import ROOT


def test_generated_files_are_up_to_date():
    spec = importlib.util.spec_from_file_location('generate', ROOT / 'tools/generate_config.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for path, content in module.generated().items():
        assert path.read_text(encoding='utf-8') == content, f'{path.name}: run `make config`'


@pytest.mark.parametrize('target', ['vehicle', 'magnet'])
def test_default_settings_survive_a_yaml_round_trip(target, tmp_path):
    path = tmp_path / 'p.yaml'
    path.write_text(to_yaml(settings_for(target)))
    changes = read_parameter_file(path)
    assert set(changes) == {p.name for p in flatten(Settings())}
    assert settings_for(target, changes) == settings_for(target)


def test_every_setting_is_documented_and_its_default_is_in_range():
    for p in flatten(Settings()):
        assert len(p.doc) > 10, p.name
        assert replace(Settings(), {p.name: p.value}) == Settings(), p.name


@pytest.mark.parametrize('changes, message', [
    ({'calibrate.guard_s': 4.0}, 'unknown setting calibrate.guard_s; it is now a constant'),
    ({'align': {'perod_s': 0.1}}, 'unknown setting align.perod_s; did you mean align.period_s'),
    ({'trak': {'x': 1}}, 'unknown setting trak.x; there is no group trak; did you mean track'),
    ({'trak': {'iteration': 1}}, r'there is no group trak; did you mean track.iterations\?'),
    ({'track.vehicel.x': 1}, r'no group track.vehicel; did you mean track.vehicle\?'),
    ({'foo': {'x': 1}}, 'no group foo; the groups are calibrate, align, detect, track, traffic'),
    ({'relearn_s': 3}, r'unknown setting relearn_s; did you mean calibrate.relearn_s\?'),
    ({'calibrate.relearn_s': {'x': 3}}, 'calibrate.relearn_s is a single setting'),
    ({'trak': {}}, r'unknown setting trak; did you mean track\?'),
    ({'track': 3}, 'track is a group of settings, such as track.target; .* got 3'),
    ({'track.vehicle': None}, 'track.vehicle is a group of settings, .* a mapping, got nothing'),
    ({'align.period_s': 'long'}, 'align.period_s: expected float'),
    ({'align.period_s': -1.0}, 'align.period_s: -1.0 is outside'),
    ({'align.period_s': float('nan')}, 'NaN'),
    ({'align.burst': 1}, 'align.burst: expected bool'),
    ({'detect.onset_frames': 2.5}, 'detect.onset_frames: expected int'),
    ({'detect.onset_frames': True}, 'detect.onset_frames: expected int'),
    ({'track.magnet.axis': [0.0, 1.0]}, 'track.magnet.axis: expected 3 values, got 2'),
    ({'track.vehicle.speeds': []}, 'at least one'),
    ({'track.vehicle.speeds': 5.0}, 'expected a list'),
    ({'track.vehicle.speeds': [5.0, 1e9]}, 'outside'),
    ({'track.vehicle.kinds': {'names': ['small', 'c\ud800r', 'truck']}},
     r"track.vehicle.kinds.names: 'c\\ud800r' is not text: it contains an unpaired surrogate"),
    ({'track.vehicle.kinds': ['car']}, 'kinds is a group of settings, such as .*kinds.names'),
    ({'track.vehicle.kinds.names': ['car', 'car']}, 'kinds.names: a name is duplicated'),
    ({'track.vehicle.kinds.names': ['a.b']}, "kinds.names: 'a.b' is not a valid name"),
    ({'track.vehicle.kinds.names': ['names']}, "kinds.names: 'names' is not a valid name"),
    ({'track.vehicle.kinds.names': []}, 'kinds.names: expected at least one value'),
    ({'track.vehicle.kinds.bus.height': 1.0}, 'bus is not in track.vehicle.kinds.names'),
    ({'track.vehicle.kinds.car.hight': 1.0}, r'did you mean track.vehicle.kinds.car.height\?'),
    ({'track.vehicle.heights': [1.0]}, 'it is now track.vehicle.kinds.car.height'),
    ({'track.vehicle.arrival_names': ['left', 'right', '\udcff']}, 'arrival_names: .* surrogate'),
])
def test_errors_name_the_invalid_setting(changes, message):
    with pytest.raises(SettingsError, match=message):
        replace(Settings(), changes)


def test_each_arrival_needs_a_heading(road_network):
    from mag_tracking.pipeline import Pipeline
    settings = settings_for('vehicle', {'track.vehicle.arrival_headings_deg': [0.0, 90.0]})
    with pytest.raises(SettingsError, match='arrival_headings_deg: expected 3 values'):
        Pipeline(road_network, settings)


def test_rows_of_a_table_are_added_and_removed():
    bus = {'length': 8.0, 'height': 1.2}
    changed = replace(Settings(), {'track': {'vehicle': {'kinds': {
        'names': ['bus', 'truck'], 'bus': bus, 'truck': {'moment': 2000.0}}}}}).track.vehicle.kinds
    default = {kind.name: kind for kind in Settings().track.vehicle.kinds}
    assert changed == (dataclasses.replace(default['car'], name='bus', **bus),
                       dataclasses.replace(default['truck'], moment=2000.0))


def test_the_targets_in_parameters_and_call_must_agree():
    with pytest.raises(SettingsError, match='magnet'):
        settings_for('vehicle', {'track.target': 'magnet'})
    with pytest.raises(SettingsError, match='expected vehicle or magnet'):
        settings_for('submarine')


def test_parameter_files_are_read_and_checked(tmp_path):
    path = tmp_path / 'p.yaml'
    path.write_text('tracker_node:\n  ros__parameters:\n    track:\n      iterations: 2\n'
                    'detection_node:\n  ros__parameters:\n    align.period_s: 0.1\n')
    assert read_parameter_file(path) == {'track.iterations': 2, 'align.period_s': 0.1}
    path.write_text('track: {vehicle: {moment: 100.0}}')
    assert read_parameter_file(path) == {'track.vehicle.moment': 100.0}
    path.write_text('base: &b {iterations: 2, end_nis: 9.0}\n'
                    'track: {<<: *b, iterations: 3}\n')
    assert read_parameter_file(path)['track.iterations'] == 3
    path.write_text('')
    assert read_parameter_file(path) == {}
    for content, message in (
            ('- 1', 'expected a mapping'), ('{a: [', 'not valid YAML'),
            ('track: 2001-13-45', 'not valid YAML'), ('{? [1] : 2}', 'is not a valid key'),
            ('[' * 3000, 'nested too deeply'), ('track: &t {a: *t}', 'an alias contains itself'),
            ('n: {ros__parameters: 5}', 'expected only a mapping'),
            ('n: {ros__parameters: {track.iterations: 2}}\ntrack: {iterations: 3}',
             'track: expected only'),
            ('track: {iterations: 2, iterations: 3}', 'duplicate key iterations'),
            ('track: {iterations: 2}\ntrack.iterations: 3', 'track.iterations is given twice'),
            ('a:\n  ros__parameters: {track.iterations: 2}\n'
             'b:\n  ros__parameters: {track.iterations: 3}', 'track.iterations is given twice')):
        path.write_text(content)
        with pytest.raises(SettingsError, match=message):
            read_parameter_file(path)
    with pytest.raises(SettingsError, match='cannot read'):
        read_parameter_file(tmp_path / 'nowhere.yaml')


def declared(settings, prefix=''):
    """{name: level} of the settings, in which a table counts as one."""
    out = {}
    for f in dataclasses.fields(settings):
        if f.metadata:
            out[prefix + f.name] = f.metadata['level']
        else:
            out |= declared(getattr(settings, f.name), f'{prefix}{f.name}.')
    return out


def test_settings_are_few_and_the_guide_names_those_of_users():
    levels = declared(Settings())
    of_users = {name for name, level in levels.items() if level == USER}
    assert len(of_users) <= 22 and len(levels) <= 75 and set(levels.values()) == {USER, EXPERT}
    guide = (ROOT / 'docs/guides/settings.md').read_text(encoding='utf-8')
    assert set(re.findall(r'`((?:\w+\.)+\w+)`', guide)) - {'config/default.yaml'} == of_users


def test_the_default_file_is_plain_yaml_with_the_settings_of_users():
    content = yaml.safe_load((ROOT / 'config/default.yaml').read_text(encoding='utf-8'))
    assert content['/**']['ros__parameters']['calibrate']['max_field'] == 1e-3
    parameters = flatten(Settings())
    assert read_parameter_file(ROOT / 'config/default.yaml') == {
        p.name: list(p.value) if isinstance(p.value, tuple) else p.value
        for p in parameters if p.level == USER}


@pytest.mark.parametrize('changes, message', [
    ({'track.vehicle.arrival_names': ['a']},
     r'arrival_headings_deg: expected 1 value \(one per arrival name\), got 3'),
    ({'track.vehicle.kinds.small.length_std': 1.0}, 'small.length_std: 1 for a point'),
    ({'track.vehicle.kinds.small.difference_std': 9.0}, 'small.difference_std: 9 for a point')])
def test_related_lists_are_checked_against_each_other(road_network, changes, message):
    with pytest.raises(SettingsError, match=message):
        TrackManager(road_network, settings_for('vehicle', changes).track)


def test_every_former_name_has_a_current_setting():
    known = {p.name for p in flatten(Settings())}
    assert set(FORMER_SETTINGS.values()) - known - {''} == set()
    assert set(FORMER_SETTINGS) & known == set()
