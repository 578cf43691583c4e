"""Pages of the site that are generated from the code and from `benchmarks/latest.json`."""

from pathlib import Path

from generator.benchmark_page import benchmark_figures, benchmark_page, draw_situations
from generator.command_page import command_page
from generator.python_pages import python_pages
from generator.settings_pages import settings_pages
from generator.topic_page import topic_page

__all__ = ['benchmark_figures', 'write_pages']

DOCS = Path(__file__).resolve().parents[1]


def write_pages():
    """Write all generated pages; a page without changes keeps its modification time."""
    pages = {
        'benchmarks.md': benchmark_page(),
        'reference/command_line.md': command_page(),
        'reference/topics.md': topic_page(),
        **{f'reference/{name}': text for name, text in settings_pages().items()},
        **{f'reference/{name}': text for name, text in python_pages().items()}}
    # Pages of modules that no longer exist, from an earlier build.
    for path in (DOCS / 'reference' / 'python').glob('*.md'):
        if f'reference/python/{path.name}' not in pages:
            path.unlink()
    for name, text in pages.items():
        path = DOCS / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding='utf-8') != text:
            path.write_text(text, encoding='utf-8')
    draw_situations(DOCS / 'images' / 'situations.png')
