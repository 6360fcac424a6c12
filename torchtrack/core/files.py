"""Files as they are opened: whether they are files at all, how large they are, and errors that say which one is meant."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchtrack.core.limits import check_limit
from torchtrack.errors import MissingExtraError, MissingFileError, OutputError, TorchtrackError


def is_file(path: Path) -> bool:
    """Whether there is a regular file; also of a path that no file can have, such as one with too long a name."""
    try:
        return path.is_file()
    except OSError:
        return False


def check_is_file(path: Path, what: str) -> None:
    """Refuse what is not there, and what is no regular file: reading from a pipe or a device may never end.

    Args:
        path: the file.
        what: what it is, for the message, as in ``calibration file``.

    Raises:
        MissingFileError: if there is no such file.
    """
    if is_file(path):
        return
    try:
        exists = path.exists()
    except OSError as error:
        raise MissingFileError(f"{what} '{path}' cannot be opened: {error.strerror}. Check the path.") from error
    if exists:
        raise MissingFileError(f"{what} '{path}' is {'a folder' if path.is_dir() else 'a pipe or a device'}, and not a file. Check the path.")
    raise MissingFileError(f"{what} '{path}' does not exist. Check the path.")


def read_bytes(path: Path, what: str, limit: str) -> bytes:
    """All of a file, once it is known to be one, and no larger than the limit of this name allows.

    Raises:
        MissingFileError: if there is no such file.
        LimitError: if it is larger.
    """
    check_is_file(path, what)
    size = path.stat().st_size
    check_limit(limit, size, path)
    with path.open("rb") as stream:
        # No more than was asked for, even if it grows.
        return stream.read(size)


@contextmanager
def naming(path: Path | None) -> Iterator[None]:
    """Errors of ours that come out of it and do not name the file, where there is one, are told with it."""
    try:
        yield
    except (MissingExtraError, OutputError):
        # What is missing, and what cannot be written, is no fault of this file.
        raise
    except TorchtrackError as error:
        if path is None or path.name in str(error):
            raise
        error.args = (f"'{path}': {error}", *error.args[1:])
        raise
