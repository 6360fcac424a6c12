"""Shapes and types of the package's functions are checked in the first calls of every test: in all of them it would take most of the time."""

from functools import wraps

import jaxtyping
from beartype import beartype

# Calls that are checked in each test, of all functions together: two or three windows of a tracker.
CHECKED_CALLS = 1000


_left = [CHECKED_CALLS]


def checked(function):
    """Check the arguments and the result of a function, as ``beartype`` does, as long as there are calls left to be checked."""
    checks = beartype(function)

    @wraps(checks)
    def counted(*args, **kwargs):
        _left[0] -= 1
        if _left[0] <= 0:
            jaxtyping.config.update("jaxtyping_disable", True)
        return checks(*args, **kwargs)

    return counted


def check_again():
    """Before a test: its first calls are checked."""
    _left[0] = CHECKED_CALLS
    jaxtyping.config.update("jaxtyping_disable", False)
