"""Docstrings are complete for those who call the interface, one sentence for all other names.

The interface: the names of `mag_tracking.__all__` and all protocols, each with its methods. Its
docstrings are complete numpydoc: parameters, shapes, return values, raised errors.
"""

import ast
import re

import pytest
from numpydoc import validate
from numpydoc.hooks.validate_docstrings import AstValidator

import mag_tracking
from support.bundled import ROOT

PACKAGE = ROOT / 'mag_tracking'
CHECKS = {
    'GL03', 'GL05', 'GL06', 'GL07', 'GL08', 'GL09', 'GL10',
    'SS01', 'SS02', 'SS03', 'SS04', 'SS06',
    'PR01', 'PR02', 'PR03', 'PR04', 'PR05', 'PR06', 'PR08', 'PR09', 'PR10',
    'RT01', 'RT02', 'RT04', 'RT05', 'YD01'}
"""All checks of numpydoc except those that contradict the project's style: the summary begins on
the first line (GL01, GL02); extended summary, examples and see-also are optional (ES01, EX01,
SA01), and so is a description if name and type are sufficient (PR07, RT03); a summary may be a
noun phrase, which SS05 treats as a verb if its first word is a plural."""
ARRAY_TYPE = re.compile(r'\b(FloatArray|IntArray|BoolArray|ArrayLike|NDArray|StructArray)\b')
PROGRAMMING_ERRORS = {'AssertionError', 'NotImplementedError', 'AttributeError'}
SENTENCE_BREAK = re.compile(r'(?<!e\.g)(?<!i\.e)[.!?]\s+[A-Z]')
API = {(getattr(mag_tracking, name).__module__, name) for name in mag_tracking.__all__}
"""Module and name of every public name of the package."""


def public_definitions(tree):
    """Yield (node, its ancestors) for every public function, method and class."""
    def walk(node, ancestors):
        for child in node.body:
            if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) \
                    and not child.name.startswith('_'):
                yield child, [*ancestors, node]
                if isinstance(child, ast.ClassDef):
                    yield from walk(child, [*ancestors, node])

    return walk(tree, [])


def decorators(node):
    return [ast.unparse(d) for d in node.decorator_list]


def is_property(node):
    return any(d in ('property', 'cached_property', 'functools.cached_property')
               or d.endswith('.setter') for d in decorators(node))


def numpydoc_issues(path, node, ancestors):
    """Issues that numpydoc finds in the docstring of a definition."""
    report = validate.validate(node.name, AstValidator, ast_node=node, filename=str(path),
                               ancestry=ancestors)
    return [f'{code} {text}' for code, text in report['errors']
            if code in CHECKS and not (code == 'RT01' and is_property(node))]


def shape_issues(node, doc):
    """Issues for array arguments and return values whose shape is not documented."""
    types = {name: p.type for p in doc['Parameters'] for name in re.split(r',\s*', p.name)}
    arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    missing = [f'no shape: {a.arg}' for a in arguments
               if a.annotation is not None and ARRAY_TYPE.search(ast.unparse(a.annotation))
               and not has_shape(types.get(a.arg, '('))]
    returns_array = node.returns is not None and ARRAY_TYPE.search(ast.unparse(node.returns))
    if returns_array and doc['Returns'] and not is_property(node) \
            and not any(has_shape(r.type) or has_shape(r.name) for r in doc['Returns']):
        missing.append('no shape: return value')
    return missing


def has_shape(text):
    return '(' in text or 'array' in text


def return_issues(node, doc):
    """Issue for a return value that is not documented, also without a `return` (in a protocol).

    The annotation `object` marks a value that the caller ignores.
    """
    returns = node.returns is not None and ast.unparse(node.returns) not in ('None', 'object')
    return ['no Returns'] if returns and not is_property(node) \
        and not doc['Returns'] and not doc['Yields'] else []


def error_issues(node, doc):
    """Issues for exceptions that a function raises itself but does not document."""
    raised = {n.exc.func.id for n in ast.walk(node)
              if isinstance(n, ast.Raise) and isinstance(n.exc, ast.Call)
              and isinstance(n.exc.func, ast.Name) and n.exc.func.id.endswith('Error')}
    documented = {p.type or p.name for p in doc['Raises']}
    return [f'undocumented: {e}' for e in sorted(raised - documented - PROGRAMMING_ERRORS)]


def is_protocol(node):
    return isinstance(node, ast.ClassDef) \
        and any(re.match(r'(\w+\.)?Protocol\b', ast.unparse(b)) for b in node.bases)


def is_interface(node, ancestors, api):
    """Whether a definition is a name of the API, a protocol, or a method of either."""
    top = [*ancestors, node][1]
    return top.name in api or any(is_protocol(n) for n in [*ancestors, node])


def sentence_issues(node):
    """Issues for a docstring whose first paragraph is not one sentence."""
    doc = ast.get_docstring(node)
    if not doc:
        return ['no docstring']
    summary = doc.split('\n\n')[0]
    return [text for text, found in (
        ('summary without full stop', not summary.endswith('.')),
        ('summary of several sentences', SENTENCE_BREAK.search(summary))) if found]


def complete_issues(path, node, ancestors, is_api):
    """Issues for the docstring of a name of the interface."""
    found = numpydoc_issues(path, node, ancestors)
    if isinstance(node, ast.ClassDef):
        return found
    doc = AstValidator(ast_node=node, filename=str(path), obj_name=node.name,
                       ancestry=ancestors).doc
    found += return_issues(node, doc) + shape_issues(node, doc)
    return found + error_issues(node, doc) if is_api else found


def issues(path, api):
    """Yield the issues of a module as (line, name, issue); `api` are its names of the API."""
    for node, ancestors in public_definitions(ast.parse(path.read_text(encoding='utf-8'))):
        if 'overload' in decorators(node):
            continue
        if is_interface(node, ancestors, api):
            found = complete_issues(path, node, ancestors, [*ancestors, node][1].name in api)
        else:
            found = sentence_issues(node)
        if isinstance(node, ast.ClassDef):
            found += ['parameters belong to the docstring of the class' for n in node.body
                      if isinstance(n, ast.FunctionDef) and n.name == '__init__'
                      and ast.get_docstring(n)]
        yield from ((node.lineno, node.name, text) for text in found)


def api_names(path):
    """Names of the API that a file of the package defines."""
    module = '.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__')
    return {name for defined_in, name in API if defined_in == module}


@pytest.mark.parametrize('path', sorted(PACKAGE.rglob('*.py')),
                         ids=lambda p: str(p.relative_to(PACKAGE)))
def test_docstrings_are_complete_for_the_interface_and_a_sentence_for_the_rest(path):
    assert list(issues(path, api_names(path))) == []


def test_all_names_of_the_api_are_found():
    """A name that no file defines would be tested as an internal one."""
    defined = {name for path in PACKAGE.rglob('*.py') for node, ancestors
               in public_definitions(ast.parse(path.read_text(encoding='utf-8')))
               if len(ancestors) == 1 and (name := node.name) in api_names(path)}
    assert defined == set(mag_tracking.__all__)


PROTOCOL = 'class P(Protocol):\n    """Example."""\n'


@pytest.mark.parametrize('source, issue', [
    ('def api(x: int) -> None:\n    """Do it."""\n    print(x)', 'PR01'),
    ('def api() -> int:\n    """Do it."""\n    return 1', 'RT01'),
    ('def api(x: FloatArray) -> None:\n    """Do it.\n\n    Parameters\n    ----------\n'
     '    x : metres\n        Position.\n    """', 'no shape: x'),
    ('def api() -> None:\n    """Do it."""\n    raise ValueError("no")',
     'undocumented: ValueError'),
    ('class api:\n    """Example."""\n    def m(self, x: int) -> None:\n        """Do it."""',
     'PR01'),
    (f'{PROTOCOL}    def m(self) -> int:\n        """Do it."""', 'no Returns'),
    (f'{PROTOCOL}    def m(self) -> int: ...', 'GL08'),
    ('class C:\n    """Example."""\n    def __init__(self) -> None:\n        """Create it."""',
     'belong to the docstring of the class'),
    ('def f() -> None:\n    pass', 'no docstring'),
    ('class C:\n    """Example."""\n    def m(self) -> None:\n        pass', 'no docstring'),
    ('def f() -> None:\n    """Do it"""', 'without full stop'),
    ('def f() -> None:\n    """Do it. It is done."""', 'several sentences')])
def test_incomplete_docstrings_are_reported(tmp_path, source, issue):
    path = tmp_path / 'module.py'
    path.write_text(source)
    assert [text for *_, text in issues(path, {'api'}) if issue in text]


@pytest.mark.parametrize('source', [
    'def f(x: int) -> int:\n    """Return it as it is,\n    e.g. 1."""\n    return x',
    'def f() -> None:\n    """Do it.\n\n    Twice.\n    """\n    raise ValueError("no")',
    f'{PROTOCOL}    def m(self) -> None:\n        """Do it."""\n        raise ValueError("no")'])
def test_sufficient_docstrings_are_not_reported(tmp_path, source):
    path = tmp_path / 'module.py'
    path.write_text(source)
    assert list(issues(path, {'api'})) == []
