"""How kernels are compiled: when they are first called, and kept on disk where there is a place for it."""

import hashlib
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numba
import numpy as np

Array = np.ndarray

# Liberties of arithmetic that change roundings alone, and leave what is infinite or not a number as it is.
FAST = {"arcp", "contract", "nsz"}


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: compile with numba; the compiled code is kept on disk where there is a place for it."""

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        function = inspect.unwrap(function)  # a type checker's wrapper cannot be compiled
        try:
            dispatcher: Any = numba.njit(function, cache=True, error_model="numpy", **options)
            # Numba looks whether the function's own file has changed, and not those of the kernels that were compiled into it.
            dispatcher._cache._cache_file._source_stamp = _folder_digest(Path(inspect.getfile(function)).parent)
        except (RuntimeError, AttributeError):
            # No folder that may be written to (a read-only installation), or another Numba: rather none than an old kernel.
            return numba.njit(function, error_model="numpy", **options)
        return dispatcher

    return compiled


@cache
def _folder_digest(folder: Path) -> str:
    """What all code of a folder comes to."""
    digest = hashlib.sha256()
    for file in sorted(folder.glob("*.py")):
        digest.update(file.read_bytes())
    return digest.hexdigest()
