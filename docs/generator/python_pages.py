"""Reference pages of the Python API: one page per folder of the package."""

import ast
from pathlib import Path

import mag_tracking

PACKAGE = Path(mag_tracking.__file__).parent
ROOMS = {
    'physics': 'Field models and motion models, in arrays.',
    'inference': 'Filters, evidence, bounds and detection theory. Knows nothing of physics.',
    'calibration': 'Backgrounds, noise, orientations, clocks and ellipsoid fits of sensors.',
    'network': 'The sensor network and its file.',
    'analysis': 'Fits of whole passes, bounds of a network, calibration of a board.',
    'simulation': 'Worlds with ground truth.',
    'stages': 'The steps of the pipeline: calibrate, align, detect, track and others.',
    'drivers': 'Transports, framings, chips and the clock of a device.',
    'recording': 'Reading and writing of recordings, tables and result folders.',
    'report': 'Figures, tables and the HTML report.',
    'apps': 'The use cases behind the commands, callable from Python.'}
BASE = ('records', 'event_records', 'settings', 'pipeline', 'geometry', 'arrays', 'units', 'errors',
        'files', 'yaml_file', 'interrupts')
PRIVATE = ('core', '__main__')


def python_pages():
    """{file name: Markdown}: overview, public interface, base modules, one page per folder."""
    pages = {'python/index.md': overview(), 'python/interface.md': interface(),
             'python/base.md': page('Base modules', 'Records, settings, geometry and errors, for '
                                                    'all '
                                    'other modules.', [f'mag_tracking.{m}' for m in BASE])}
    for room in ROOMS:
        for folder, modules in folders_of(room).items():
            pages[f'python/{folder.replace("/", "_")}.md'] = page(
                folder.replace('/', '.'), description_of(folder), modules)
    return pages


def folders_of(room):
    """{folder: [module]} of a folder and those below it that have modules with content."""
    found = {}
    for path in sorted((PACKAGE / room).rglob('*.py')):
        if path.stem in PRIVATE or (path.stem == '__init__' and not is_documented(path)):
            continue
        parts = path.relative_to(PACKAGE).with_suffix('').parts
        parts = parts[:-1] if parts[-1] == '__init__' else parts
        folder = str(path.parent.relative_to(PACKAGE))
        found.setdefault(folder, []).append('.'.join(('mag_tracking', *parts)))
    return found


def description_of(folder):
    """Content of a folder, in one sentence."""
    if folder in ROOMS:
        return ROOMS[folder]
    tree = ast.parse((PACKAGE / folder / '__init__.py').read_text(encoding='utf-8'))
    return ast.get_docstring(tree).splitlines()[0]


def is_documented(path):
    """Whether a module defines something."""
    return any(isinstance(node, (ast.FunctionDef, ast.ClassDef))
               for node in ast.parse(path.read_text(encoding='utf-8')).body)


def page(title, text, modules):
    """One page of modules."""
    lines = [f'# {title}', '', text, '']
    for module in modules:
        lines += [f'## {module.removeprefix("mag_tracking.")}', '', '```{eval-rst}',
                  f'.. automodule:: {module}', '   :members:', '```', '']
    return '\n'.join(lines)


def interface():
    """The names that `import mag_tracking` exports."""
    lines = ['# Public interface', '', '`import mag_tracking as mt` needs no ROS and imports '
                                       'nothing until '
             'a name is used. Units are SI, timestamps are integer nanoseconds, positions are in '
             'the frame '
             'of the network, fields in the frame of the sensor. All errors that the package '
             'raises on '
             'purpose are subclasses of `MagTrackingError`. {doc}`/gallery/index` shows the '
             'interface at '
             'work.', '']
    for name in sorted(mag_tracking.__all__, key=lambda n: (n[0].isupper(), n)):
        value = getattr(mag_tracking, name)
        kind = 'autoclass' if isinstance(value, type) else 'autofunction'
        members = ['   :members:'] if kind == 'autoclass' and not name.endswith('Error') else []
        lines += [f'## {name}', '', '```{eval-rst}', f'.. {kind}:: mag_tracking.{name}', *members,
                  *(['   :no-index:']), '```', '']
    return '\n'.join(lines)


def overview():
    """Table of contents of the Python API."""
    rows = [('interface', 'What `import mag_tracking` exports: start here.'),
            ('base', 'Records, settings, geometry and errors.')]
    names = ['interface', 'base']
    for room in ROOMS:
        for folder in folders_of(room):
            names.append(folder.replace('/', '_'))
            rows.append((names[-1], description_of(folder)))
    return '\n'.join([
        '# Python API', '',
        'The [public interface](interface.md) is stable. The other pages document the modules '
        'behind it, for extensions and for research; they may change with any release.', '',
        '| page | content |', '|---|---|',
        *(f'| [{name.replace("_", ".", 1)}]({name}.md) | {text} |'
          for name, text in rows),
        '', '```{toctree}', ':hidden:', ':maxdepth: 1', '', *names, '```', ''])
