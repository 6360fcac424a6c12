"""Whether kernels take the place of PyTorch's operations."""

import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

import torch
from torch import Tensor

from torchtrack.core import host_sync

_WANTED: ContextVar[bool] = ContextVar("kernels are wanted", default=True)


def apply_to(values: Tensor) -> bool:
    """Whether kernels may compute with tensors like this one: on the CPU, where no gradients are recorded, and Numba is installed."""
    return host_sync.read_at_once(values) and not torch.is_grad_enabled() and _WANTED.get() and numba_is_installed()


@cache
def numba_is_installed() -> bool:
    """Whether there is anything to compile kernels with."""
    return importlib.util.find_spec("numba") is not None


@contextmanager
def kernels(*, wanted: bool) -> Iterator[None]:
    """Within it, kernels are used where they apply, or not at all."""
    token = _WANTED.set(wanted and _WANTED.get())
    try:
        yield
    finally:
        _WANTED.reset(token)
