"""What kernels make of something beside what PyTorch's operations make of it."""

from collections.abc import Callable

import torch
from tracked_boxes import tensors_of

from torchtrack.core.dispatch import backend

ROUNDINGS = {torch.float32: 2e-4, torch.float64: 1e-9}


def both_ways(compute: Callable):
    """What kernels give, and what goes without them."""
    with torch.inference_mode():
        with backend(wanted=False):
            plain = compute()
        return compute(), plain


def assert_as_close(by_kernels, plain, *, tolerance: float = 1e-9):
    """Numbers that agree to roundings, all else exactly; of nested dataclasses, tuples and tensors."""
    ours, theirs = ([tensor for part in parts for tensor in tensors_of(part)] for parts in (_parts(by_kernels), _parts(plain)))
    assert len(ours) == len(theirs) > 0
    for mine, other in zip(ours, theirs, strict=True):
        if mine.is_floating_point():
            torch.testing.assert_close(mine, other, rtol=tolerance, atol=tolerance, equal_nan=True)
        else:
            assert torch.equal(mine.to(other.dtype), other)


def _parts(value):
    return value if isinstance(value, tuple) else (value,)
