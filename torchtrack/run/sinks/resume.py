"""Taking up a run that ended early: what it has written is read, and cut off after the last window that is whole."""

import csv
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import torch

from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.core.atomic import writing
from torchtrack.core.lie import rotation_from_quaternion
from torchtrack.errors import ConfigError, MissingFileError, UnknownFormatError
from torchtrack.run.sinks.folder import CONFIG, POSES, ended
from torchtrack.run.sinks.poses import COLUMNS, tum_path
from torchtrack.run.sinks.record import Earlier
from torchtrack.tracking.validation.status import Status

# Settings that say where results go and how fast they are had, not what they are.
_MAY_DIFFER = {"output", "overlay", "ros", "threads", "device", "kernels", "compiled", "limits"}


def has_begun(folder: Path) -> bool:
    """Whether a run has written into a folder."""
    return (folder / CONFIG).is_file() and (folder / POSES).is_file()


def is_complete(folder: Path) -> bool:
    """Whether the run in a folder came to its end."""
    return has_begun(folder) and ended(folder) == "completed"


def check_resumable(config: RunConfig) -> None:
    """Raise unless the run in the output folder can be taken up with these settings.

    Raises:
        MissingFileError: if there is none.
        ConfigError: if it is complete, of a live source, or had other settings.
    """
    folder = config.output
    if not has_begun(folder):
        raise MissingFileError(f"resume: '{folder}' holds no run to take up ({CONFIG} and {POSES}). Track without --resume, or name its folder.")
    if is_complete(folder):
        raise ConfigError(f"resume: the run in '{folder}' is complete, nothing is left to do. Track without --resume to do all anew.")
    if isinstance(config.source, str):
        raise ConfigError(f"resume: '{config.source}' is live, what it sent is gone. Track without --resume, from where the objects are now.")
    before, now = (flat(run.model_dump(mode="json", exclude=_MAY_DIFFER)) for run in (load(RunConfig, folder / CONFIG), config))
    if other := sorted(key for key in before.keys() | now.keys() if before.get(key) != now.get(key)):
        named = ", ".join(f"{key} was {before.get(key)!r}, is {now.get(key)!r}" for key in other[:3])
        raise ConfigError(f"resume: the run in '{folder}' had other settings: {named}. Give the same, or track without --resume.")


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted key."""
    by_key: dict[str, Any] = {}
    for key, value in values.items():
        by_key |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return by_key


def take_up(folder: Path, labels: Sequence[str]) -> Earlier:
    """The windows of which every object's rows are whole in all files; what comes after them is cut off.

    Raises:
        UnknownFormatError: if the table is not one of these objects.
        OutputError: if the files cannot be changed.
    """
    table, tums = folder / POSES, [tum_path(folder, label) for label in labels]
    rows = _rows(table, labels)
    windows = min(len(rows) // len(labels), *(max(_lines(path) - 1, 0) for path in tums))
    for path, lines in ((table, 1 + windows * len(labels)), *((path, 1 + windows) for path in tums)):
        _keep_lines(path, lines)
    return _earlier(rows[: windows * len(labels)], len(labels), table)


def _rows(path: Path, labels: Sequence[str]) -> list[list[str]]:
    """The whole rows of a table of poses."""
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        rows = list(csv.reader(line for line in file if line.endswith("\n")))
    if rows and tuple(rows[0]) != COLUMNS:
        raise UnknownFormatError(f"resume: '{path}' is no table of poses that this version of torchtrack writes. Track without --resume.")
    for number, row in enumerate(rows[1:]):
        if len(row) != len(COLUMNS) or row[1] != labels[number % len(labels)]:
            expected = labels[number % len(labels)]
            raise UnknownFormatError(f"resume: row {number + 2} of '{path}' is not of the object '{expected}'. Track without --resume.")
    return rows[1:]


def _earlier(rows: Sequence[Sequence[str]], objects: int, path: Path) -> Earlier:
    shape = (len(rows) // objects, objects)
    try:
        numbers = torch.tensor([[float(value) for value in row[2:9]] for row in rows], dtype=torch.float64).reshape(*shape, 7)
        status = torch.tensor([int(Status[row[9]]) for row in rows], dtype=torch.int64).reshape(shape)
        quality = torch.tensor([float(row[10]) for row in rows], dtype=torch.float64).reshape(shape)
        t_us = torch.tensor([int(row[0]) for row in rows], dtype=torch.int64).reshape(shape)[:, 0]
    except (ValueError, KeyError) as error:
        raise UnknownFormatError(f"resume: '{path}' holds something else than poses: {error}. Track without --resume.") from error
    T = torch.eye(4, dtype=torch.float64).repeat(len(numbers), objects, 1, 1)
    T[..., :3, :3] = rotation_from_quaternion(numbers[..., 3:])
    T[..., :3, 3] = numbers[..., :3]
    return Earlier(t_us, T, status, quality)


def _lines(path: Path) -> int:
    """How many lines of a file are whole."""
    with path.open("rb") as file:
        return sum(line.endswith(b"\n") for line in file)


def _keep_lines(path: Path, count: int) -> None:
    with writing(path), path.open("rb+") as file:
        file.truncate(sum(len(line) for line in islice(file, count) if line.endswith(b"\n")))
