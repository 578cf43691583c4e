"""Results of benchmarks: the latest figures of each benchmark, and the history of all runs.

    PYTHONPATH=test python -m bench.figures

Each benchmark writes its figures to `benchmarks/latest.json`, with commit, date and machine; the
Benchmarks page of the documentation is generated from that file. This command, the last command of
`make bench`, appends the figures to `benchmarks/history.jsonl`, one line per run. It lists figures
that are more than 15 % worse than the best of the latest five runs on the same kind of machine.
"""

import datetime
import json
import math
import os
import platform
import subprocess
import sys

from support.bundled import ROOT

FOLDER = ROOT / 'benchmarks'
LATEST, HISTORY = FOLDER / 'latest.json', FOLDER / 'history.jsonl'
MAX_RATIO = 1.15
"""A figure is reported if it is worse than the best earlier figure by more than this factor."""
RUNS = 5
RED, PLAIN = '\033[31m', '\033[0m'


class Figures:
    """Figures of one benchmark, by name."""

    def __init__(self, benchmark):
        self._benchmark, self._figures, self.missed = benchmark, {}, 0

    def record(self, name, value, unit='', aim=None, more_is_better=False, note=''):
        """Record a figure; return whether it misses `aim`, the worst acceptable value."""
        # NaN misses every aim.
        is_missed = aim is not None and not (value >= aim if more_is_better else value <= aim)
        self.missed += is_missed
        self._figures[name] = {'value': float(value), 'unit': unit, 'aim': aim,
                               'more_is_better': more_is_better, 'note': note.strip(' ()')}
        return is_missed

    def add(self, name, value, unit, aim=None, more_is_better=False, note=''):
        """Record a figure and print it."""
        is_missed = self.record(name, value, unit, aim, more_is_better, note)
        text = '' if aim is None else f'; aim {"at least" if more_is_better else "at most"} {aim:g}'
        print(f'  {name}: {value:.4g} {unit}'.rstrip() + note + text
              + (' (missed)' if is_missed else ''), flush=True)

    def save(self):
        """Add the figures to `benchmarks/latest.json`; return 1 if an aim is missed, else 0."""
        FOLDER.mkdir(exist_ok=True)
        found = json.loads(LATEST.read_text()) if LATEST.exists() else {}
        found[self._benchmark] = run_facts() | {'arguments': sys.argv[1:],
                                                'figures': self._figures}
        LATEST.write_text(json.dumps(found, indent=1, sort_keys=True) + '\n')
        return int(self.missed > 0)


def run_facts():
    """Commit, date, machine and Python version of a run."""
    return {'date': datetime.datetime.now(datetime.UTC).isoformat(timespec='seconds'),
            'commit': commit(), 'machine': machine(), 'python': platform.python_version()}


def read_history():
    """Read the earlier runs, oldest first."""
    if not HISTORY.exists():
        return []
    return [json.loads(line) for line in HISTORY.read_text().splitlines()]


def machine():
    """Description of the machine; only runs with equal descriptions are compared."""
    try:
        with open('/proc/cpuinfo') as stream:
            models = {line.partition(':')[2].strip() for line in stream
                      if line.startswith('model name')}
    except OSError:
        models = set()
    return ', '.join([platform.machine(), f'{os.cpu_count()} cores', *sorted(models)])


def worse_figures(run, before):
    """List the figures that are worse or NaN, as (benchmark, name, figure, best earlier value).

    `before` contains the earlier runs on the same kind of machine.
    """
    out = []
    for benchmark, figures in run.items():
        for name, figure in figures.items():
            earlier = [value for r in before[-RUNS:] if name in r['figures'].get(benchmark, {})
                       and not math.isnan(value := r['figures'][benchmark][name]['value'])]
            if not earlier:
                continue
            more = figure['more_is_better']
            best = max(earlier) if more else min(earlier)
            value = figure['value']
            if not (value * MAX_RATIO >= best if more else value <= MAX_RATIO * best):
                out.append((benchmark, name, figure, best))
    return out


def commit():
    """Hash of the measured commit, with a + if the package has uncommitted changes."""
    def git(*arguments):
        return subprocess.run(['git', *arguments], cwd=ROOT, capture_output=True, text=True,
                              check=True).stdout.strip()
    try:
        return git('rev-parse', '--short', 'HEAD') + (
            '+' if git('status', '--porcelain', '--', 'mag_tracking') else '')
    except (OSError, subprocess.CalledProcessError):
        return 'unknown'


def main():
    """Append the run to the history, and print the figures that got worse, in red."""
    if not LATEST.exists():
        print('no benchmark has been run (benchmarks/latest.json is missing): run make bench')
        return 1
    figures = {name: run['figures'] for name, run in json.loads(LATEST.read_text()).items()}
    before = [run for run in read_history() if run['machine'] == machine()]
    found = worse_figures(figures, before)
    for benchmark, name, figure, best in found:
        print(f'{RED}worse: {benchmark}: {name}: {figure["value"]:.4g} {figure["unit"]}, the best '
              f'of the latest runs was {best:.4g}{PLAIN}')
    run = run_facts() | {'figures': figures}
    with HISTORY.open('a') as stream:
        stream.write(json.dumps(run, sort_keys=True) + '\n')
    compared = f'worse than before: {len(found)}' if before else \
        f'none were compared: no earlier run on such a machine ({machine()})'
    print(f'figures added to {HISTORY.relative_to(ROOT)}: {sum(map(len, figures.values()))}; '
          f'{compared}')
    return int(bool(found))


if __name__ == '__main__':
    sys.exit(main())
