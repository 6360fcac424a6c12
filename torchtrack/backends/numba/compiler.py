"""How kernels are compiled: when they are first called, and kept on disk where there is a place for it."""

import hashlib
import inspect
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np

from torchtrack.backends import alignment
from torchtrack.tracking.validation import verdict

Array = np.ndarray

# Liberties of arithmetic that change roundings alone, and leave what is infinite or not a number as it is.
FAST = {"arcp", "contract", "nsz"}


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator: compile with numba; the compiled code is kept on disk where there is a place for it."""

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        function = inspect.unwrap(function)  # a type checker's wrapper cannot be compiled
        try:
            dispatcher: Any = numba.njit(function, cache=True, error_model="numpy", nogil=True, **options)
            # Numba looks whether the function's own file has changed, and not those of the kernels that were compiled into it.
            dispatcher._cache._cache_file._source_stamp = _digest(Path(inspect.getfile(function)).parent)
        except (RuntimeError, AttributeError):
            # No folder that may be written to (a read-only installation), or another Numba: rather none than an old kernel.
            return numba.njit(function, error_model="numpy", nogil=True, **options)
        return dispatcher

    return compiled


def for_numbers(*rules: Callable[..., Any]) -> dict[str, Any]:
    """Functions that are written for tensors, compiled for numbers from the same source; each may call those named before it."""
    known: dict[str, Any] = {"where": _where, "clamp": _clamp, "logical_not": _logical_not, "isnan": np.isnan}
    for rule in rules:
        plain = inspect.unwrap(rule)
        known[plain.__name__] = numba.njit(FunctionType(plain.__code__, plain.__globals__ | known, plain.__name__), error_model="numpy")
    return known


@cache
def _digest(folder: Path) -> str:
    """What all code comes to that kernels are made of: that of a folder, numbers of rows, and rules."""
    digest = hashlib.sha256()
    for file in [*sorted(folder.glob("*.py")), Path(alignment.__file__), Path(verdict.__file__)]:
        digest.update(file.read_bytes())
    return digest.hexdigest()


@kernel()
def _where(condition: bool, then: float, otherwise: float) -> float:
    return then if condition else otherwise


@kernel()
def _clamp(value: float, least: float, most: float) -> float:
    """What is not a number stays that."""
    return least if value < least else (most if value > most else value)


@kernel()
def _logical_not(value: bool) -> bool:
    return not value
