"""Where the events are in an HDF5 file: every group, or array of records, that holds a stream of them."""

from dataclasses import dataclass
from pathlib import Path

import h5py

from torchtrack.config.events import TimeUnit
from torchtrack.core.column_names import column_of
from torchtrack.io.event_arrays import event_sets
from torchtrack.io.hdf5_storage import check_link

_RECORDS = "CD/events"
# Where data sets have the events that are read when nobody chooses.
_FIRST = ("events", "prophesee/left", "davis/left/events", "/")
# Groups and arrays of a file, and arrays of a group, that are looked at.
_MOST_LOOKED_AT = 10_000


@dataclass(frozen=True)
class Hdf5Stream:
    """One stream of events.

    Args:
        group: the group with its arrays, or the array of records.
        names: of its arrays t, x, y and p; none for records.
        unit: that the name of the times says, if it says one.
    """

    group: str
    names: tuple[str, ...] = ()
    unit: TimeUnit | None = None

    @property
    def is_records(self) -> bool:
        """Whether it is one array of records."""
        return not self.names


def streams_of(file: h5py.File, path: Path) -> dict[str, Hdf5Stream]:
    """The streams of events of a file by name, the one that is read by default first.

    Raises:
        EventDataError: if an array lies in another file; ``path`` is for the message.
    """
    records = file.get(_RECORDS)
    if isinstance(records, h5py.Dataset):
        return {_RECORDS: Hdf5Stream(_RECORDS)} if records.dtype.names and {"x", "y", "p", "t"} <= set(records.dtype.names) else {}
    streams: dict[str, Hdf5Stream] = {}
    for group in _groups(file):
        members = file[group]
        if len(members) > _MOST_LOOKED_AT:
            continue
        for name in members:
            if column_of(name) is not None:
                check_link(members, name, path)
        arrays = [name for name in members if isinstance(members.get(name), h5py.Dataset)]
        for prefix, arrays_of in event_sets(arrays).items():
            streams["/".join(part for part in (group.strip("/"), prefix) if part) or "/"] = Hdf5Stream(group, arrays_of.names, arrays_of.unit)
    return dict(sorted(streams.items(), key=lambda item: _FIRST.index(item[0]) if item[0] in _FIRST else len(_FIRST)))


def _groups(file: h5py.File) -> list[str]:
    """Names of the groups of a file, itself included."""
    groups, seen = ["/"], 0

    def look(name: str, member: object) -> bool | None:
        nonlocal seen
        seen += 1
        if isinstance(member, h5py.Group):
            groups.append(name)
        # Anything but None ends the visit.
        return True if seen > _MOST_LOOKED_AT else None

    file.visititems(look)
    return groups
