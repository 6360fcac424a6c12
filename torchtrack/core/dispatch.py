"""The one seam between the reference and what runs in its place.

A pipeline file holds the reference: complete, differentiable, for any device. A backend registers a second body of the same
function, with the same signature. Which of the two runs is decided here and nowhere else: the backend's on the CPU, where no
gradients are recorded and nothing is compiled, where it is wanted and installed, and where it supports the arguments.

    # tracking/estimation/rounds.py
    @accelerable
    def align_rounds(...): ...

    # backends/numba/rounds.py
    @accelerates(align_rounds, supports=...)
    def align_rounds_numba(...): ...
"""

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, wraps
from importlib import import_module
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchtrack.core import host_sync

P, R = ParamSpec("P"), TypeVar("R")
_BACKEND = "torchtrack.backends.numba.operations"
# Whether a backend computes; where it is not known, the arguments tell.
_USED: ContextVar[bool | None] = ContextVar("a backend is used", default=None)


@dataclass
class Operation:
    """One function of the seam.

    Args:
        name: of its reference, ``room.module.function``.
        reference: the body in PyTorch.
        accelerated: the backend's body, once it is loaded.
        supports: whether that one can do what the arguments ask for.
    """

    name: str
    reference: Callable[..., Any]
    accelerated: Callable[..., Any] | None = None
    supports: Callable[..., bool] | None = None

    def body(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Callable[..., Any]:
        """What takes a call with these arguments."""
        used = _USED.get()
        if used is None:
            used = host_sync.read_at_once(_a_tensor_of(args)) and backend_is_installed()
        if not used or torch.is_grad_enabled():
            return self.reference
        _load()
        if self.accelerated is None or (self.supports is not None and not self.supports(*args, **kwargs)):
            return self.reference
        return self.accelerated


# Every function of the seam, by name: filled as modules are imported.
OPERATIONS: dict[str, Operation] = {}


def accelerable(reference: Callable[P, R]) -> Callable[P, R]:
    """Decorator: a backend may take this function's place."""
    name = f"{reference.__module__.removeprefix('torchtrack.')}.{reference.__qualname__}"
    OPERATIONS[name] = Operation(name, reference)

    @wraps(reference)
    def chosen(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            # Here, not further down: a compiler follows whatever it comes by, and knows plain functions and texts alone.
            return reference(*args, **kwargs)
        result: R = OPERATIONS[name].body(args, kwargs)(*args, **kwargs)
        return result

    chosen.operation = name  # type: ignore[attr-defined]
    return chosen


def accelerates(chosen: Callable[P, R], supports: Callable[P, bool] | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: this is the backend's body of an :func:`accelerable` function.

    Args:
        chosen: that function.
        supports: whether this body can do what the arguments ask for; all of it when not given.
    """

    def registered(accelerated: Callable[P, R]) -> Callable[P, R]:
        operation = OPERATIONS[chosen.operation]
        operation.accelerated, operation.supports = accelerated, supports
        return accelerated

    return registered


def may_accelerate(values: Tensor) -> bool:
    """Whether a backend may compute with tensors like this one: on the CPU, where no gradients are recorded, and one is installed and wanted."""
    return host_sync.read_at_once(values) and not torch.is_grad_enabled() and _USED.get() is not False and backend_is_installed()


@contextmanager
def backend(*, wanted: bool, values: Tensor | None = None) -> Iterator[None]:
    """Within it, the backend is used where it applies, or not at all.

    Args:
        values: a tensor on the device of all that is computed within: then no call looks for one among its arguments.
    """
    used = _USED.get() if values is None else host_sync.read_at_once(values)
    token = _USED.set(used if wanted and _USED.get() is not False and backend_is_installed() else False)
    try:
        yield
    finally:
        _USED.reset(token)


@cache
def backend_is_installed() -> bool:
    """Whether there is anything to compile kernels with."""
    return importlib.util.find_spec("numba") is not None


@cache
def _load() -> None:
    """Have the backend register what it accelerates."""
    import_module(_BACKEND)


def _a_tensor_of(args: tuple[Any, ...]) -> Tensor:
    """A tensor among the arguments, or of a dataclass among them, or within that: all are on one device."""
    for value in args:
        if isinstance(value, Tensor):
            return value
        for inner in getattr(value, "__dict__", {}).values():
            if isinstance(inner, Tensor):
                return inner
            for innermost in getattr(inner, "__dict__", {}).values():
                if isinstance(innermost, Tensor):
                    return innermost
    raise TypeError("an accelerable function needs a tensor among its positional arguments, or a dataclass that holds one")
