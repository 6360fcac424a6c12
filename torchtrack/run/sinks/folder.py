"""The output folder of a run: files grow in it while the run goes on; an earlier result is set aside until the new one is complete."""

import contextlib
import errno
import json
import os
import sys
from pathlib import Path

from torchtrack.core.atomic import missing_folders, remove_empty, writing
from torchtrack.errors import OutputError

SUMMARY, CONFIG, POSES, FIRST_STILL = "summary.json", "config.yaml", "poses.csv", "first_window.png"
# What a run writes; all else in the folder is the user's own.
_WRITTEN = (SUMMARY, CONFIG, POSES, "trajectory_*.tum", "poses*.mcap", "overlay*.mp4", "overlay*.png", FIRST_STILL)
_PREVIOUS = ".previous"
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS)


class OutputFolder:
    """A folder that one run alone writes into, from when this object is made until :meth:`close`.

    Args:
        path: the folder; made where it is not there, and taken away at the end if nothing has come into it.

    Raises:
        OutputError: if it cannot be written into, or another run does so.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._made = missing_folders(path)
        try:
            with writing(path):
                if path.exists() and not path.is_dir():
                    raise OutputError(f"cannot write to '{path}': it is a file, and results go into a folder. Name another.")
                path.mkdir(parents=True, exist_ok=True)
                self._lock = _Lock(path / "run.lock")
        except OutputError:
            remove_empty(self._made)
            raise

    def set_aside(self) -> None:
        """Give the files of an earlier run the suffix ``.previous``.

        One earlier result is kept: the newest that is complete, else the newest.

        Raises:
            OutputError: if they cannot be renamed, or would be mixed up with a user's own ``config.yaml``.
        """
        folder = self.path
        if not (earlier := _files(folder)):
            return
        if (folder / CONFIG).exists() and not (folder / POSES).exists() and not (folder / SUMMARY).exists():
            raise OutputError(f"cannot write to '{folder}': its {CONFIG} is not of a run, and would be replaced. Name another folder.")
        keeps_previous = ended(folder) != "completed" and ended(folder, _PREVIOUS) == "completed"
        with writing(folder):
            if not keeps_previous:
                self.drop_previous()
            for file in earlier:
                aside = file.with_name(f"{file.name}{_PREVIOUS}")
                if aside.exists():
                    file.unlink()
                else:
                    file.replace(aside)

    def drop_previous(self) -> None:
        """Take away what was set aside, and what a run that was killed has left of a video."""
        with writing(self.path):
            for file in (*_files(self.path, _PREVIOUS), *self.path.glob("overlay*.part.mp4")):
                file.unlink()

    def close(self) -> None:
        """Let other runs write into the folder."""
        self._lock.release()
        remove_empty(self._made)


def check_folder(path: Path) -> None:
    """Raise :class:`OutputError` where a run could not write into a folder; nothing stays of the trial."""
    OutputFolder(path).close()


def ended(folder: Path, suffix: str = "") -> str | None:
    """How the run in a folder ended, as its summary says; None where there is no summary that can be read.

    ``running`` is the summary of a run that is going on, or was killed.
    """
    try:
        summary = json.loads((folder / f"{SUMMARY}{suffix}").read_text(encoding="utf-8"))
        # Earlier versions wrote the summary of complete and of interrupted runs alone.
        return str(summary.get("ended") or ("interrupted" if summary.get("interrupted") else "completed"))
    except (OSError, ValueError, AttributeError):
        return None


def _files(folder: Path, suffix: str = "") -> list[Path]:
    """What a run has written, the summary first."""
    return [file for pattern in _WRITTEN for file in sorted(folder.glob(f"{pattern}{suffix}")) if file.is_file()]


class _Lock:
    """A file that one process at a time holds; the system releases it when the process ends, however it does.

    Where there are no such locks (Windows, some network drives) it holds nothing off.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = _opened_alone(path)
        os.ftruncate(self._file, 0)
        os.write(self._file, str(os.getpid()).encode())

    def release(self) -> None:
        """Take the file away."""
        with contextlib.suppress(OSError):
            self._path.unlink()
        os.close(self._file)


def _opened_alone(path: Path) -> int:
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            _lock(file, path)
            # One that its holder took away in between holds nothing.
            if path.exists() and os.path.samestat(path.stat(), os.fstat(file)):
                return file
        except OutputError:
            os.close(file)
            raise
        os.close(file)


def _lock(file: int, path: Path) -> None:
    if sys.platform == "win32":
        return
    import fcntl

    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        holder = os.pread(file, 20, 0).decode("ascii", "replace") or "unknown"
        raise OutputError(
            f"cannot write to '{path.parent}': another run writes there (process {holder}). Wait for it, or name another folder."
        ) from error
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
