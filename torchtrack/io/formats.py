"""Which reader a file of events needs, told by its content."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import cast

from torchtrack.config.events import ReadingConfig
from torchtrack.core.files import check_is_file, is_file
from torchtrack.errors import UnknownFormatError
from torchtrack.io.aedat4 import AEDAT4_MAGIC, Aedat4File
from torchtrack.io.csv_text import CsvFile
from torchtrack.io.dat import DatFile
from torchtrack.io.davis_text import DavisTextEvents, looks_like_davis_text
from torchtrack.io.es_file import ES_MAGIC, EsFile
from torchtrack.io.event_file import DEFAULT_CHOICES, EventFile
from torchtrack.io.hdf5 import HDF5_MAGIC, Hdf5Events
from torchtrack.io.npz import NpzEvents, keys_of
from torchtrack.io.prophesee_header import parse_header
from torchtrack.io.raw_file import RawFile
from torchtrack.io.ros_bag import MCAP_MAGIC, ROS1_MAGIC, SQLITE_MAGIC, RosBag, is_bag_folder
from torchtrack.io.text_file import HEAD_BYTES, as_utf8, text_member, utf8_head, whole_lines
from torchtrack.io.text_layout import has_named_columns, looks_like_events
from torchtrack.io.zip_archive import ZIP_MAGIC, damage_reported, open_archive

_SUPPORTED = (
    "numpy .npz (arrays t, x, y, p), DAVIS text (lines 't x y p', t in seconds; also zipped), CSV, Prophesee RAW (EVT2, EVT2.1, EVT3), "
    "DAT and HDF5, DSEC HDF5, AEDAT4, Event Stream (.es), ROS 1 and ROS 2 bags (event_camera_msgs, dvs_msgs)"
)
# Control characters that no text file holds.
_BINARY = bytes(set(range(32)) - set(b"\t\n\r\f\v"))
_MAGICS: tuple[tuple[bytes, type[EventFile]], ...] = (
    (HDF5_MAGIC, Hdf5Events),
    (AEDAT4_MAGIC, Aedat4File),
    (ES_MAGIC, EsFile),
    (ROS1_MAGIC, RosBag),
    (SQLITE_MAGIC, RosBag),
    (MCAP_MAGIC, RosBag),
)
FORMAT_NAMES: dict[type[EventFile], str] = {
    NpzEvents: "npz",
    DavisTextEvents: "DAVIS text",
    CsvFile: "CSV",
    RawFile: "Prophesee RAW",
    DatFile: "Prophesee DAT",
    Hdf5Events: "HDF5",
    Aedat4File: "AEDAT4",
    EsFile: "Event Stream",
    RosBag: "ROS bag",
}


def open_events(
    path: str | os.PathLike[str],
    width: int | None = None,
    height: int | None = None,
    strict: bool = False,
    choices: ReadingConfig = DEFAULT_CHOICES,
) -> EventFile:
    """Open a file of events; its format is told by its content.

    Args:
        path: the file, or the folder of a ROS 2 recording.
        width, height: sensor size in pixels, where the file does not say it (DAVIS text: 240x180 when not given).
        strict: whether what is wrong in the stream is an error. If not, what can be read is read; what was left out is
            counted in ``problems`` and reported by a warning at the end of the stream.
        choices: how what the file does not say is read: unit of times, code of polarity, which of several streams.

    Raises:
        MissingFileError: if there is no such file.
        UnknownFormatError: if no reader knows its format.
        MissingExtraError: if its format needs a library that is not installed.
        EventDataError: if it is damaged so that it cannot be opened. Events are checked as they are streamed.
    """
    path = Path(path)
    return reader_of(path)(path, width or 0, height or 0, strict, choices=choices)


@dataclass(frozen=True)
class Input:
    """A file of events, and how it is read; see :func:`open_events`."""

    path: Path
    width: int | None = None
    height: int | None = None
    strict: bool = False
    choices: ReadingConfig = DEFAULT_CHOICES

    def open(self) -> EventFile:
        """The file, as :func:`open_events` opens it."""
        return open_events(self.path, self.width, self.height, self.strict, self.choices)


def reader_of(path: Path) -> Callable[..., EventFile]:
    """The reader that a file needs.

    Raises:
        MissingFileError: if there is no such file.
        UnknownFormatError: if no reader knows its format.
    """
    if not path.is_dir() and not is_file(path):
        check_is_file(path, "event file")
    if is_bag_folder(path):
        return RosBag
    if not path.is_file():
        raise UnknownFormatError(f"'{path}' is not a file. Supported: {_SUPPORTED}.")
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    event_format = _by_head(head, path)
    if event_format is None:
        raise UnknownFormatError(f"'{path}' is in no known event format (it starts with {head[:16]!r}). Supported: {_SUPPORTED}.")
    return event_format


def _by_head(head: bytes, path: Path) -> type[EventFile] | None:
    for magic, reader in _MAGICS:
        if head.startswith(magic):
            return reader
    if head.startswith(ZIP_MAGIC):
        return _of_archive(path)
    header = parse_header(head)
    if header is not None and header.encoding is not None:
        return DatFile if header.encoding == "dat" else RawFile
    return _of_text(utf8_head(head), path.suffix.lower())


def _of_text(head: bytes, suffix: str) -> type[EventFile] | None:
    if head.translate(None, delete=_BINARY) != head:
        return None
    # Columns that are named may be in any order, and times in any unit.
    if has_named_columns(whole_lines(head)):
        return CsvFile
    if looks_like_davis_text(head):
        return DavisTextEvents
    if looks_like_events(whole_lines(head)):
        return CsvFile
    # A text file that is named like one of events is taken for one, so that the error tells which line is wrong.
    return {".txt": DavisTextEvents, ".csv": CsvFile, ".tsv": CsvFile}.get(suffix)


def _of_archive(path: Path) -> type[EventFile]:
    with open_archive(path) as archive:
        member = text_member(archive)
        if keys_of(archive) or member is None:
            return NpzEvents
        with damage_reported(path), archive.open(member) as stream:
            return _of_text(as_utf8(cast(BufferedIOBase, stream)).read(HEAD_BYTES), Path(member).suffix.lower()) or DavisTextEvents
