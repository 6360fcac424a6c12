"""Events in HDF5 files: DSEC and its relatives (arrays x, y, t, p), Prophesee's (records), and our own sequences.

Layouts, told by what is there:

- a group with the arrays ``x y t p`` (DSEC and our own: ``events``; M3ED: ``prophesee/left``), ``xs ys ts ps`` or other usual names.
  The unit of the times may be said by their name (``t_ns``), an attribute ``unit``, or the user; else integers are in µs, others in
  seconds, where that is plausible. Of several such groups (a left and a right camera) one is chosen. ``t_offset`` (µs), beside the
  group or in it, is added, as DSEC has it; ``ms_to_idx`` speeds up seeking.
- ``CD/events``: records ``x y p t`` of Prophesee, compressed by their filter ECF, which has to be installed apart.

The sensor size comes from ``width`` and ``height`` (attributes of the group or the file), ``resolution``, ``sensor_resolution``
or ``geometry``, else from the custom of the layout: 640x480 for DSEC, 1280x720 for Prophesee.

Reference: dsec.ifi.uzh.ch/data-format; docs.prophesee.ai, HDF5 event file format.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import h5py
import numpy as np

from torchtrack.config.events import TimeUnit
from torchtrack.core.column_names import unit_of
from torchtrack.core.files import check_is_file
from torchtrack.errors import EventDataError, TorchtrackError, UnknownFormatError
from torchtrack.io.columns import Columns, shifted
from torchtrack.io.event_file import EventFile
from torchtrack.io.event_source import PART_EVENTS
from torchtrack.io.extras import optional
from torchtrack.io.hdf5_storage import check_array, check_link
from torchtrack.io.hdf5_streams import Hdf5Stream, streams_of
from torchtrack.io.one_of_several import chosen_stream
from torchtrack.io.plausibility import ENOUGH_TIMES, settled_unit, whole_microseconds

HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_PLACES = ("CD/events", "events", "prophesee/left", "davis/left/events", "t_offset", "ms_to_idx", "resolution")
_ECF_FILTER = 0x8ECF
_MOST_ITEM_BYTES = 256
_DSEC_SIZE, _PROPHESEE_SIZE = (640, 480), (1280, 720)
# Per array; events are read in order, and no part of a file twice.
_CACHE_BYTES = 1 << 20
# What h5py is known to raise over damaged files.
_DAMAGED = (OSError, KeyError, RuntimeError, ValueError, TypeError, OverflowError, MemoryError, AttributeError)
_ECF_HELP = (
    "it is compressed by Prophesee's filter ECF, which is not installed. Install it from https://github.com/prophesee-ai/hdf5_ecf "
    "(it also comes with the Metavision SDK), and set HDF5_PLUGIN_PATH to its folder."
)


@contextmanager
def open_hdf5(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; what h5py raises over damage becomes an :class:`EventDataError`."""
    try:
        check_is_file(path, "HDF5 file")
        with h5py.File(path, "r", rdcc_nbytes=_CACHE_BYTES) as file:
            yield file
    except TorchtrackError:
        raise
    except _DAMAGED as error:
        raise EventDataError(f"'{path}' is truncated or damaged ({error}). Copy or make it again.") from error


@dataclass(frozen=True)
class Hdf5Events(EventFile):
    """Events of an HDF5 file; see :class:`torchtrack.io.event_file.EventFile`.

    Raises:
        UnknownFormatError: if no layout fits.
        MissingExtraError: if a filter is missing that the extra ``hdf5`` brings.
        EventDataError: if Prophesee's filter is missing, or arrays are of the wrong kind.
    """

    unit_is_open: ClassVar[bool] = True
    has_streams: ClassVar[bool] = True

    stream: Hdf5Stream = field(init=False, default=Hdf5Stream(""))
    count: int = field(init=False, default=0)
    unit: TimeUnit = field(init=False, default="us")

    @property
    def known_count(self) -> int | None:
        """How many events there are."""
        return self.count

    def _open(self) -> None:
        with open_hdf5(self.path) as file:
            for name in _PLACES:
                check_link(file, name, self.path)
            streams = streams_of(file, self.path)
            if not streams:
                raise UnknownFormatError(
                    f"'{self.path}' is an HDF5 file without events that are known: x, y, t and p in one group, or CD/events. "
                    f"It holds: {', '.join(sorted(file)) or 'nothing'}."
                )
            stream = streams[chosen_stream(tuple(streams), self.choices.topic, f"'{self.path}'")]
            arrays = _arrays(file, stream)
            lengths = {array.shape for array in arrays}
            if len(lengths) != 1 or len(next(iter(lengths))) != 1:
                raise EventDataError(f"'{self.path}': x, y, t and p must be flat and of one length, got {[array.shape for array in arrays]}.")
            for array in arrays:
                _check_numbers(array, self.path)
                check_array(array, self.path)
                _check_filters(array, self.path)
            unit = self._unit(file, stream, arrays[0])
            for name, value in (("stream", stream), ("streams", tuple(streams)), ("count", arrays[0].shape[0]), ("unit", unit)):
                object.__setattr__(self, name, value)
            size = _sensor_size(file, stream.group)
        self._settle_size(*size, default=_PROPHESEE_SIZE if stream.is_records else _DSEC_SIZE)

    def _unit(self, file: h5py.File, stream: Hdf5Stream, times: h5py.Dataset) -> TimeUnit:
        """The unit of the times: as the user, the file or the layout says, else what is plausible."""
        if stream.is_records:
            return self.choices.time_unit or "us"
        said = next((unit_of(str(times.attrs[name])) for name in ("unit", "units") if name in times.attrs), None)
        # Whole µs, by the custom of data sets that have these tables.
        is_dsec = times.dtype.kind in "iu" and any(_optional_array(file, stream.group, name) is not None for name in ("ms_to_idx", "t_offset"))
        stated = self.choices.time_unit or said or stream.unit or ("us" if is_dsec else None)
        return settled_unit(times[:ENOUGH_TIMES], "us" if times.dtype.kind in "iu" else "s", stated, f"'{self.path}'")

    def _read(self, max_events: int) -> Iterator[Columns]:
        self.reading.total = self.count
        with open_hdf5(self.path) as file:
            offset_us = _time_offset(file, self.stream.group)
            arrays = _arrays(file, self.stream)
            size = min(max_events, PART_EVENTS)
            for start in range(self._first(file, offset_us), self.count, size):
                part = slice(start, min(start + size, self.count))
                yield self._part(arrays, part, offset_us)

    def _part(self, arrays: list[h5py.Dataset], part: slice, offset_us: int) -> Columns:
        if len(arrays) == 1:
            records = arrays[0][part]
            t, x, y, p = (records[name] for name in ("t", "x", "y", "p"))
        else:
            t, x, y, p = (array[part] for array in arrays)
        return Columns(shifted(whole_microseconds(t, self.unit, f"'{self.path}'"), offset_us), _whole(x), _whole(y), p)

    def _first(self, file: h5py.File, offset_us: int) -> int:
        """Index of an event not after ``start_us``, by the table of milliseconds where there is one."""
        table = _optional_array(file, self.stream.group, "ms_to_idx")
        if self.start_us is None or table is None or len(table) == 0 or table.dtype.kind not in "iu":
            return 0
        millisecond = min(max((self.start_us - offset_us) // 1000, 0), len(table) - 1)
        return min(max(int(table[millisecond]), 0), self.count)


def _arrays(file: h5py.File, stream: Hdf5Stream) -> list[h5py.Dataset]:
    """The one array of records, or those of t, x, y and p."""
    return [file[stream.group]] if stream.is_records else [file[stream.group][name] for name in stream.names]


def _optional_array(file: h5py.File, group: str, name: str) -> h5py.Dataset | None:
    """An array in the group of the events, or in the file itself."""
    candidates = (file.get(f"{group}/{name}"), file.get(name))
    return next((array for array in candidates if isinstance(array, h5py.Dataset)), None)


def _check_numbers(array: h5py.Dataset, path: Path) -> None:
    """Refuse an array of anything but numbers; of records, those of which t, x, y or p is none."""
    fields = {name: array.dtype[name] for name in "xytp"} if array.dtype.names else {str(array.name).rpartition("/")[2]: array.dtype}
    for name, dtype in fields.items():
        if dtype.kind not in ("iufb" if name.startswith("p") else "iuf"):
            raise EventDataError(f"'{path}': '{name}' must hold numbers, got {dtype}.")
    if array.dtype.itemsize > _MOST_ITEM_BYTES:
        raise EventDataError(f"'{path}': '{array.name}' has {array.dtype.itemsize} bytes an event, which is no form of events that is known.")


def _check_filters(array: h5py.Dataset, path: Path) -> None:
    """Raise an error that helps where an array is compressed by a filter that is not there."""
    plist = array.id.get_create_plist()
    for index in range(plist.get_nfilters()):
        code = plist.get_filter(index)[0]
        if h5py.h5z.filter_avail(code):
            continue
        if code == _ECF_FILTER:
            raise EventDataError(f"'{path}': {_ECF_HELP}")
        # Importing it registers its filters.
        optional("hdf5plugin", "hdf5plugin", "hdf5", f"reading '{path}' (HDF5 filter {code})")
        if not h5py.h5z.filter_avail(code):
            raise EventDataError(f"'{path}' is compressed by the HDF5 filter {code}, which is not installed. Set HDF5_PLUGIN_PATH to its folder.")


def _time_offset(file: h5py.File, group: str) -> int:
    offset = _optional_array(file, group, "t_offset")
    return int(offset[()].item()) if offset is not None and offset.size == 1 and offset.dtype.kind in "iu" else 0


def _sensor_size(file: h5py.File, group: str) -> tuple[int | None, int | None]:
    places: list[Any] = [file[group], file[group].parent, file]
    for place in places:
        attributes = place.attrs
        if "width" in attributes and "height" in attributes:
            return _length(attributes["width"]), _length(attributes["height"])
        if "geometry" in attributes:
            width, _, height = str(attributes["geometry"]).partition("x")
            return _length(width), _length(height)
    # Written as height and width.
    if "sensor_resolution" in file.attrs and np.size(file.attrs["sensor_resolution"]) == 2:
        height, width = np.ravel(file.attrs["sensor_resolution"]).tolist()
        return _length(width), _length(height)
    resolution = file.get(f"{group}/calib/resolution") or file.get("resolution")
    if isinstance(resolution, h5py.Dataset) and resolution.size == 2:
        width, height = np.ravel(resolution[()]).tolist()
        return _length(width), _length(height)
    return None, None


def _length(value: Any) -> int | None:
    try:
        length = int(value)
    except (TypeError, ValueError, OverflowError):
        return None
    return length if 0 < length <= 1 << 16 else None


def _whole(pixels: np.ndarray) -> np.ndarray:
    if pixels.dtype.kind != "f":
        return pixels
    if not (np.isfinite(pixels) & (np.floor(pixels) == pixels) & (np.abs(pixels) < 2**31)).all():
        raise EventDataError("pixels are not whole numbers.")
    return pixels.astype(np.int64)
