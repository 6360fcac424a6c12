"""Whether the arrays of an HDF5 file are what they seem, before anything of their size is allocated.

A file of a few bytes may declare arrays of any size: of values that were never written, of compressed zeros, or in other files.
"""

from math import prod
from pathlib import Path

import h5py

from torchtrack.core.limits import check_limit
from torchtrack.errors import EventDataError

# Less is read at once anyhow.
_SMALL_BYTES = 1 << 20


def check_link(file: h5py.Group, name: str, path: Path) -> None:
    """Refuse a name that leads into another file, at any of its parts.

    Raises:
        EventDataError: if it does.
    """
    place = file
    for part in name.strip("/").split("/"):
        link = place.get(part, getlink=True) if part in place.keys() else None  # noqa: SIM118 - a link that leads nowhere is a key, and not in it
        if isinstance(link, h5py.ExternalLink):
            raise EventDataError(f"'{path}': '{name}' is in another file ({link.filename}), which is not opened. Copy it into this file.")
        following = place.get(part)
        if not isinstance(following, h5py.Group):
            return
        place = following


def check_array(array: h5py.Dataset, path: Path) -> None:
    """Refuse an array that lies elsewhere, or is very much larger than what is stored of it.

    Raises:
        EventDataError: if its values are in other files.
        LimitError: if its parts, or all of it, are larger than a limit.
    """
    plist = array.id.get_create_plist()
    if array.is_virtual or plist.get_external_count():
        raise EventDataError(f"'{path}': the values of '{array.name}' are in other files, which are not opened. Copy them into this file.")
    where = f"{path}: {array.name}"
    if array.chunks:
        check_limit("block_bytes", prod(array.chunks) * array.dtype.itemsize, where)
    size = prod(array.shape or (0,)) * array.dtype.itemsize
    if size > _SMALL_BYTES:
        check_limit("expansion", size // max(array.id.get_storage_size(), 1), where)


def check_whole(array: h5py.Dataset, path: Path) -> None:
    """As :func:`check_array`, of an array that is read at once."""
    check_array(array, path)
    check_limit("array_bytes", prod(array.shape or (0,)) * array.dtype.itemsize, f"{path}: {array.name}")
