"""Configuration of the documentation site (`make docs`)."""

import os
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path[:0] = [str(DOCS), str(ROOT / 'examples')]
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
os.environ.setdefault('TQDM_DISABLE', '1')

from generator import benchmark_figures, write_pages  # noqa: E402

import mag_tracking  # noqa: E402

project = 'mag_tracking'
author = 'The mag_tracking authors'
project_copyright = f'2026, {author}'
version = release = mag_tracking.__version__

extensions = [
    'myst_parser',
    'numpydoc',
    'sphinx.ext.autodoc',
    'sphinx.ext.doctest',
    'sphinx_copybutton',
    'sphinx_design',
    'sphinx_gallery.gen_gallery',
]
exclude_patterns = ['generator', 'gallery/*.md5', '**/sg_execution_times.rst',
                    'sg_execution_times.rst']
source_suffix = {'.rst': 'restructuredtext', '.md': 'markdown'}
nitpicky = False

myst_enable_extensions = ['colon_fence', 'deflist', 'substitution']
myst_heading_anchors = 3
# Measured figures in the text are those of `benchmarks/latest.json`: {{ bench['replay']['...'] }}.
myst_substitutions = {'bench': benchmark_figures()}

autodoc_member_order = 'bysource'
toc_object_entries = False
# Single backquotes are code, as in the docstrings of numpy.
default_role = 'code'
# Types are stated in the docstrings, with shapes and units.
autodoc_typehints = 'none'
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False

sphinx_gallery_conf = {
    'examples_dirs': str(ROOT / 'examples' / 'gallery'),
    'gallery_dirs': 'gallery',
    'filename_pattern': r'plot_',
    'ignore_pattern': r'__init__\.py',
    'abort_on_example_error': True,
    'download_all_examples': False,
    'within_subsection_order': 'ExampleTitleSortKey',
    'remove_config_comments': True,
    'plot_gallery': True,
    'image_scrapers': ('generator.figure_scraper.save_figures',),
    'reference_url': {},
    'min_reported_time': 1e9,
    'show_memory': False,
}

html_theme = 'furo'
html_title = f'mag_tracking {release}'
html_static_path = ['_static']
html_css_files = ['site.css']
html_show_sourcelink = False
html_copy_source = False
copybutton_prompt_text = r'\$ |>>> |\.\.\. '
copybutton_prompt_is_regexp = True
linkcheck_anchors = False


def clear_alias(_app, _what, _name, _value, _options, lines):
    """Remove the text that Python gives to fields of named tuples, "Alias for field number 0"."""
    if any(line.startswith('Alias for field number') for line in lines):
        lines.clear()


def setup(app):
    """Write the generated pages before Sphinx reads the sources."""
    # Before autosummary, which would look for the modules of an earlier build.
    app.connect('builder-inited', lambda _: write_pages(), priority=100)
    app.connect('autodoc-process-docstring', clear_alias)
