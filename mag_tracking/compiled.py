"""Functions that numba compiles once, for one signature, when they are first called."""

import functools
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any, ParamSpec, TypeVar, cast

_Arguments = ParamSpec('_Arguments')
_Result = TypeVar('_Result')


def compiled_when_used(signature: object, **options: Any) -> Callable[
        [Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]:
    """Decorator of a function that is called from Python and runs compiled.

    Nothing is compiled, or loaded from the cache on disk, before the first call: a process waits
    for what it uses, and not for all that its modules have. Arguments that do not fit the one
    signature are refused with a TypeError, and never compiled for.

    Parameters
    ----------
    signature : str or numba signature
    options
        Those of `numba.njit`, beside `cache`.
    """
    def decorate(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
        compiled: list[Callable[_Arguments, _Result]] = []

        def prepare() -> None:
            if not compiled:
                compiled.append(_compile(function, signature, options))

        @functools.wraps(function)
        def call(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
            prepare()
            return compiled[0](*args, **kwargs)
        _prepare.setdefault(function.__module__, []).append(prepare)
        return call
    return decorate


def _compile(function: Callable[_Arguments, _Result], signature: object,
             options: dict[str, Any]) -> Callable[_Arguments, _Result]:
    """The function compiled, from the cache on disk where it is there."""
    from numba import njit

    try:
        kept = njit(cache=True, **options)(function)
    except RuntimeError as error:
        # Numba found no folder that it may write to.
        warnings.warn(f'compiled functions cannot be kept ({error}): each process will wait for '
                      'them. NUMBA_CACHE_DIR names a folder for them', RuntimeWarning, stacklevel=3)
        kept = njit(**options)(function)
    kept.compile(signature)
    kept.disable_compile()
    return cast(Callable[_Arguments, _Result], kept)


_prepare: dict[str, list[Callable[[], None]]] = {}
"""{module: functions that compile those of the module}, of the modules that were imported."""


def prepare_module(name: str) -> int:
    """Compile the functions of a module now, or load them; how many there are."""
    import_module(name)
    for prepare in _prepare.get(name, ()):
        prepare()
    return len(_prepare.get(name, ()))
