"""What an evaluation has measured so far, a line of JSON each: one that was broken off can be taken up again."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

import torchtrack
from torchtrack.config.run import RunConfig
from torchtrack.core.atomic import writing
from torchtrack.errors import UnknownFormatError
from torchtrack.eval.results import NotApplicable, ObjectResult
from torchtrack.eval.start import StartError
from torchtrack.eval.surface_errors import SurfaceErrors
from torchtrack.io.line_file import LineFile
from torchtrack.run.metrics import PoseErrors, summarise

Measured = Sequence[ObjectResult | NotApplicable]
"""What was measured of one sequence under one method."""


def identity(path: Path, method: str, config: RunConfig, start: StartError) -> str:
    """What tells a measurement from others: the sequence as it is on disk, the method with all its settings, the start, and this package's version.

    From which error on a window counts as lost is asked when a measurement is read.
    """
    there = path.stat() if path.exists() else None
    file = (str(path.resolve()), there and there.st_size, there and there.st_mtime_ns)
    text = json.dumps([file, method, config.model_dump(mode="json", exclude={"output"}), asdict(start), torchtrack.__version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


class Journal:
    """Measurements by their :func:`identity`, in a file that grows by a line with each.

    Args:
        path: of the file.
        limits: from which rotation (degrees) and translation (cm) on a window counts as lost.
    """

    def __init__(self, path: Path, limits: tuple[float, float]) -> None:
        self._path, self._limits = path, limits
        # What stands before the first line that is added; none once that is written.
        self._before: str | None = ""

    def read(self) -> dict[str, Measured]:
        """All that is in the file; of a line that was not written to its end, nothing.

        Raises:
            UnknownFormatError: if any other line is no measurement.
        """
        if not self._path.exists():
            return {}
        lines = self._path.read_bytes().split(b"\n")
        # What stands after the last line's end was broken off.
        return dict(self._measurement(number, line) for number, line in enumerate(lines[:-1], 1) if line)

    def begin(self, known: Mapping[str, Measured]) -> None:
        """Have the file begin anew with what is known already, once there is more to write: what cannot even start leaves nothing behind."""
        self._before = "".join(_line(name, measured) for name, measured in known.items())

    def add(self, name: str, measured: Measured) -> None:
        """Write one measurement."""
        with writing(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            if self._before is not None:
                self._path.unlink(missing_ok=True)
        with closing(LineFile(self._path)) as file:
            file.write((self._before or "") + _line(name, measured))
        self._before = None

    def remove(self) -> None:
        """Take the file away: all is done."""
        self._path.unlink(missing_ok=True)

    def _measurement(self, number: int, line: bytes) -> tuple[str, Measured]:
        try:
            content = json.loads(line)
            return content["identity"], [self._entry(values) for values in content["measured"]]
        except (ValueError, KeyError, TypeError) as error:
            raise UnknownFormatError(
                f"line {number} of '{self._path}' is not a measurement that this version of torchtrack writes: "
                "delete the file, or measure all anew, without --resume."
            ) from error

    def _entry(self, values: dict[str, Any]) -> ObjectResult | NotApplicable:
        if "reason" in values:
            return NotApplicable(**values)
        errors, surface = values.pop("errors"), values.pop("surface")
        t_us, *measures = errors["t_us"], errors["rotation_deg"], errors["translation_cm"]
        of_windows = PoseErrors(torch.tensor(t_us, dtype=torch.int64), *(torch.tensor(values, dtype=torch.float64) for values in measures))
        measured = None if surface is None else SurfaceErrors(**surface)
        return ObjectResult(errors=of_windows, metrics=summarise(of_windows, *self._limits), surface=measured, **values)


def _line(name: str, measured: Measured) -> str:
    return json.dumps({"identity": name, "measured": [_as_json(entry) for entry in measured]}) + "\n"


def _as_json(entry: ObjectResult | NotApplicable) -> dict[str, Any]:
    if isinstance(entry, NotApplicable):
        return dict(vars(entry))
    errors = {name: values.tolist() for name, values in vars(entry.errors).items()}
    surface = None if entry.surface is None else asdict(entry.surface)
    return {name: value for name, value in vars(entry).items() if name != "metrics"} | {"errors": errors, "surface": surface}
