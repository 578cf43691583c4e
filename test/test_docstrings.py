"""Public names have complete numpydoc docstrings: parameters, shapes, return values, errors."""

import ast
import re

import pytest
from numpydoc import validate
from numpydoc.hooks.validate_docstrings import AstValidator

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


def error_issues(node, doc):
    """Issues for exceptions that a function raises itself but does not document."""
    raised = {n.exc.func.id for n in ast.walk(node)
              if isinstance(n, ast.Raise) and isinstance(n.exc, ast.Call)
              and isinstance(n.exc.func, ast.Name) and n.exc.func.id.endswith('Error')}
    documented = {p.type or p.name for p in doc['Raises']}
    return [f'undocumented: {e}' for e in sorted(raised - documented - PROGRAMMING_ERRORS)]


def issues(path):
    """Yield the issues of a module as (line, name, issue)."""
    for node, ancestors in public_definitions(ast.parse(path.read_text(encoding='utf-8'))):
        if 'overload' in decorators(node):
            continue
        found = numpydoc_issues(path, node, ancestors)
        if isinstance(node, ast.ClassDef):
            found += ['parameters belong to the docstring of the class' for n in node.body
                      if isinstance(n, ast.FunctionDef) and n.name == '__init__'
                      and ast.get_docstring(n)]
        else:
            doc = AstValidator(ast_node=node, filename=str(path), obj_name=node.name,
                               ancestry=ancestors).doc
            found += shape_issues(node, doc) + error_issues(node, doc)
        yield from ((node.lineno, node.name, text) for text in found)


@pytest.mark.parametrize('path', sorted(PACKAGE.rglob('*.py')),
                         ids=lambda p: str(p.relative_to(PACKAGE)))
def test_public_names_have_complete_docstrings(path):
    assert list(issues(path)) == []


@pytest.mark.parametrize('source, issue', [
    ('def f(x: int) -> None:\n    """Do it."""\n    print(x)', "PR01"),
    ('def f() -> int:\n    """Do it."""\n    return 1', 'RT01'),
    ('def f(x: FloatArray) -> None:\n    """Do it.\n\n    Parameters\n    ----------\n'
     '    x : metres\n        Position.\n    """', 'no shape: x'),
    ('def f() -> None:\n    """Do it."""\n    raise ValueError("no")', 'undocumented: ValueError'),
    ('class C:\n    """Example."""\n    def __init__(self) -> None:\n        """Create it."""',
     'belong to the docstring of the class'),
    ('def f() -> None:\n    pass', 'GL08')])
def test_incomplete_docstrings_are_reported(tmp_path, source, issue):
    path = tmp_path / 'module.py'
    path.write_text(source)
    assert [text for *_, text in issues(path) if issue in text]
