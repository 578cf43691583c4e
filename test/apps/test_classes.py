"""`mag-tracking classes`: tables, labelled intervals of recordings, and invalid inputs."""

import csv
import json

import numpy as np
import pytest

from mag_tracking.apps.classes import examples_of, labelled_signatures
from mag_tracking.cli import main
from mag_tracking.errors import LabelsError
from mag_tracking.network.file import read_network
from support.bundled import DATA, NETWORK_FILE, vehicle_path
from support.labelled_passes import signatures, write_by_row, write_by_sample

COUNTS = {'car': 25, 'truck': 10}
ROAD = DATA / 'two_way_road'


@pytest.fixture(scope='module')
def tables(tmp_path_factory):
    """Folder with two tables of the same signatures: a row per sample, and a row per signature."""
    folder, found = tmp_path_factory.mktemp('classes'), signatures(COUNTS, 'boxes')
    write_by_sample(folder / 'by_sample.csv', found)
    write_by_row(folder / 'by_row.csv', found)
    return folder


@pytest.mark.parametrize('name', ['by_sample', 'by_row'])
def test_commands_train_evaluate_and_predict(tables, tmp_path, capsys, name):
    table, model = str(tables / f'{name}.csv'), str(tmp_path / 'classes.json')
    assert main(['classes', 'evaluate', table, '--splits', '3']) == 0
    printed = capsys.readouterr().out
    for text in ('largest class: 7', 'balanced accuracy: ', 'recall of truck: ',
                 'calibration error'):
        assert text in printed
    assert main(['classes', 'train', table, '--out', model]) == 0
    assert '25 of car, 10 of truck' in capsys.readouterr().out
    assert main(['classes', 'evaluate', table, '--model', model]) == 0
    assert main(['classes', 'predict', table, '--model', model]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert 'car' in last and 'truck' in last


def test_both_table_formats_give_the_same_signatures(tables):
    by_sample, by_row = (
        labelled_signatures(tables / f'{name}.csv') for name in ('by_sample', 'by_row'))
    assert [s.label for s in by_sample] == [s.label for s in by_row]
    np.testing.assert_allclose(by_sample[0].field[0], by_row[0].field[0])


def write_intervals(path, rows, header=('label', 'begin_s', 'end_s')):
    with open(path, 'w', newline='') as stream:
        csv.writer(stream).writerows([header, *rows])
    return path


def test_a_labelled_interval_gives_one_signature_per_sensor(tmp_path):
    truth = json.loads((ROAD / 'two_way_road.truth.json').read_text())
    vehicles = [v for k, v in enumerate(truth['vehicles'])
                if all(abs(v['cpa_time_s'] - w['cpa_time_s']) > 5.0
                       for j, w in enumerate(truth['vehicles']) if j != k)]
    rows = [('truck' if v['length_m'] > 6 else 'car', v['cpa_time_s'] - 2.0, v['cpa_time_s'] + 2.0)
            for v in vehicles]
    network = read_network(NETWORK_FILE)
    found = labelled_signatures(ROAD / 'two_way_road.mcap', write_intervals(
        tmp_path / 'a.csv', rows), network)
    # The network has two sensors, each with two axes.
    assert len(found) == 2 * len(rows) and all(s.field.shape[1] == 2 for s in found)
    epoch = truth['epoch_s']
    absolute_rows = [(label, round((epoch + a) * 1e9), round((epoch + b) * 1e9), 'mag_2')
                     for label, a, b in rows]
    of_mag_2 = labelled_signatures(ROAD / 'two_way_road.mcap', write_intervals(
        tmp_path / 'b.csv', absolute_rows, ('label', 'begin_ns', 'end_ns', 'sensor')), network)
    assert len(of_mag_2) == len(rows) and all('mag_2' in s.source for s in of_mag_2)
    assert {s.label for s in of_mag_2} == {'car', 'truck'}


@pytest.mark.parametrize(('rows', 'error'), [
    ([('car', 5, 9), ('truck', 8, 11)], 'rows 2 and 3 overlap'),
    ([('', 5, 9)], 'row 2: '), ([('car', 9, 5)], 'end after'),
    ([('car', 5000, 5009)], 'no readings')])
def test_invalid_intervals_are_reported(tmp_path, rows, error):
    with pytest.raises(LabelsError, match=error):
        labelled_signatures(vehicle_path('straight_car_right'),
                            write_intervals(tmp_path / 'a.csv', rows),
                            read_network(NETWORK_FILE))


@pytest.mark.parametrize(('text', 'message'), [
    ('a,x0,x1\n1,2,3\n', "'label' is missing"),
    ('label,x,y\ncar,1,2\n', 'numbered columns'),
    ('label,x0,x1,y0\ncar,1,2,3\n', 'each axis'),
    ('label,x0,x1,bx0,bx1\ncar,1,2,3,4\n', 'x0, ... '),
    ('label,x0,x2\ncar,1,2\n', 'x0, ... '),
    ('label,x_nt_0,y_0\ncar,1,2\n', 'some fields'),
    ('label,signature,time_s,x,bx\ncar,1,0,1,2\n', 'axis x'),
    ('label,signature,time_s\ncar,1,0\n', 'a field'),
    ('label,time_s,x\ncar,0,1\n', 'identifies'),
    ('label,signature,time_s,x\ncar,1,0,1\ncar,2,1,2\n', 'one sample'),
    ('label,signature,time_s,x\ncar,1,0,1\ntruck,1,1,2\n',
     'label: car, truck'),
    ('label,x0,x1\ncar,1,2\n', 'row 2: '),
    ('label,x0,x1\ncar,1,two\n', "row 2: x1 is 'two'"),
    ('label,x0\n', 'a.csv has no')])
def test_an_invalid_table_is_rejected_with_its_error(tmp_path, capsys, text, message):
    """The message is compared, because training with such a table fails even without the check."""
    path = tmp_path / 'a.csv'
    path.write_text(text)
    assert main(['classes', 'train', str(path), '--out', str(tmp_path / 'm.json')]) == 1
    assert message in capsys.readouterr().err and not (tmp_path / 'm.json').exists()


def test_invalid_arguments_are_refused(tmp_path, tables, capsys):
    by_row = str(tables / 'by_row.csv')
    (tmp_path / 'other.json').write_text('{"a": 1}')
    assert main(['classes', 'predict', by_row, '--model', str(tmp_path / 'other.json')]) == 1
    assert "'mag_tracking.classes' is missing" in capsys.readouterr().err
    assert main(['classes', 'train', str(vehicle_path('straight_car_right')), '--out',
                 str(tmp_path / 'm.json')]) == 1
    assert 'labelled intervals' in capsys.readouterr().err
    assert main(['classes', 'evaluate', by_row, '--splits', '0']) == 1
    assert '--splits' in capsys.readouterr().err


def test_a_model_of_other_axes_is_refused(tables, tmp_path, capsys):
    model = str(tmp_path / 'classes.json')
    assert main(['classes', 'train', str(tables / 'by_row.csv'), '--out', model]) == 0
    write_by_row(tmp_path / 'two.csv', [])
    (tmp_path / 'two.csv').write_text('label,' + ','.join(f'x{k}' for k in range(20)) + '\ncar,'
                                      + ','.join(str(k * (19 - k)) for k in range(20)) + '\n')
    assert main(['classes', 'predict', str(tmp_path / 'two.csv'), '--model', model]) == 1
    assert 'on x y z' in capsys.readouterr().err


def test_units_are_converted_or_refused(tables, tmp_path, capsys):
    """The signatures are given in nanotesla, tesla, microtesla and an unknown unit."""
    found = signatures(COUNTS, 'boxes')
    for name, suffix, unit in (('t', '_t', 1.0), ('ut', '_ut', 1e6), ('none', '', 1e9)):
        write_by_sample(tmp_path / f'{name}.csv', found, unit)
        text = (tmp_path / f'{name}.csv').read_text().replace('_nt', suffix)
        (tmp_path / f'{name}.csv').write_text(text)
    model = str(tmp_path / 'classes.json')
    assert main(['classes', 'train', str(tables / 'by_sample.csv'), '--out', model]) == 0
    predictions = []
    for path in (tables / 'by_sample.csv', tmp_path / 't.csv', tmp_path / 'ut.csv'):
        capsys.readouterr()
        assert main(['classes', 'predict', str(path), '--model', model]) == 0
        predictions.append(capsys.readouterr().out.splitlines()[-1])
    assert len(set(predictions)) == 1 and 'car' in predictions[0]
    assert main(['classes', 'predict', str(tmp_path / 'none.csv'), '--model', model]) == 1
    assert 'trained on T' in capsys.readouterr().err


def test_signatures_of_events_can_be_classified(tmp_path, capsys):
    """Signatures of events have no values before the first and after the last reading."""
    recording, network = str(ROAD / 'two_way_road.mcap'), str(NETWORK_FILE)
    assert main(['replay', recording, '--network', network, '--tables', 'events',
                 '--out', str(tmp_path)]) == 0
    found = labelled_signatures(tmp_path / 'signatures.csv', is_labelled=False)
    usable = examples_of(found)
    assert len(usable.labels) > 0.9 * len(found) and usable.unit == 'T'


def test_an_inconsistent_model_is_refused(tables, tmp_path, capsys):
    model = tmp_path / 'classes.json'
    assert main(['classes', 'train', str(tables / 'by_row.csv'), '--out', str(model)]) == 0
    valid_model = json.loads(model.read_text())
    changes = [({name: value}, f'{name}: expected ') for name, value in (
        ('weights', [[1.0]]), ('weights', [[1.0], [1.0, 2.0]]), ('temperature', 0),
        ('temperature', 10**400), ('limit', True), ('limit', None), ('scale', 0),
        ('classes', ['car']), ('classes', ['car', 'car']),
        ('classes', 'car'), ('offsets', [1.0]), ('mean', None), ('mean', []), ('unit', 7),
        ('examples', 3))]
    contents = [({**valid_model, **change}, message) for change, message in changes]
    contents += [({k: v for k, v in valid_model.items() if k != name},
                  f'the entry {name!r} is missing') for name in valid_model]
    contents += [({**valid_model, 'more': 1}, "unknown entry 'more'"),
                 ([valid_model], 'expected a mapping'),
                 (valid_model['mean'], 'expected a mapping')]
    for content, message in contents:
        model.write_text(json.dumps(content))
        assert main(['classes', 'predict', str(tables / 'by_row.csv'), '--model', str(model)]) == 1
        assert message in capsys.readouterr().err
    model.write_text('{')
    assert main(['classes', 'predict', str(tables / 'by_row.csv'), '--model', str(model)]) == 1
    assert 'valid JSON' in capsys.readouterr().err
    model.write_text(json.dumps({**valid_model, 'mag_tracking.classes': 99}))
    assert main(['classes', 'predict', str(tables / 'by_row.csv'), '--model', str(model)]) == 1
    assert 'version 99' in capsys.readouterr().err
    model.write_text(json.dumps(valid_model))
    table = tmp_path / 'table.csv'
    table.write_text((tables / 'by_row.csv').read_text())
    assert main(['classes', 'train', str(table), '--out', str(table)]) == 1
    assert 'an input' in capsys.readouterr().err
