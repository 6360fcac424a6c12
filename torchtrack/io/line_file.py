"""Text files that grow by whole lines, which are on disk as soon as they are written."""

import os
from io import FileIO
from pathlib import Path

from torchtrack.core.atomic import writing


class LineFile:
    """Appends lines to a file; whatever happens, as when the disk is full, the file ends with a whole line.

    Args:
        path: the file; what it holds already stays.

    Raises:
        OutputError: if it cannot be written; so do the methods.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with writing(path):
            # Without a buffer: nothing waits, and nothing is tried again when the file is closed.
            self._file = path.open("ab", buffering=0)

    def write(self, lines: str) -> None:
        """Append lines, each with its end."""
        data, written = lines.encode("utf-8"), 0
        with writing(self._path):
            try:
                while written < len(data):
                    written += _write(self._file, data[written:])
            except OSError:
                torn = written - (data[:written].rfind(b"\n") + 1)
                if torn:
                    self._file.truncate(os.fstat(self._file.fileno()).st_size - torn)
                raise

    def close(self) -> None:
        """Close the file."""
        with writing(self._path):
            self._file.close()


def _write(file: FileIO, data: bytes) -> int:
    """Write some of the data; gives how much of it."""
    return file.write(data)
