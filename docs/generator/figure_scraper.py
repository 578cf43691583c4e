"""Scraper for the figures of gallery examples, which are created without pyplot."""

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

SAVED = 'is_in_gallery'
"""Name of the attribute that marks a saved figure."""


def save_figures(block, block_vars, gallery_conf):
    """Save the matplotlib Figures that a block has bound to names; return their reST."""
    paths = []
    for value in list(block_vars['example_globals'].values()):
        if isinstance(value, Figure) and not hasattr(value, SAVED):
            setattr(value, SAVED, True)
            paths.append(next(block_vars['image_path_iterator']))
            value.savefig(paths[-1], dpi=100)
    return figure_rst(paths, gallery_conf['src_dir'])
