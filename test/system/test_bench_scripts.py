"""Scripts of `make bench`: they rarely run, so their imports are tested here."""

import importlib.util
import runpy

import pytest

from bench import situations
from support.bundled import ROOT


@pytest.mark.parametrize('path', sorted((ROOT / 'test' / 'bench').glob('*.py')),
                         ids=lambda p: p.stem)
def test_a_bench_script_can_be_imported(path):
    assert runpy.run_path(str(path), run_name='imported')['__doc__']


def test_the_cost_fraction_of_the_disturbance_model_is_measured():
    """The script names the timed methods in strings, so it would miss a renamed method."""
    assert 0.0 < situations.cost() < 1.0


def test_the_questions_of_the_archive_example_run_on_an_empty_archive(tmp_path):
    spec = importlib.util.spec_from_file_location('archive_questions',
                                                  ROOT / 'examples' / 'archive_questions.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    connection = module.open_archive(tmp_path)
    assert [len(connection.sql(sql).fetchall()) for sql in module.QUESTIONS.values()] == [0] * 4
