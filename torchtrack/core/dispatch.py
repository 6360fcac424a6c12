"""The one seam between the reference and what runs in its place.

A pipeline file holds the reference: complete, differentiable, for any device. A backend registers a second body of the same
function, with the same signature: Numba's for the CPU, Triton's for a GPU. Which of them runs is decided here and nowhere else: the
backend's, where no gradients are recorded and nothing is compiled, where it is wanted and installed, and where it supports the
arguments.

    # tracking/estimation/rounds.py
    @accelerable
    def align_rounds(...): ...

    # backends/numba/rounds.py
    @accelerates(align_rounds, supports=...)
    def align_rounds_numba(...): ...
"""

import importlib.metadata
import importlib.util
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache, wraps
from importlib import import_module
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchtrack.core import host_sync

P, R = ParamSpec("P"), TypeVar("R")
# By kind of device: the library that its kernels are written with, which is also the name of the backend's folder.
LIBRARIES = {"cpu": "numba", "cuda": "triton"}
# Versions before it fail to compile the kernels.
_OLDEST_TRITON = (3, 5)
# The kind of device whose backend computes, empty for none; where it is not known, the arguments tell.
_USED: ContextVar[str | None] = ContextVar("a backend is used", default=None)


@dataclass
class Body:
    """A backend's body of one function.

    Args:
        accelerated: the body.
        supports: whether it can do what the arguments ask for.
        in_graphs: whether a compiler of graphs can follow it.
    """

    accelerated: Callable[..., Any]
    supports: Callable[..., bool] | None = None
    in_graphs: bool = False

    def can(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        """Whether it takes a call with these arguments."""
        return self.supports is None or self.supports(*args, **kwargs)


@dataclass
class Operation:
    """One function of the seam.

    Args:
        name: of its reference, ``room.module.function``.
        reference: the body in PyTorch.
        bodies: those of backends, once they are loaded, by kind of device.
    """

    name: str
    reference: Callable[..., Any]
    bodies: dict[str, Body] = field(default_factory=dict)

    def body(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Callable[..., Any]:
        """What takes a call with these arguments."""
        used = _USED.get()
        if used is None:
            used = _backend_for(_a_tensor_of(args))
        if not used or torch.is_grad_enabled():
            return self.reference
        _load(used)
        body = self.bodies.get(used)
        return body.accelerated if body is not None and body.can(args, kwargs) else self.reference


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
            body = OPERATIONS[name].bodies.get(backend_in_graphs())
            if body is None or not body.in_graphs or not body.can(args, kwargs):
                return reference(*args, **kwargs)
            in_graph: R = body.accelerated(*args, **kwargs)
            return in_graph
        result: R = OPERATIONS[name].body(args, kwargs)(*args, **kwargs)
        return result

    chosen.operation = name  # type: ignore[attr-defined]
    return chosen


def backend_in_graphs() -> str:
    """The kind of device whose backend may compute in a graph that is being compiled; empty for none. A compiler takes this for a constant."""
    used = _USED.get() or ""
    if used:
        _load(used)
    return used


def accelerates(
    chosen: Callable[P, R], supports: Callable[P, bool] | None = None, device: str = "cpu", *, in_graphs: bool = False
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: this is a backend's body of an :func:`accelerable` function.

    Args:
        chosen: that function.
        supports: whether this body can do what the arguments ask for; all of it when not given.
        device: the kind of device that it computes on.
        in_graphs: whether a compiler of graphs can follow it; what it cannot look into is an operation of PyTorch's.
    """

    def registered(accelerated: Callable[P, R]) -> Callable[P, R]:
        OPERATIONS[chosen.operation].bodies[device] = Body(accelerated, supports, in_graphs)
        return accelerated

    return registered


def may_accelerate(values: Tensor) -> bool:
    """Whether a backend may compute with tensors like this one: where no gradients are recorded, and one for its device is installed and wanted."""
    return not torch.is_grad_enabled() and _USED.get() != "" and bool(_backend_for(values))


@contextmanager
def backend(*, wanted: bool, values: Tensor | None = None) -> Iterator[None]:
    """Within it, the backend is used where it applies, or not at all.

    Args:
        values: a tensor on the device of all that is computed within: then no call looks for one among its arguments.
    """
    used = _USED.get() if values is None else _backend_for(values)
    token = _USED.set(used if wanted and _USED.get() != "" else "")
    try:
        yield
    finally:
        _USED.reset(token)


@cache
def backend_is_installed(device: str = "cpu") -> bool:
    """Whether there is anything to compile kernels with, for a kind of device."""
    if device not in LIBRARIES or importlib.util.find_spec(LIBRARIES[device]) is None:
        return False
    # Triton has what starts its kernels built by the system's compiler.
    return device == "cpu" or (_triton_is_new_enough() and any(map(shutil.which, [os.environ.get("CC", "cc"), "gcc", "clang"])))


def _triton_is_new_enough() -> bool:
    """Whether the kernels are known to compile; of a build under another name, as for AMD's GPUs, that is not known."""
    try:
        major, minor = importlib.metadata.version("triton").split(".")[:2]
    except importlib.metadata.PackageNotFoundError:
        return False
    return (int(major), int(minor)) >= _OLDEST_TRITON


def _backend_for(values: Tensor) -> str:
    """The kind of device whose backend may compute with tensors like this one; empty where there is none."""
    device = "cpu" if host_sync.read_at_once(values) else "cuda" if host_sync.on_gpu(values) else ""
    return device if not torch.compiler.is_compiling() and backend_is_installed(device) else ""


@cache
def _load(device: str) -> None:
    """Have a backend register what it accelerates."""
    import_module(f"torchtrack.backends.{LIBRARIES[device]}.operations")


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
