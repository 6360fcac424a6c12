"""Statuses of objects."""

from enum import IntEnum


class Status(IntEnum):
    """What a pose is worth, in the order of gravity; :mod:`torchtrack.tracking.validation.verdict` decides it."""

    TRACKING = 0
    UNCERTAIN = 1
    LOST = 2
    TOO_FEW_EVENTS = 3
    OUT_OF_VIEW = 4
    DIVERGED = 5
