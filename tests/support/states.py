"""States of a tracker, changed by the names of what they are made of."""

from dataclasses import fields, replace
from typing import Any

from torch import Tensor

from torchtrack.tracking.state import TrackerState

_PARTS = ("motion", "health", "appearance", "maps")


def changed(state: TrackerState, **values: Tensor | None) -> TrackerState:
    """The state with other values of fields of its parts; of ``motion`` first, where several have a field of that name."""
    for name, value in values.items():
        part = next((part for part in _PARTS if name in {field.name for field in fields(getattr(state, part))}), None)
        other: Any = value if part is None else replace(getattr(state, part), **{name: value})
        state = replace(state, **{part or name: other})
    return state
