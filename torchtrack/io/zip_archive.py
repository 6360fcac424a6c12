"""Zip archives, opened with every kind of damage told in one way."""

import lzma
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchtrack.core.files import check_is_file
from torchtrack.errors import EventDataError, TorchtrackError, UnknownFormatError

ZIP_MAGIC = b"PK\x03\x04"
# What zipfile is known to raise over damaged bytes.
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    RuntimeError,
    NotImplementedError,
    UnicodeDecodeError,
    OSError,
    ValueError,
    KeyError,
    struct.error,
    OverflowError,
    MemoryError,
)


def is_zip(path: Path) -> bool:
    """Whether a file begins as a zip archive does."""
    with path.open("rb") as stream:
        return stream.read(len(ZIP_MAGIC)) == ZIP_MAGIC


@contextmanager
def damage_reported(path: Path) -> Iterator[None]:
    """Turn what :mod:`zipfile` raises over damaged bytes into an :class:`EventDataError`."""
    try:
        yield
    except TorchtrackError:
        raise
    except _DAMAGED as error:
        raise EventDataError(f"'{path}' is truncated or damaged ({error}). Copy or make it again.") from error


def open_archive(path: str | os.PathLike[str]) -> zipfile.ZipFile:
    """Open an ``.npz`` file for reading; the caller closes it.

    Raises:
        MissingFileError: if there is no such file.
        UnknownFormatError: if it is not an ``.npz`` file.
        EventDataError: if it is one, but truncated or damaged.
    """
    path = Path(path)
    check_is_file(path, "file")
    with path.open("rb") as stream:
        magic = stream.read(len(ZIP_MAGIC))
    if magic != ZIP_MAGIC:
        raise UnknownFormatError(f"'{path}' is not an .npz file (a zip archive of numpy arrays): it starts with {magic!r}.")
    with damage_reported(path):
        return zipfile.ZipFile(path)
