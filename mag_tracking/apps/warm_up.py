"""Compile what numba compiles, before anybody waits for it."""

import os
import pkgutil
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from mag_tracking.compiled import prepare_module

ROOMS = ('physics', 'inference', 'calibration', 'stages')
"""The folders in which functions are compiled."""
_MARK = 'compiled_when_used('


def compiled_modules() -> list[str]:
    """Names of the modules that have compiled functions, the largest first."""
    found: list[tuple[int, str]] = []
    for room in ROOMS:
        folder = Path(__file__).parents[1] / room
        for module in pkgutil.walk_packages([str(folder)], f'mag_tracking.{room}.'):
            spec = module.module_finder.find_spec(module.name, None)
            path = Path(spec.origin or '') if spec is not None else Path()
            if path.suffix == '.py' and _MARK in (text := path.read_text(encoding='utf-8')):
                found.append((len(text), module.name))
    return [name for _, name in sorted(found, reverse=True)]


def warm_up(progress: Callable[[int], object]) -> int:
    """Compile all, with as many processes as there are processors; how many functions there are.

    `progress` is called with the number of modules that are done since the last call. Numba keeps
    the results on disk, beside the package or where it may write.
    """
    modules, total = compiled_modules(), 0
    with ProcessPoolExecutor(min(len(modules), os.cpu_count() or 1)) as pool:
        for n in pool.map(prepare_module, modules):
            total += n
            progress(1)
    return total
