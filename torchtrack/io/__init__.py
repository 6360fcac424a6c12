"""Reading and writing: events, sequences, trajectories, calibration. :func:`open_events` picks the reader of a file."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from torchtrack.io.calibration import read_calibration
from torchtrack.io.davis_text import DavisTextEvents
from torchtrack.io.event_file import EventFile
from torchtrack.io.event_source import EventSource
from torchtrack.io.event_stream import EventStream
from torchtrack.io.formats import open_events
from torchtrack.io.info import EventInfo
from torchtrack.io.live import open_live
from torchtrack.io.npz import NpzEvents
from torchtrack.io.pose_files import read_trajectory
from torchtrack.io.sequence import Sequence, SequenceObject, is_sequence, read_sequence
from torchtrack.io.trajectory import Trajectory, read_tum, write_tum

if TYPE_CHECKING:
    from torchtrack.io.sequence_writer import LabelledMesh as LabelledMesh
    from torchtrack.io.sequence_writer import write_sequence as write_sequence

__all__ = [
    "DavisTextEvents",
    "EventFile",
    "EventInfo",
    "EventSource",
    "EventStream",
    "LabelledMesh",
    "NpzEvents",
    "Sequence",
    "SequenceObject",
    "Trajectory",
    "is_sequence",
    "open_events",
    "open_live",
    "read_calibration",
    "read_sequence",
    "read_trajectory",
    "read_tum",
    "write_sequence",
    "write_tum",
]


def __getattr__(name: str) -> Any:
    """Load the writer of sequences on first use: it needs the library of meshes, which takes more memory than reading does."""
    if name in ("LabelledMesh", "write_sequence"):
        return getattr(import_module("torchtrack.io.sequence_writer"), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
