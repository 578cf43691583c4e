"""Architecture: layers of imports, lengths of files and functions, and structure of the tests."""

import ast
import re
from collections import Counter
from pathlib import Path

import grimp
import pytest
from importlinter import api

from support.bundled import ROOT

PACKAGE = ROOT / 'mag_tracking'
FILES = sorted(PACKAGE.rglob('*.py'))
MAX_FILE_LINES, MAX_FUNCTION_LINES = 350, 40
"""Maximum lines of a file and of a function, without docstrings."""
BUDGETS = {
    'cli': 2750, 'nodes': 3590, 'apps': 5150, 'web': 540, 'report': 890, 'results': 1380,
    'drivers': 4700, 'recording': 4270, 'stages': 9880, 'messages': 1490, 'simulation': 120,
    'analysis': 2730, 'calibration': 5270, 'network': 730, 'physics': 1850, 'inference': 2780,
    'modules': 2500}
"""Maximum lines of each package, and of the modules outside packages, in Python and C++ with
docstrings. A change may lower a budget; one that raises it says why."""


def checked_layers():
    """Packages and modules of each layer, highest first, from the contracts of `lint-imports`."""
    contracts = api.read_configuration(str(ROOT / 'pyproject.toml'))['contracts_options']
    rows = next(c['layers'] for c in contracts if c['type'] == 'layers')
    return [set(re.split(r'\s*[|:]\s*', row)) for row in rows]


def documented_layers():
    """Packages and modules of each layer, highest first, from docs/contributing/architecture.md."""
    text = (ROOT / 'docs' / 'contributing' / 'architecture.md').read_text()
    rows = re.findall(r'^\| (\d+) \| ([^|]+)\|', text, re.M)
    assert [int(n) for n, _ in rows] == list(range(len(rows), 0, -1))
    return [{name.removesuffix('.py').rstrip('/') for name in re.findall(r'`([^`]+)`', packages)}
            for _, packages in rows]


def test_import_contracts_match_the_documented_layers():
    assert checked_layers() == documented_layers()


def test_every_module_has_a_layer():
    packages = {p.stem if p.is_file() else p.name for p in PACKAGE.iterdir()
                if p.name != '__pycache__' and (p.suffix == '.py' or p.is_dir())}
    assert packages - {'__init__'} == set.union(*checked_layers())


def test_compiled_sources_include_only_headers_of_lower_layers():
    layer = {package: -k for k, packages in enumerate(checked_layers()) for package in packages}
    sources = [*PACKAGE.rglob('*.hpp'), *PACKAGE.rglob('*.cpp')]
    assert sources
    for source in sources:
        text = source.read_text()
        assert text.count('\n') <= MAX_FILE_LINES, source
        for name in re.findall(r'^#include "(.+)"$', text, re.M):
            included = (source.parent / name).resolve()
            own, other = (p.relative_to(PACKAGE).parts[0].removesuffix('.hpp')
                          for p in (source, included))
            assert included.is_file(), (source, name)
            # A header outside the packages belongs to the lowest layer.
            assert own == other or layer.get(other, -len(checked_layers())) < layer.get(
                own, -len(checked_layers()) + 1), (source, name)


def test_the_import_graph_has_no_cycle():
    graph = grimp.build_graph('mag_tracking')
    imports = {m: graph.find_modules_directly_imported_by(m) for m in graph.modules}
    visited, on_path = set(), []

    def visit(module):
        assert module not in on_path, f'import cycle: {on_path[on_path.index(module):]}'
        if module not in visited:
            on_path.append(module)
            for imported in imports[module]:
                visit(imported)
            on_path.pop()
            visited.add(module)

    for module in sorted(imports):
        visit(module)
    assert len(visited) > 100


def n_lines(path):
    """Number of lines of a module without its docstrings."""
    text = path.read_text()
    docstrings = (ast.get_docstring(node, clean=False) for node in ast.walk(ast.parse(text))
                  if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef,
                                       ast.AsyncFunctionDef)))
    return len(text.splitlines()) - sum(d.count('\n') + 1 for d in docstrings if d is not None)


def test_no_file_exceeds_the_maximum_length():
    assert {str(p.relative_to(ROOT)): n_lines(p) for p in FILES
            if n_lines(p) > MAX_FILE_LINES} == {}


def test_every_package_keeps_its_budget():
    lines = Counter()
    for path in [*FILES, *PACKAGE.rglob('*.[ch]pp')]:
        room, *inside = path.relative_to(PACKAGE).parts
        lines[room if inside else 'modules'] += path.read_text().count('\n')
    assert lines.keys() == BUDGETS.keys()
    assert {room: n for room, n in lines.items() if n > BUDGETS[room]} == {}


def definitions(path):
    """Yield (node, whether it is public) for every class, function and method of a module."""
    def walk(body, public):
        for node in body:
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)):
                is_public = public and not node.name.startswith('_')
                yield node, is_public
                yield from walk(node.body, is_public and isinstance(node, ast.ClassDef))

    return walk(ast.parse(path.read_text()).body, True)


def n_function_lines(node):
    """Number of lines of a function without its docstring."""
    text = ast.get_docstring(node, clean=False)
    return node.end_lineno - node.lineno + 1 - (text.count('\n') + 1 if text is not None else 0)


@pytest.mark.parametrize('path', FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_functions_are_short_and_public_names_have_docstrings(path):
    assert ast.get_docstring(ast.parse(path.read_text()))
    long = {node.name: n_function_lines(node) for node, _ in definitions(path)
            if not isinstance(node, ast.ClassDef) and n_function_lines(node) > MAX_FUNCTION_LINES}
    assert long == {}
    undocumented = [node.name for node, public in definitions(path)
                    if public and ast.get_docstring(node) is None]
    assert undocumented == []


def private_uses(tree):
    """Yield private names that a test imports from the package or reads from objects other than
    `self`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('mag_tracking'):
            yield from (a.name for a in node.names if a.name.startswith('_'))
        elif isinstance(node, ast.Attribute) and re.match(r'_[a-z]', node.attr) \
                and node.attr not in ('_replace', '_asdict', '_fields', '_repr_html_'):
            if not (isinstance(node.value, ast.Name) and node.value.id in ('self', 'cls')):
                yield node.attr


@pytest.mark.parametrize('path', sorted((ROOT / 'test').rglob('*.py')),
                         ids=lambda p: str(p.relative_to(ROOT / 'test')))
def test_tests_use_no_private_names(path):
    assert sorted(private_uses(ast.parse(path.read_text()))) == []


def test_no_file_is_read_as_code():
    """Reading a file of Python objects executes the code of its author."""
    pattern = r'pickle\b|joblib|marshal|shelve|\bdill\b'
    assert {str(p.relative_to(ROOT)): found for p in FILES
            if (found := re.findall(pattern, p.read_text()))} == {}


def test_the_tests_mirror_the_package():
    """Every folder of tests, with the listed exceptions, is a subpackage."""
    exceptions = {'data', 'support', 'system', 'bench', '__pycache__'}
    folders = [p.relative_to(ROOT / 'test') for p in (ROOT / 'test').rglob('*')
               if p.is_dir() and not set(p.relative_to(ROOT / 'test').parts) & exceptions]
    assert [str(f) for f in folders if not (PACKAGE / f).is_dir()] == []
    assert Path('stages/track') in folders


def paths_in_documents():
    """Yield (document, path) for every file or folder that a document names in backticks."""
    pages = [p for p in sorted((ROOT / 'docs').rglob('*.md'))
             if not {'reference', 'gallery'} & set(p.parts)]
    for document in [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *pages]:
        for name in re.findall(r'`([\w./-]+(?:/|\.py|\.md|/[\w.-]+\.(?:yaml|xml|toml)))`',
                               document.read_text()):
            yield document.name, name


def test_files_named_in_documents_exist():
    """Paths are relative to the project, the package, a subpackage, or the tests."""
    folders = [ROOT, PACKAGE, *(p for p in PACKAGE.rglob('*') if p.is_dir()), ROOT / 'test']
    assert [(d, name) for d, name in paths_in_documents()
            if not any((folder / name).exists() for folder in folders)] == []
