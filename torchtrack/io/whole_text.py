"""The text of a calibration or a file of poses, whole."""

from pathlib import Path

from torchtrack.core.files import read_bytes
from torchtrack.errors import TorchtrackError


def shown(error: Exception) -> str:
    """A message that may quote a file, without what no terminal can show."""
    return str(error).encode("utf-8", "replace").decode().replace("\0", "?")


def read_text_file(path: Path, what: str, limit: str, kind: type[TorchtrackError]) -> str:
    """The text of a file, as UTF-8 or, where its first bytes say so, UTF-16.

    Args:
        path: the file.
        what: what is expected to be in it, for messages.
        limit: the limit of its size, a field of :class:`torchtrack.core.limits.Limits`.
        kind: the error for what cannot be read.

    Raises:
        MissingFileError: if there is no such file.
        LimitError: if it is larger than the limit.
        TorchtrackError: of the given kind, if it cannot be read.
    """
    try:
        content = read_bytes(path, what, limit)
    except PermissionError as error:
        raise kind(f"{what} '{path}' cannot be read: {error.strerror}.") from error
    encoding = "utf-16" if content.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"
    return content.decode(encoding, errors="replace")
