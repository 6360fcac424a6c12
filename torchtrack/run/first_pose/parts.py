"""Work in parts, for whoever has other things to do in between."""

from collections.abc import Generator
from typing import TypeAlias, TypeVar

R = TypeVar("R")
# Stops after each part, and returns what comes of all.
Parts: TypeAlias = Generator[None, None, R]


def finished(parts: Parts[R]) -> R:
    """What comes of all parts, done at once."""
    while True:
        try:
            next(parts)
        except StopIteration as done:
            result: R = done.value
            return result
