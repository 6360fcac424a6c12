"""The methods that the paper compares with, on the parts of this package: ``line``, ``ls`` and ``nns``.

``line`` (:mod:`torchtrack.baselines.line`) and ``ls`` (:mod:`torchtrack.baselines.ls`) are trackers of their own, for
objects with straight edges. ``nns`` is the tracker itself with other settings, which its preset has: our corners and
contours, associated by nearest neighbours, without the flow.
"""

from torchtrack.baselines.line import LineTracker
from torchtrack.baselines.ls import LeastSquaresTracker
from torchtrack.baselines.straight_edges import too_curved
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.tracker import Tracker

__all__ = ["LeastSquaresTracker", "LineTracker", "tracker_class", "unsuitable"]

_OWN_TRACKERS: dict[str, type[Tracker]] = {"line": LineTracker, "ls": LeastSquaresTracker}


def tracker_class(preset: str) -> type[Tracker]:
    """The tracker that a preset is for."""
    return _OWN_TRACKERS.get(preset, Tracker)


def unsuitable(preset: str, model: ObjectModel) -> str | None:
    """Why the method of a preset cannot track a model; None where it can."""
    return too_curved(model) if preset in _OWN_TRACKERS else None
