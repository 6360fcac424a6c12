"""All that Triton's kernels accelerate: importing this registers it."""

from torchtrack.backends.triton import rounds

__all__ = ["rounds"]
