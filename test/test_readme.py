"""README: length, pictures, links and commands."""

import re
import subprocess
import sys

import pytest

from mag_tracking.cli import main
from support.bundled import ROOT

README_TEXT = (ROOT / 'README.md').read_text(encoding='utf-8')
MAX_WORDS = 600
SHELL_LINES = re.findall(r'^\$ (.+)$', README_TEXT, re.M)
PYTHON_EXAMPLE, = re.findall(r'```python\n(.+?)```', README_TEXT, re.S)


def recipe(target):
    """Commands that `make` would run for a target."""
    process = subprocess.run(['make', '-n', target], cwd=ROOT, capture_output=True, text=True,
                             check=True)
    return process.stdout


def test_the_readme_is_short_and_has_two_pictures():
    assert len(README_TEXT.split()) <= MAX_WORDS
    pictures = re.findall(r'!\[.+?\]\((.+?)\)', README_TEXT)
    assert len(pictures) == 2 and all((ROOT / p).is_file() for p in pictures)


def test_links_refer_to_existing_files():
    links = re.findall(r'\]\(((?!http)[^)]+)\)', README_TEXT)
    assert len(links) > 8 and [link for link in links if not (ROOT / link).exists()] == []


def test_every_command_has_a_test():
    """The commands listed here are tested below; a new command in README needs another test."""
    assert [line for line in SHELL_LINES if not line.startswith('mag-tracking ')] == [
        '. .venv/bin/activate']
    assert re.findall(r'^    (make \w+)', README_TEXT, re.M) == ['make demo', 'make test']
    assert set(re.findall(r'`(make \w+)`', README_TEXT)) == {'make docs'}
    assert set(re.findall(r'`(mag-tracking [^`]+)`', README_TEXT)) == {
        'mag-tracking run --network network.yaml --drivers drivers.yaml'}


def test_make_demo_runs_the_demonstration():
    """The script itself is run by `test/cli/test_cli.py`."""
    assert 'examples/demo.py --out out/demo' in recipe('demo')


def test_make_test_runs_pytest_and_docs_builds_the_site():
    assert 'pytest' in recipe('test') and 'sphinx' in recipe('docs')


@pytest.mark.parametrize('line', [line for line in SHELL_LINES if line.startswith('mag-tracking ')])
def test_the_shell_commands_succeed(line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    words = [str(tmp_path) if word.startswith('out/') else word for word in line.split()[1:]]
    assert main(words) == 0 and capsys.readouterr().out
    assert '--out' not in words or (tmp_path / 'report.html').is_file()


def test_the_python_example_runs(tmp_path):
    """The code is run in the project folder, with a temporary path for the picture."""
    assert len(PYTHON_EXAMPLE.split('\n\n')[1].strip().splitlines()) + 1 <= 5
    code = PYTHON_EXAMPLE.replace("'pass.png'", repr(str(tmp_path / 'pass.png')))
    process = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True,
                             text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert (tmp_path / 'pass.png').stat().st_size > 10_000
