"""Files that appear whole or not at all: written under a temporary name, then put in place in one step; and errors of writing.

:func:`writing` is the one place that makes an :class:`OutputError` of what the operating system says.
"""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torchtrack.errors import OutputError, TorchtrackError


@contextmanager
def writing(path: str | os.PathLike[str]) -> Iterator[None]:
    """Within the block, what the operating system refuses is told as an :class:`OutputError` that names ``path``."""
    try:
        yield
    except TorchtrackError:
        # Some of ours are OSErrors too, and say what is wrong already.
        raise
    except (FileExistsError, NotADirectoryError) as error:
        at = Path(os.fsdecode(error.filename or path))
        file = next((above for above in (at, *at.parents) if above.is_file()), at)
        raise OutputError(f"cannot write to '{os.fspath(path)}': '{file}' is a file, where a folder should be.") from error
    except OSError as error:
        raise OutputError(f"cannot write to '{os.fspath(path)}': {error.strerror or error}.") from error


@contextmanager
def temporary_folder(target: Path) -> Iterator[Path]:
    """A hidden folder beside ``target``, made with the folders above it, which goes with all that is in it when the block ends.

    Raises:
        OutputError: if it cannot be made, or ``target`` is a folder itself.
    """
    with writing(target):
        check_file(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        # A prefix of bounded length: the name of the target may be as long as a name can be.
        folder = tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{target.name[:100]}.", ignore_cleanup_errors=True)
    with folder:
        yield Path(folder.name)


def check_file(target: Path) -> None:
    """Raise :class:`OutputError` where a folder, or a device, which a file would replace, stands in the place of a file."""
    if target.is_dir():
        raise OutputError(f"cannot write to '{target}': it is a folder. Name a file in it.")
    if target.exists() and not target.is_file():
        raise OutputError(f"cannot write to '{target}': it is a device or a pipe, and a file is written here. Name a file.")


def check_other_file(source: Path, target: Path) -> None:
    """Raise :class:`OutputError` where what is read would be replaced by what is made of it, whatever the two are called."""
    with writing(target):
        if source.exists() and target.exists() and source.samefile(target):
            raise OutputError(f"cannot write to '{target}': it is the file that is read, '{source}'. Name another.")


def check_writable(target: str | os.PathLike[str]) -> None:
    """Raise :class:`OutputError` unless a file can be written to ``target`` as far as can be known before it is; nothing stays of the trial."""
    path = Path(target)
    made = missing_folders(path.parent)
    try:
        with temporary_folder(path) as folder, writing(path):
            (folder / path.name).write_bytes(b"\0")
    finally:
        remove_empty(made)


def missing_folders(folder: Path) -> list[Path]:
    """The folder and those above it that are not there, the innermost first.

    Raises:
        OutputError: if that cannot be known, as where a name is too long.
    """
    with writing(folder):
        return [path for path in (folder, *folder.parents) if not path.exists()]


def remove_empty(folders: list[Path]) -> None:
    """Take away folders that were made and have nothing in them."""
    for folder in folders:
        try:
            folder.rmdir()
        except OSError:
            return


@contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path to write to; what was written replaces ``path`` when the block ends without an error.

    The temporary file lies in a hidden folder beside ``path`` (one file system, so the replacement is one step) and
    keeps its name, so that writers which go by the suffix work. On an error nothing is left behind and ``path`` is
    untouched.

    Raises:
        OutputError: if it cannot be written; also for an ``OSError`` within the block, which should do nothing but write.
    """
    target = Path(path)
    with temporary_folder(target) as folder, writing(target):
        temporary = folder / target.name
        yield temporary
        temporary.replace(target)
