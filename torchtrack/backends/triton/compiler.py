"""How Triton's kernels are made, when they are first called."""

import inspect
from collections.abc import Callable
from typing import Any

import triton

# Said, because what a version of Triton does by itself changes: a product and a sum may be rounded once.
OPTIONS = {"enable_fp_fusion": True}


def kernel(function: Callable[..., Any]) -> Any:
    """Decorator: compile with Triton."""
    # What a type checker has wrapped cannot be compiled.
    return triton.jit(inspect.unwrap(function))
