"""Generated Benchmarks page of the documentation."""

import importlib.util
import json
import re

import pytest

from support.bundled import ROOT

VALUE = {'value': 1.5, 'unit': 'a|b', 'aim': 2.0, 'more_is_better': False}
RUN = {'arguments': [], 'commit': 'abc', 'date': '2026-01-01T00:00:00', 'machine': 'm',
       'python': '3.12'}


@pytest.fixture
def generator():
    """Module of the generator, loaded from the folder of the documentation."""
    spec = importlib.util.spec_from_file_location(
        'benchmark_page', ROOT / 'docs' / 'generator' / 'benchmark_page.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize('note, cell', [
    ('|error| < 2 m', r'\|error\| < 2 m'), ('two\nlines | each', r'two lines \| each'), ('', '')])
def test_pipes_do_not_add_cells_to_a_row(generator, monkeypatch, tmp_path, note, cell):
    (tmp_path / 'latest.json').write_text(json.dumps(
        {'replay': {**RUN, 'figures': {'P(x | y)': {**VALUE, 'note': note}}}}))
    monkeypatch.setattr(generator, 'LATEST', tmp_path / 'latest.json')
    (row,) = (line for line in generator.benchmark_page().splitlines() if line.startswith('| P(x'))
    cells = [c.strip() for c in re.split(r'(?<!\\)\|', row)[1:-1]]
    assert cells == [r'P(x \| y)', r'1.5 a\|b', r'≤ 2 a\|b', 'yes', cell]


def test_a_figure_without_a_note_has_an_empty_remark(generator, monkeypatch, tmp_path):
    (tmp_path / 'latest.json').write_text(json.dumps(
        {'replay': {**RUN, 'figures': {'x': VALUE}}}))
    monkeypatch.setattr(generator, 'LATEST', tmp_path / 'latest.json')
    assert '| yes |  |' in generator.benchmark_page()
