"""Figures of gallery examples: those of the package are not made by pyplot."""

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

SAVED = 'is_in_gallery'
"""Attribute of a figure that has been saved."""


def save_figures(block, block_vars, gallery_conf):
    """Save the matplotlib Figures that a block of an example has bound to a name."""
    paths = []
    for value in list(block_vars['example_globals'].values()):
        if isinstance(value, Figure) and not hasattr(value, SAVED):
            setattr(value, SAVED, True)
            paths.append(next(block_vars['image_path_iterator']))
            value.savefig(paths[-1], dpi=100)
    return figure_rst(paths, gallery_conf['src_dir'])
