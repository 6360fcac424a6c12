"""Files that appear whole or not at all: written under a temporary name, then put in place in one step."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path to write to; what was written replaces ``path`` when the block ends without an error.

    The temporary file lies in a hidden folder beside ``path`` (one file system, so the replacement is one step) and
    keeps its name, so that writers which go by the suffix work. On an error nothing is left behind and ``path`` is
    untouched.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name}.") as folder:
        temporary = Path(folder) / target.name
        yield temporary
        temporary.replace(target)
