"""All that Triton's kernels accelerate: importing this registers it."""

from torchtrack.backends.triton import index, rounds

__all__ = ["index", "rounds"]
