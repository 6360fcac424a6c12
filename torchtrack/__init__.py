"""Optical-flow guided 6DoF object pose tracking with an event camera: batched over objects and streams, on PyTorch and kornia.

The pipeline, one file per stage, in data-flow order::

    events         a window of events                         torchtrack.core.events
    time surface   decayed image of last event times          torchtrack.tracking.frontend.time_surface
    corners        guided filter, Harris, snapped to events   torchtrack.tracking.frontend.corners
    flow           robust event flow of each corner           torchtrack.tracking.frontend.flow
    contours       visible 3D contours at the predicted pose  torchtrack.tracking.contours.sampling
    observations   corners and recent events of each object   torchtrack.tracking.association.observations
    matching       observations to contours                   torchtrack.tracking.association.weights
    pose solver    Levenberg-Marquardt on SE(3)               torchtrack.tracking.estimation.levenberg_marquardt
    alignment      rounds of matching and solving             torchtrack.tracking.estimation.rounds
    quality        status, covariance, explained contour      torchtrack.tracking.validation.measures
    tracker        all of it: state and window in, pose out   torchtrack.tracking.tracker
    runner         a whole recording: source, tracker, sinks  torchtrack.run.runner

In use::

    sequence = torchtrack.read_sequence("lbracket_normal.npz")
    objects = [torchtrack.ObjectModel.from_file(obj.model_path()) for obj in sequence.objects]
    tracker = torchtrack.Tracker(objects, sequence.camera, torchtrack.preset("default"))
    first = torch.stack([obj.ground_truth.T_cam_obj[0] for obj in sequence.objects])
    state = tracker.init(first, t_us=0)
    for result in torchtrack.track(sequence.events, tracker, state):
        print(result.t_us, result.T_cam_obj, result.status)

Public names are loaded when they are first used, so importing the package is quick and changes no setting of PyTorch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from torchtrack import errors as errors
    from torchtrack.config.presets import preset as preset
    from torchtrack.config.run import RunConfig as RunConfig
    from torchtrack.config.tracker import TrackerConfig as TrackerConfig
    from torchtrack.core.camera import Camera as Camera
    from torchtrack.core.events import EventBatch as EventBatch
    from torchtrack.io import Trajectory as Trajectory
    from torchtrack.io import open_events as open_events
    from torchtrack.io import open_live as open_live
    from torchtrack.io import read_calibration as read_calibration
    from torchtrack.io import read_sequence as read_sequence
    from torchtrack.io import read_trajectory as read_trajectory
    from torchtrack.io import write_tum as write_tum
    from torchtrack.object_model import ObjectModel as ObjectModel
    from torchtrack.run.runner import track as track
    from torchtrack.run.stream import Stream as Stream
    from torchtrack.tracking.state import StepResult as StepResult
    from torchtrack.tracking.state import TrackerState as TrackerState
    from torchtrack.tracking.tracker import Tracker as Tracker
    from torchtrack.tracking.validation.status import Status as Status

_HOME = {
    "Camera": "core.camera",
    "EventBatch": "core.events",
    "ObjectModel": "object_model",
    "RunConfig": "config.run",
    "Status": "tracking.validation.status",
    "StepResult": "tracking.state",
    "Stream": "run.stream",
    "Tracker": "tracking.tracker",
    "TrackerConfig": "config.tracker",
    "TrackerState": "tracking.state",
    "Trajectory": "io",
    "open_events": "io",
    "open_live": "io",
    "preset": "config.presets",
    "read_calibration": "io",
    "read_sequence": "io",
    "read_trajectory": "io",
    "track": "run.runner",
    "write_tum": "io",
}

__all__ = [*_HOME, "__version__", "errors"]


def __getattr__(name: str) -> Any:
    """Load a public name on first use."""
    if name == "errors":
        return import_module("torchtrack.errors")
    if name not in _HOME:
        raise AttributeError(f"module 'torchtrack' has no attribute '{name}'")
    value = getattr(import_module(f"torchtrack.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
