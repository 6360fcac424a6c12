"""How kernels are compiled: when they are first called, and kept on disk where there is a place for it."""

import inspect
from collections.abc import Callable
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
            return numba.njit(function, cache=True, error_model="numpy", **options)
        except RuntimeError:  # numba found no folder that it may write to (a read-only installation)
            return numba.njit(function, error_model="numpy", **options)

    return compiled
