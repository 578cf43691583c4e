"""YAML files: limits on size and depth, in every reader, and short error messages."""

import pytest

from mag_tracking.drivers.configuration import read_drivers
from mag_tracking.errors import MagTrackingError, SettingsError
from mag_tracking.files import MAX_BYTES, MAX_DEPTH, MAX_ENTRIES, MAX_NODES, read_yaml
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Settings
from mag_tracking.recording.reader import Recording
from mag_tracking.settings import read_parameter_file, replace


def nested_aliases(n, form='[{}]', width=9):
    """YAML with anchors a0 .. an; each contains `width` aliases of the previous anchor in the
    format `form`."""
    lines = ['a0: &a0 {x: 1}']
    lines += [f'a{k}: &a{k} ' + form.format(', '.join([f'*a{k - 1}'] * width))
              for k in range(1, n + 1)]
    return '\n'.join(lines) + '\n'


def error_message(read, path):
    with pytest.raises(MagTrackingError) as error:
        read(path)
    return str(error.value)


@pytest.mark.parametrize('read, key', [
    (read_network, 'frame'), (read_parameter_file, 'track'), (read_drivers, 'board'),
    (lambda path: Recording(path.parent), 'rosbag2_bagfile_information')])
def test_aliases_that_expand_to_gigabytes_are_refused(tmp_path, read, key):
    path = tmp_path / 'metadata.yaml'
    for n in (6, 40):
        path.write_text(f'{nested_aliases(n)}{key}: *a{n}\n')
        message = error_message(read, path)
        assert all(part in message for part in (str(path), f'{MAX_NODES} ', '(line 7)'))


@pytest.mark.parametrize('text, message', [
    (nested_aliases(40, '{{<<: [{}]}}', 2), 'aliases expand'),
    (nested_aliases(40, '{{a: [{}]}}', 2), 'aliases expand'),
    (nested_aliases(100, width=1), f'more than {MAX_DEPTH} levels (line 64)'),
    ('[' * 80 + ']' * 80, f'{MAX_DEPTH} levels (line 1)'),
    ('[' * 5000, 'too deeply'),
    ('a: 1\nb: &b {c: *b}', 'itself (line 2)'),
    ('&a [[*a]]', 'itself (line 1)'),
    ('a: &a {<<: *a}', 'itself (line 1)'),
    ('a:\n' + ''.join(f'  b{k}: 1\n' for k in range(MAX_ENTRIES + 1)),
     f'{MAX_ENTRIES} entries'),
    ('#' * (MAX_BYTES + 1), f'{MAX_BYTES / 1e6:g} MB'),
    ('a: 0x' + 'f' * 9000, '36000 bits')])
def test_excessive_content_is_refused_with_its_line(tmp_path, text, message):
    path = tmp_path / 'a.yaml'
    path.write_text(text)
    assert message in error_message(lambda path: read_yaml(path, SettingsError), path)


def test_repeated_aliases_are_accepted(tmp_path):
    path = tmp_path / 'a.yaml'
    path.write_text('a: &a [1, 2]\nb: &b {c: *a, d: *a}\ne: {<<: *b, f: *b}\n' + 'g: ['
                    + ', '.join(['*a'] * 20_000) + ']\n')
    content = read_yaml(path, SettingsError)
    b = {'c': [1, 2], 'd': [1, 2]}
    assert content['b'] == b and content['e'] == {**b, 'f': b} and len(content['g']) == 20_000


@pytest.mark.parametrize('read, key', [
    (read_network, 'frame'), (read_drivers, 'board'),
    (lambda path: replace(Settings(), read_parameter_file(path)), 'align.period_s')])
def test_an_error_message_does_not_repeat_the_whole_file(tmp_path, read, key):
    path = tmp_path / 'a.yaml'
    path.write_text(f'{key}: [{", ".join(["[1, 2, 3]"] * 1000)}]')
    assert len(error_message(read, path)) < 1000


def test_a_huge_integer_is_reported_by_its_size():
    for name in ('align.period_s', 'detect.onset_frames'):
        with pytest.raises(SettingsError, match=f'{name}: .*20001 bits'):
            replace(Settings(), {name: 1 << 20_000})
