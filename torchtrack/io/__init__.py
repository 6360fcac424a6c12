"""Reading and writing: events, sequences, trajectories, calibration. :func:`open_events` picks the reader of a file."""

import os
from pathlib import Path

from torchtrack.errors import MissingFileError, UnknownFormatError
from torchtrack.io.calibration import read_calibration
from torchtrack.io.davis_text import DavisTextEvents, looks_like_davis_text
from torchtrack.io.event_source import EventSource
from torchtrack.io.npz import ZIP_MAGIC, NpzEvents
from torchtrack.io.sequence import Sequence, SequenceObject, read_sequence, write_sequence
from torchtrack.io.trajectory import Trajectory, read_tum, write_tum

__all__ = [
    "DavisTextEvents",
    "EventSource",
    "NpzEvents",
    "Sequence",
    "SequenceObject",
    "Trajectory",
    "open_events",
    "read_calibration",
    "read_sequence",
    "read_tum",
    "write_sequence",
    "write_tum",
]

_HEAD_BYTES = 1 << 16
_SUPPORTED = "numpy .npz (arrays t, x, y, p), DAVIS text (lines 't x y p', t in seconds)"
# Control characters that no text file holds.
_BINARY = bytes(set(range(32)) - set(b"\t\n\r\f\v"))


def open_events(path: str | os.PathLike[str], width: int | None = None, height: int | None = None) -> EventSource:
    """Open a file of events; its format is told by its content.

    Args:
        path: the file.
        width, height: sensor size in pixels, where the file does not say it (DAVIS text: 240x180 when not given).

    Raises:
        MissingFileError: if there is no such file.
        UnknownFormatError: if no reader knows its format.
        EventDataError: if it is damaged, or its events are malformed. Events are checked as they are streamed.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFileError(f"event file '{path}' does not exist.")
    if not path.is_file():
        raise UnknownFormatError(f"'{path}' is not a file. Supported: {_SUPPORTED}.")
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if head.startswith(ZIP_MAGIC):
        return NpzEvents(path, width or 0, height or 0)
    is_text = head.translate(None, delete=_BINARY) == head
    # A text file that is named like one of events is taken for one, so that the error tells which line is wrong.
    if is_text and (looks_like_davis_text(head) or path.suffix.lower() == ".txt"):
        return DavisTextEvents(path, width or 0, height or 0)
    raise UnknownFormatError(f"'{path}' is in no known event format (it starts with {head[:16]!r}). Supported: {_SUPPORTED}.")
