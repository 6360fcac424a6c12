"""Events in ``.npz`` files, streamed: members ``t`` (µs), ``x``, ``y``, ``p``, compressed or stored.

Other usual names are taken too (``timestamps``, ``t_ns``, …), and several sets (``left_t``, ``right_t``, …), of which one is chosen.

``numpy.load`` would read whole arrays; here the members are read through :mod:`zipfile`, chunk by chunk, so that memory
does not grow with the file. Pickled objects are never loaded.
"""

import tokenize
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, cast

import numpy as np

from torchtrack.config.events import TimeUnit
from torchtrack.core.limits import check_limit
from torchtrack.errors import EventDataError, UnknownFormatError
from torchtrack.io.columns import Columns
from torchtrack.io.event_arrays import EventArrays, event_sets
from torchtrack.io.event_file import EventFile
from torchtrack.io.event_source import PART_EVENTS
from torchtrack.io.one_of_several import chosen_stream
from torchtrack.io.plausibility import ENOUGH_TIMES, EVENTS, settled_unit, whole_microseconds
from torchtrack.io.zip_archive import ZIP_MAGIC, damage_reported, open_archive

__all__ = ["ZIP_MAGIC", "NpzEvents", "keys_of", "open_archive", "read_array"]

_EVENT_KEYS = ("t", "x", "y", "p")
# What a sequence has, whose times are in µs.
_OF_SEQUENCE = "K"
# What numpy is known to raise over headers: it parses them as Python literals.
_BAD_HEADER = (ValueError, KeyError, TypeError, SyntaxError, OverflowError, MemoryError, RecursionError, IndexError, tokenize.TokenError)
_HEADER_READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def keys_of(archive: zipfile.ZipFile) -> set[str]:
    """Names of the arrays of an archive."""
    return {name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")}


@dataclass
class _Member:
    """One array of an archive, positioned at its data."""

    stream: zipfile.ZipExtFile
    dtype: np.dtype
    shape: tuple[int, ...]
    fortran_order: bool
    path: Path

    def read(self, count: int) -> np.ndarray:
        """The next ``count`` elements, flat."""
        with damage_reported(self.path):
            data = self.stream.read(count * self.dtype.itemsize)
        if len(data) != count * self.dtype.itemsize:
            raise EventDataError(f"'{self.path}' is truncated or damaged: an array ends early. Copy or make it again.")
        return np.frombuffer(data, self.dtype)

    def finish(self) -> None:
        """Read past the end, which makes :mod:`zipfile` compare the checksum."""
        with damage_reported(self.path):
            self.stream.read(1)


def _open_member(archive: zipfile.ZipFile, key: str, path: Path) -> _Member:
    """Open an array and check its header against the size of its data, before anything of that size is allocated."""
    if key not in keys_of(archive):
        raise EventDataError(f"'{path}' has no array '{key}'; it holds: {', '.join(sorted(keys_of(archive))) or 'none'}.")
    with damage_reported(path):
        stream = cast(zipfile.ZipExtFile, archive.open(f"{key}.npy"))
    try:
        with damage_reported(path):
            version = np.lib.format.read_magic(stream)
            shape, fortran_order, dtype = _HEADER_READERS[version](stream)
    except _BAD_HEADER as error:
        stream.close()
        raise EventDataError(f"'{path}': the array '{key}' has no readable numpy header ({error}).") from error
    if dtype.hasobject:
        stream.close()
        raise EventDataError(f"'{path}': the array '{key}' holds Python objects, which are not loaded. Save it as plain numbers.")
    if dtype.itemsize == 0 or min(shape, default=0) < 0:
        stream.close()
        raise EventDataError(f"'{path}': the array '{key}' has the shape {shape} of {dtype}, which holds nothing. Make it again.")
    data_bytes = archive.getinfo(f"{key}.npy").file_size - stream.tell()
    if data_bytes != int(np.prod(shape, dtype=object)) * dtype.itemsize:
        stream.close()
        raise EventDataError(f"'{path}': the array '{key}' should have shape {shape} of {dtype}, but holds {data_bytes} bytes. Make it again.")
    return _Member(stream, dtype, shape, fortran_order, path)


def read_array(archive: zipfile.ZipFile, key: str, path: Path) -> np.ndarray:
    """A whole (small) array of an archive.

    Raises:
        EventDataError: if it is not there, damaged, or holds objects; ``path`` is for the message.
    """
    member = _open_member(archive, key, path)
    check_limit("array_bytes", int(np.prod(member.shape, dtype=object)) * member.dtype.itemsize, f"{path}: {key}")
    with member.stream:
        flat = member.read(int(np.prod(member.shape)))
        member.finish()
    native = flat.astype(member.dtype.newbyteorder("="))
    try:
        return native.reshape(member.shape, order="F" if member.fortran_order else "C")
    except ValueError as error:
        raise EventDataError(f"'{path}': the array '{key}' has the shape {member.shape}, which no array can have ({error}).") from error


def stream_array(archive: zipfile.ZipFile, key: str, path: Path, size: int) -> Iterator[np.ndarray]:
    """A flat array of an archive, in parts of ``size``.

    Raises:
        EventDataError: if it is not there, damaged, or holds objects; ``path`` is for the message.
    """
    member = _open_member(archive, key, path)
    with member.stream:
        count = int(np.prod(member.shape))
        for start in range(0, count, size):
            yield member.read(min(size, count - start))
        member.finish()


@dataclass(frozen=True)
class NpzEvents(EventFile):
    """Events of an ``.npz`` file: integer arrays ``t`` (µs), ``x``, ``y`` and polarity ``p`` of one length.

    Times in another unit, or that are no integers, are read where the unit is told by their name or by the user.

    The sensor size is taken from the arrays ``width`` and ``height`` where the file has them; see
    :class:`torchtrack.io.event_file.EventFile`.

    Raises:
        MissingFileError, UnknownFormatError: if there is no such file, or it is not an ``.npz`` file.
        EventDataError: if an array is missing or of the wrong kind, the file is damaged, or the sensor size is unknown
            or differs from the one in the file.
    """

    unit_is_open: ClassVar[bool] = True
    has_streams: ClassVar[bool] = True

    count: int = field(init=False, default=0)
    keys: tuple[str, ...] = field(init=False, default=_EVENT_KEYS)
    unit: TimeUnit = field(init=False, default="us")

    @property
    def known_count(self) -> int | None:
        """How many events there are."""
        return self.count

    def _open(self) -> None:
        with open_archive(self.path) as archive, ExitStack() as stack:
            if not keys_of(archive):
                raise UnknownFormatError(f"'{self.path}' is a zip archive, but holds no numpy arrays (.npy).")
            for name in ("width", "height"):
                object.__setattr__(self, name, _sensor_length(archive, name, getattr(self, name), self.path))
            chosen = self._chosen(keys_of(archive))
            stated = self.choices.time_unit or chosen.unit or ("us" if _OF_SEQUENCE in keys_of(archive) else None)
            members = [_open_member(archive, key, self.path) for key in chosen.names]
            for member in members:
                stack.callback(member.stream.close)
            for member, key, name in zip(members, chosen.names, _EVENT_KEYS, strict=True):
                _check_event_member(member, key, members[0].shape, name, stated is not None)
            count = members[0].shape[0]
            unit = settled_unit(members[0].read(min(count, ENOUGH_TIMES)), "us", stated, f"'{self.path}'")
        for field_name, value in (("count", count), ("keys", chosen.names), ("unit", unit)):
            object.__setattr__(self, field_name, value)

    def _chosen(self, keys: set[str]) -> EventArrays:
        """The arrays to read."""
        sets = {prefix or "events": arrays for prefix, arrays in event_sets(keys).items()}
        if not sets:
            return EventArrays(_EVENT_KEYS, None)
        object.__setattr__(self, "streams", tuple(sets))
        return sets[chosen_stream(self.streams, self.choices.topic, f"'{self.path}'")]

    def _read(self, max_events: int) -> Iterator[Columns]:
        self.reading.total = self.count
        with ExitStack() as stack:
            archive = stack.enter_context(open_archive(self.path))
            members = [_open_member(archive, key, self.path) for key in self.keys]
            for member in members:
                stack.enter_context(member.stream)
            part = min(max_events, PART_EVENTS)
            for start in range(0, self.count, part):
                size = min(part, self.count - start)
                t, x, y, p = (member.read(size) for member in members)
                yield Columns(whole_microseconds(t, self.unit, f"'{self.path}'"), x, y, p)
            for member in members:
                member.finish()


def _sensor_length(archive: zipfile.ZipFile, name: str, given: int, path: Path) -> int:
    """Width or height, from the file or as given; 0 stands for not given."""
    if name not in keys_of(archive):
        if not given:
            raise EventDataError(f"'{path}' does not say the sensor's {name}. Give width and height in pixels.")
        return given
    with (member := _open_member(archive, name, path)).stream:
        if int(np.prod(member.shape, dtype=object)) != 1 or member.dtype.kind not in "iu":
            raise EventDataError(f"'{path}': '{name}' must be one integer, got shape {member.shape} of {member.dtype}.")
    stored = read_array(archive, name, path)
    if given and given != stored.item():
        raise EventDataError(f"'{path}' says that the sensor's {name} is {stored.item()}, but {given} was given. Leave it out, or correct it.")
    return int(stored.item())


def _check_event_member(member: _Member, key: str, shape: tuple[int, ...], name: str, is_unit_given: bool) -> None:
    """Raise unless an array can be that of ``name``: t, x, y or p; times may have decimals where their unit is told."""
    if len(member.shape) != 1 or member.shape != shape:
        raise EventDataError(f"'{member.path}': t, x, y and p must be flat and of one length, but '{key}' has shape {member.shape} and t {shape}.")
    if name == "t" and member.dtype.kind == "f" and not is_unit_given:
        got = f"'{member.path}': '{key}' must be integer microseconds, got {member.dtype}."
        raise EventDataError(f"{got} If it has another unit, set {EVENTS.setting} to s, ms, us or ns.")
    if member.dtype.kind not in {"t": "iuf", "p": "iufb"}.get(name, "iu"):
        raise EventDataError(f"'{member.path}': '{key}' must be integer numbers, got {member.dtype}. Convert and save it again.")
