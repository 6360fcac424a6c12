"""What an evaluation measured, and the files that it is written to."""

import csv
import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from torchtrack.core.atomic import atomic_path
from torchtrack.eval.surface_errors import SurfaceErrors
from torchtrack.run.metrics import Metrics, PoseErrors
from torchtrack.run.sinks.summary import finite


@dataclass(frozen=True)
class ObjectResult:
    """Errors of one object in one sequence under one method, its windows by status, how long a step took, and what its surface is off by.

    ``unseen_turns`` tells of surfaces of revolution, whose turns about their axis are no errors; ``run`` is which of several it was.
    """

    sequence: str
    object: str
    method: str
    errors: PoseErrors
    metrics: Metrics
    status: dict[str, int]
    median_step_ms: float
    unseen_turns: bool = False
    surface: SurfaceErrors | None = None
    run: int = 1

    def as_json(self) -> dict[str, Any]:
        """One entry of ``metrics.json``."""
        names = {"sequence": self.sequence, "object": self.object, "method": self.method, "run": self.run}
        surface = {} if self.surface is None else asdict(self.surface)
        further = {"status": self.status, "median_step_ms": self.median_step_ms, "unseen_turns": self.unseen_turns}
        return finite({**names, **self.metrics.as_dict(), **surface, **further})

    def as_row(self) -> dict[str, Any]:
        """One row of ``tables.csv``: name to value, none of them nested."""
        names = {"method": self.method, "run": self.run, "sequence": self.sequence, "object": self.object}
        status = {f"windows_{name.lower()}": count for name, count in self.status.items()}
        return {**names, **self.metrics.as_dict(), **status, "step_ms": self.median_step_ms}


@dataclass(frozen=True)
class NotApplicable:
    """An object that a method is not made for, and why: no failure, but no figure either."""

    sequence: str
    object: str
    method: str
    reason: str

    def as_json(self) -> dict[str, Any]:
        """One entry of ``metrics.json``: no figures, and the reason."""
        names = {"sequence": self.sequence, "object": self.object, "method": self.method}
        return {**names, **dict.fromkeys(field.name for field in fields(Metrics)), "windows": 0, "not_applicable": self.reason}


@dataclass(frozen=True)
class Failure:
    """A sequence that could not be tracked, and why."""

    sequence: str
    method: str
    reason: str


@dataclass(frozen=True)
class Evaluation:
    """Everything that was measured, in the order asked for, what methods are not made for, and what failed."""

    results: tuple[ObjectResult, ...]
    not_applicable: tuple[NotApplicable, ...]
    failures: tuple[Failure, ...]


def write_results(evaluation: Evaluation, folder: Path) -> None:
    """Write ``metrics.json`` (one entry per sequence, object and method) and ``errors.csv`` (one row per window)."""
    with atomic_path(folder / "metrics.json") as path:
        entries = [*(result.as_json() for result in evaluation.results), *(entry.as_json() for entry in evaluation.not_applicable)]
        path.write_text(json.dumps(entries, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")
    with atomic_path(folder / "errors.csv") as path, path.open("w", encoding="utf-8", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("sequence", "object", "method", "run", "t_us", "rotation_deg", "translation_cm"))
        for result in evaluation.results:
            errors = result.errors
            for values in zip(errors.t_us.tolist(), errors.rotation_deg.tolist(), errors.translation_cm.tolist(), strict=True):
                rows.writerow((result.sequence, result.object, result.method, result.run, values[0], f"{values[1]:.6g}", f"{values[2]:.6g}"))
