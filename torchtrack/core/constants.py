"""Small tensors that never change, made once for each type and device.

On a GPU, making a tensor of Python numbers waits until all that was asked of it before is done.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

Numbers = tuple[Any, ...]


"""Numbers, or rows of them."""


def constant(values: Numbers, dtype: torch.dtype, device: torch.device) -> Tensor:
    """A tensor of these numbers; whoever asks for it must not write to it."""
    # A compiled graph keeps its constants itself.
    return torch.tensor(values, dtype=dtype, device=device) if torch.compiler.is_compiling() else _kept(values, dtype, device)


@lru_cache(maxsize=256)
def _kept(values: Numbers, dtype: torch.dtype, device: torch.device) -> Tensor:
    # What is made while nothing is recorded could not be used where gradients are, nor what is made within a
    # transform of torch.func outside of it; PyTorch has no public name for leaving one.
    with torch.inference_mode(False), torch._C._DisableFuncTorch():
        return torch.tensor(values, dtype=dtype, device=device)


def disc(radius: float | int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Offsets ``[2, d]`` (column, row) of the cells whose middles lie within a radius of one's own, row by row."""
    return constant(cells_within(radius), dtype, device).T


def cells_within(radius: float | int) -> Numbers:
    """The cells as numbers; apart from how they are kept, as a compiler does not look into that, and takes this for a constant."""
    return _cells(radius)


@lru_cache(maxsize=64)
def _cells(radius: float | int) -> Numbers:
    reach = int(radius)
    steps = range(-reach, reach + 1)
    return tuple((column, row) for row in steps for column in steps if row**2 + column**2 <= radius**2)


def scalar_one(like: Tensor) -> Tensor:
    """A single 1 of the type and on the device of ``like``: what is added to a tensor takes a third of what a Python number does."""
    return constant((1.0,), like.dtype, like.device)


T = TypeVar("T")


class _Once(Generic[T]):
    """A method as an attribute, computed once: the library's ``cached_property`` without its lock, which no compiled graph can hold."""

    def __init__(self, compute: Callable[[Any], T]) -> None:
        self._compute = compute
        self.__doc__ = compute.__doc__

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, instance: Any, owner: type) -> T:
        value = self._compute(instance)
        # From now on it is found there first.
        instance.__dict__[self._name] = value
        return value


once = _Once
