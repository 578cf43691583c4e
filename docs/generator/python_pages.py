"""Reference pages of the Python API: one page per folder of the package."""

import ast
from pathlib import Path

import mag_tracking

PACKAGE = Path(mag_tracking.__file__).parent
ELSEWHERE = ('cli', 'nodes')
"""Folders without a page: the reference of commands, parameters and topics documents them."""
PRIVATE = ('core', '__main__')
BASE = 'Records, settings, geometry and errors, for all other modules.'
INTERFACE = """# Public interface

`import mag_tracking as mt` needs no ROS and imports nothing until a name is used. Units are SI,
timestamps are integer nanoseconds, positions are in the frame of the network, fields in the frame
of the sensor. All errors that the package raises on purpose are subclasses of `MagTrackingError`.
{doc}`/gallery/index` shows the interface at work.
"""
OVERVIEW = """# Python API

The [public interface](interface.md) is stable. The other pages document the modules behind it, for
extensions and for research; they may change with any release.

| page | content |
|---|---|"""


def python_pages():
    """{file name: Markdown}: overview, public interface, base modules, one page per folder."""
    pages = {'python/index.md': overview(), 'python/interface.md': interface(),
             'python/base.md': page('Base modules', BASE, base_modules())}
    for package in packages():
        for folder, modules in folders_of(package).items():
            pages[f'python/{folder.replace("/", "_")}.md'] = page(
                folder.replace('/', '.'), description_of(folder), modules)
    return pages


def packages():
    """Top-level folders of the package that have pages."""
    return sorted(p.parent.name for p in PACKAGE.glob('*/__init__.py')
                  if p.parent.name not in ELSEWHERE)


def base_modules():
    """Names of the modules at the top level of the package."""
    return [f'mag_tracking.{p.stem}' for p in sorted(PACKAGE.glob('*.py'))
            if p.stem not in (*PRIVATE, '__init__')]


def folders_of(package):
    """{folder: [module]} of a top-level folder and its subfolders, without empty modules."""
    found = {}
    for path in sorted((PACKAGE / package).rglob('*.py')):
        if path.stem in PRIVATE or (path.stem == '__init__' and not is_documented(path)):
            continue
        parts = path.relative_to(PACKAGE).with_suffix('').parts
        parts = parts[:-1] if parts[-1] == '__init__' else parts
        folder = str(path.parent.relative_to(PACKAGE))
        found.setdefault(folder, []).append('.'.join(('mag_tracking', *parts)))
    return found


def description_of(folder):
    """First line of the docstring of a package folder."""
    tree = ast.parse((PACKAGE / folder / '__init__.py').read_text(encoding='utf-8'))
    return ast.get_docstring(tree).splitlines()[0]


def is_documented(path):
    """Whether a module defines a function or a class at its top level."""
    return any(isinstance(node, (ast.FunctionDef, ast.ClassDef))
               for node in ast.parse(path.read_text(encoding='utf-8')).body)


def page(title, text, modules):
    """Markdown of a page that documents modules."""
    lines = [f'# {title}', '', text, '']
    for module in modules:
        lines += [f'## {module.removeprefix("mag_tracking.")}', '', '```{eval-rst}',
                  f'.. automodule:: {module}', '   :members:', '```', '']
    return '\n'.join(lines)


def interface():
    """Markdown of the page of the names that `import mag_tracking` exports."""
    lines = [INTERFACE]
    for name in sorted(mag_tracking.__all__, key=lambda n: (n[0].isupper(), n)):
        value = getattr(mag_tracking, name)
        kind = 'autoclass' if isinstance(value, type) else 'autofunction'
        members = ['   :members:'] if kind == 'autoclass' and not name.endswith('Error') else []
        lines += [f'## {name}', '', '```{eval-rst}', f'.. {kind}:: mag_tracking.{name}', *members,
                  *(['   :no-index:']), '```', '']
    return '\n'.join(lines)


def overview():
    """Markdown of the table of contents of the Python API."""
    rows = [('interface', 'What `import mag_tracking` exports: start here.'),
            ('base', BASE)]
    names = ['interface', 'base']
    for package in packages():
        for folder in folders_of(package):
            names.append(folder.replace('/', '_'))
            rows.append((names[-1], description_of(folder)))
    return '\n'.join([
        OVERVIEW,
        *(f'| [{name.replace("_", ".", 1)}]({name}.md) | {text} |' for name, text in rows),
        '', '```{toctree}', ':hidden:', ':maxdepth: 1', '', *names, '```', ''])
