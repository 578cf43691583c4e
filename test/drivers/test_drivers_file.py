"""Drivers file: valid entries, defaults, custom classes and errors."""

from types import SimpleNamespace

import pytest
import yaml

from mag_tracking.drivers.configuration import KINDS, load_class, read_drivers
from mag_tracking.drivers.reading import FramedDevice
from mag_tracking.drivers.transports.i2c import I2cDevice
from mag_tracking.errors import SettingsError
from mag_tracking.network.file import read_network
from support.bundled import NETWORK_FILE, ROOT

BOARD = {'transport': 'serial', 'serial': {'port': '/dev/ttyUSB0'}, 'framing': 'text',
         'text': {'fields': ['x', 'y', 'z']}, 'sensor': 'mag_1'}


def read(tmp_path, content, network=None):
    """Read the drivers of a file with `content`."""
    path = tmp_path / 'drivers.yaml'
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return read_drivers(path, network)


def without(*keys, **more):
    """Entry `BOARD` with some keys removed and others added."""
    return {'board': {**{k: v for k, v in BOARD.items() if k not in keys}, **more}}


def test_the_example_file_is_valid():
    path = ROOT / 'config' / 'drivers.yaml'
    assert [d.name for d in read_drivers(path, read_network(NETWORK_FILE))] == ['roadside']


def test_every_entry_of_the_example_file_is_valid(tmp_path):
    text = (ROOT / 'config' / 'drivers.yaml').read_text()
    blocks = [b for b in text.split('\n\n') if 'sensor' in b and ('transport:' in b
                                                                  or 'device:' in b)]
    assert len(blocks) == 6
    for block in blocks:
        lines = block.splitlines()
        body = [line for line in lines if not line.startswith('#')] or [
            line.removeprefix('# ') for line in lines
            if line.startswith('#   ') or line.rstrip().endswith(':')]
        [driver] = read(tmp_path, '\n'.join(body).replace('config/network.yaml',
                                                          str(NETWORK_FILE)))
        assert driver.sensors and not driver.is_open


def test_a_framing_provides_defaults_for_clock_and_sequence(tmp_path):
    [driver] = read(tmp_path, {'mti': {
        'transport': 'serial', 'serial': {'port': '/dev/x'}, 'framing': 'xsens', 'sensor': 'a'}})
    assert driver.clock_settings.tick_s == 1e-4
    assert driver.settings.sequence_wrap == 2**16
    [driver] = read(tmp_path, {'mti': {
        'transport': 'serial', 'serial': {'port': '/dev/x'}, 'framing': 'xsens', 'sensor': 'a',
        'clock': {'wrap': 864000000}, 'sequence_wrap': 0, 'stamp_by': 'sequence'}})
    assert driver.clock_settings.tick_s == 1e-4 and driver.clock_settings.wrap == 864000000
    assert driver.settings.sequence_wrap == 0 and driver.settings.stamp_by == 'sequence'


@pytest.mark.parametrize('content, message', [
    (without('framing'), 'board: framing is missing'),
    (without('transport'), 'board: transport is missing'),
    (without(device='i2c'), 'device cannot'),
    (without(transport='carrier pigeon'), 'transport: '),
    (without(framing=['text']), 'framing: expected text'),
    (without(transport='no_such_module:Port'),
     'no_such_module:Port'),
    (without(transport='yaml:Port'), "module 'yaml'"),
    (without(serial={'prot': 'x'}), 'prot; did you mean port?'),
    (without(serial={'port': 'x', 'baud': 'fast'}), "baud: expected int, got 'fast'"),
    (without(serial='/dev/ttyUSB0'), "got '/dev/ttyUSB0'"),
    (without(text={'fields': ['x', 'y', 'w']}), 'board: '),
    (without(clock={'tick_s': -1.0}), 'tick_s: -1.0 is outside'),
    (without(uint='nT'), 'setting uint'),
    (without(binary={'sync': 'A5'}), 'remove binary, or change framing'),
    (without(transport='udp'), 'remove serial, or change transport'),
    (without(i2c={}),
     'remove i2c'),
    (without(json=None), 'board: json is'),
    (without(framing_settings={'fields': ['x']}), 'board: framing_settings is'),
    (without(clocks={'tick_s': 1.0}), 'clocks; did you mean clock?'),
    (without('serial', Serial=BOARD['serial']),
     'Serial; did you mean serial?'),
    (without(antenna={}), 'group antenna'),
    (without(serial={}), 'board: serial: '),
    (without('sensor'), 'expected `sensor: mag_1`, or `sensors:`'),
    (without(sensors={'A': 'mag_2'}), 'sensor and sensors'),
    ('{"\\ud800": {}}', "'\\ud800' is not"),
    (without('sensor', sensors={'\ud800': 'a'}), "sensors: '\\ud800'"),
    (without(text={'fields': ['\udcff']}), "fields: '\\udcff'"),
    (without('sensor', sensors={'A': 3}), 'sensors: A: '),
    (without('sensor', sensors={'1': 'a', 1: 'b'}),
     'name 1 at'),
    (without('sensor', sensors={1.1: 'a'}), 'sensors: 1.1'),
    (without('sensor', sensors={None: 'a'}), 'sensors: None'),
    (without(sensor='mag 1'), 'sensor: '),
    (without(framing='collections:OrderedDict'),
     'lacks SETTINGS, parse'),
    (without(framing='.x:Y'), 'framing: .x:Y'),
    (without('sensor', sensors={'A': 'a', 'B': 'a'}), 'board (A)'),
    ({**without(), 'other': BOARD}, 'other: sensor mag_1'),
    ({'board': 7}, 'got 7'),
    ('[1, 2]', 'of devices'), ('', 'of devices'),
    ('a: [', 'YAML'), ('a: 1\na: 2', 'duplicate key a')])
def test_invalid_files_are_refused(tmp_path, content, message):
    with pytest.raises(SettingsError) as error:
        read(tmp_path, content)
    assert message in str(error.value) and 'drivers.yaml' in str(error.value)


SERIAL = {'port': '/dev/ttyUSB0'}


@pytest.mark.parametrize('content, message', [
    ({'port': '/dev/ttyUSB0', 'board': without(serial={})}, 'under serial, udp or mqtt'),
    ({'board': without('serial'), 'serial': SERIAL}, 'Move serial into'),
    ({'transport': 'serial'}, 'Move transport into'),
    (without('serial', port='/dev/ttyUSB0'), 'serial: {port: ...}'),
    (without(text={**BOARD['text'], **SERIAL}), 'serial: {port: ...}'),
    (without(serial={**SERIAL, 'unit': 'nT'}), 'top level'),
    (without(clock=SERIAL), 'serial: {port: ...}'),
    (without(tick_s=1e-3), 'clock: {tick_s: '),
    ({'pi': {'device': 'i2c', 'i2c': {'sensors': ['A:lis3mdl:0x1c'], 'port': 1}, 'sensor': 'a'}},
     'uses i2c'),
    (without('transport', 'serial', 'framing', 'text', **SERIAL), 'no transport')])
def test_a_misplaced_setting_is_refused_with_its_place(tmp_path, content, message):
    with pytest.raises(SettingsError) as error:
        read(tmp_path, content)
    assert message in str(error.value)


def test_a_device_may_have_the_name_of_a_group(tmp_path):
    assert [d.name for d in read(tmp_path, {'serial': BOARD})] == ['serial']


def test_a_sensor_that_is_not_in_the_network_is_refused(tmp_path):
    network = read_network(NETWORK_FILE)
    assert read(tmp_path, BOARD and {'board': BOARD}, network)
    with pytest.raises(SettingsError, match='mag_7 .*mag_1, mag_2'):
        read(tmp_path, {'board': {**BOARD, 'sensor': 'mag_7'}}, network)


def test_a_missing_file_is_reported(tmp_path):
    with pytest.raises(SettingsError, match='nowhere.yaml'):
        read_drivers(tmp_path / 'nowhere.yaml')


@pytest.mark.parametrize('role, name', [(r, n) for r, kinds in KINDS.items() for n in kinds])
def test_every_kind_can_be_loaded_and_has_settings(role, name):
    assert load_class(role, name).SETTINGS()


class CustomFraming:
    SETTINGS = SimpleNamespace

    def __init__(self, settings):
        pass

    def parse(self, data, final=False):
        pass


def test_custom_framings_and_devices_are_loaded(tmp_path, monkeypatch):
    from mag_tracking.drivers.framings.text import TextSettings
    monkeypatch.setattr(CustomFraming, 'SETTINGS', TextSettings)
    [driver] = read(tmp_path, {'mine': {
        **{k: v for k, v in BOARD.items() if k != 'text'}, 'framing': f'{__name__}:CustomFraming',
        'framing_settings': {'max_length': 7}}})
    assert isinstance(driver.device, FramedDevice)
    [driver] = read(tmp_path, {'mine': {
        'device': 'mag_tracking.drivers.transports.i2c:I2cDevice', 'sensor': 'a',
        'device_settings': {'sensors': ['A:lis3mdl:0x1c']}}})
    assert isinstance(driver.device, I2cDevice)
