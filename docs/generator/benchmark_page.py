"""Benchmarks page, generated from `benchmarks/latest.json`."""

import ast
import json
from pathlib import Path

from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[2]
LATEST = ROOT / 'benchmarks' / 'latest.json'


class Numbers(dict):
    """Figures of one benchmark by name; an unknown name raises KeyError."""

    def __missing__(self, name):
        raise KeyError(f'benchmarks/latest.json has no figure {name!r}; it has {sorted(self)}')


def text_of(figure):
    """Format the value of a figure with its unit."""
    value, unit = figure['value'], figure['unit']
    return f'{value:.3g} {unit}'.strip() if abs(value) < 1000.0 else f'{value:.0f} {unit}'.strip()


def benchmark_figures():
    """Return {benchmark: {figure: formatted value}}, for use in other pages."""
    latest = json.loads(LATEST.read_text(encoding='utf-8'))
    return Numbers({name: Numbers({f: text_of(value) for f, value in run['figures'].items()})
                    for name, run in latest.items()})


def description_of(name):
    """Return the module of a benchmark, and the docstring of the module without its command."""
    module = {'bank': 'bench'}.get(name, name).split(',')[0]
    source = ROOT / 'test' / 'bench' / f'{module}.py'
    text = ast.get_docstring(ast.parse(source.read_text(encoding='utf-8')))
    paragraphs = [p for p in text.split('\n\n') if not p.startswith('    ')]
    return module, '\n\n'.join(paragraphs)


def draw_situations(path):
    """Draw a bar chart of the fraction of wrong poses in each situation, with the aims."""
    figures = json.loads(LATEST.read_text(encoding='utf-8'))['situations']['figures']
    rows = [(name.removesuffix(': wrong'), f) for name, f in figures.items()
            if name.endswith(': wrong') and not name.startswith('all ')
            and ' of 0;' not in f['note']]
    rows.sort(key=lambda row: row[1]['value'])
    figure = Figure(figsize=(8.0, 0.22 * len(rows) + 1.0), layout='constrained')
    axes = figure.add_subplot(
        xlabel='unflagged poses that are wrong [%]', xlim=(0.0, 101.0), xscale='symlog',
        xticks=(0, 1, 2, 5, 10, 20, 50, 100), xticklabels=(0, 1, 2, 5, 10, 20, 50, 100))
    colours = ['#0072b2' if is_met(f) else '#d55e00' for _, f in rows]
    axes.barh(range(len(rows)), [f['value'] for _, f in rows], color=colours)
    axes.plot([f['aim'] for _, f in rows], range(len(rows)), 'k|', ms=8, label='aim')
    axes.set_yticks(range(len(rows)), [name for name, _ in rows], fontsize=8)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.grid(axis='x', alpha=0.3)
    axes.legend(loc='lower right')
    figure.savefig(path, dpi=110)


def cell(text):
    """Escape a string as a cell of a Markdown table."""
    return ' '.join(text.split()).replace('|', '\\|')


def benchmark_page():
    """Markdown of the page, with one section per benchmark."""
    latest = json.loads(LATEST.read_text(encoding='utf-8'))
    n = sum(len(run['figures']) for run in latest.values())
    aims = [f for run in latest.values() for f in run['figures'].values() if f['aim'] is not None]
    lines = ['# Benchmarks', '',
             f'`make bench` measures these figures and writes them to `benchmarks/latest.json`, '
             f'from which this page is generated. It has {n} figures at present, each with the '
             f'commit of its run. {sum(map(is_met, aims))} of {len(aims)} figures with an aim meet '
             f'it. An aim follows from theory or from a requirement, not from an earlier result. '
             '`benchmarks/history.jsonl` contains the earlier runs of `make bench`.', '',
             'Simulators: *clouds* are clouds of magnetised points, *boxes* are magnetised sheets '
             'with '
             'imperfect sensors. *Wrong* poses carry no flag, and are more than 2 m and more than '
             'three '
             'standard deviations from every vehicle.', '']
    lines += ['![Wrong poses in each situation](images/situations.png)', '',
              '*Situations that no model assumes (`bench.situations`): fraction of the unflagged '
              'poses '
              'that are wrong. Blue: the aim is met. Situations without an unflagged pose are not '
              'shown.*', '']
    for name, run in sorted(latest.items()):
        module, text = description_of(name)
        text = text[:1].upper() + text[1:]
        lines += [f'## {name}', '', text, '',
                  f'`{command_of(module, run)}`, commit {run["commit"]}, '
                  f'{run["date"][:10]}, {run["machine"]}, Python {run["python"]}.', '',
                  '| figure | measured | aim | met | remark |', '|---|---|---|---|---|']
        for figure, value in run['figures'].items():
            lines.append('| {} | {} | {} | {} | {} |'.format(
                cell(figure), cell(text_of(value)), cell(aim_of(value)),
                '' if value['aim'] is None else 'yes' if is_met(value) else '**no**',
                cell(value.get('note', ''))))
        lines.append('')
    return '\n'.join(lines)


def command_of(module, run):
    """Command that repeats a run."""
    return ' '.join(['PYTHONPATH=test .venv/bin/python -m', f'bench.{module}',
                     *run.get('arguments', [])])


def is_met(figure):
    """Whether a figure meets its aim."""
    value, aim = figure['value'], figure['aim']
    return value >= aim if figure['more_is_better'] else value <= aim


def aim_of(figure):
    """Format the aim of a figure; empty without an aim."""
    if figure['aim'] is None:
        return ''
    return f'{"≥" if figure["more_is_better"] else "≤"} {figure["aim"]:g} {figure["unit"]}'.strip()
