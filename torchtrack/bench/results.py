"""Figures of a benchmark, and the files that tell them."""

import json
import os
import platform
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtrack.io.atomic import atomic_path


@dataclass(frozen=True)
class Result:
    """What was measured: its name, the unit, one figure per repeat, and the figure to reach (None: no target)."""

    name: str
    unit: str
    figures: tuple[float, ...]
    target: float | None = None

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median, upper quartile."""
        if len(self.figures) == 1:
            return (self.figures[0],) * 3
        lower, median, upper = statistics.quantiles(self.figures, n=4, method="inclusive")
        return lower, median, upper

    @property
    def reached(self) -> bool | None:
        """Whether the median is at the target or above; None without a target."""
        return None if self.target is None else self.quartiles[1] >= self.target


def machine() -> dict[str, Any]:
    """What the figures depend on."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
    }


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines() if cpuinfo.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.processor() or "unknown")


def as_markdown(title: str, results: Sequence[Result]) -> str:
    """A table of the figures, and the machine they are from."""
    lines = [f"# {title}", "", "| what | median | quartiles | target | |", "|---|---|---|---|---|"]
    for result in results:
        lower, median, upper = result.quartiles
        target = "–" if result.target is None else f"≥ {result.target:g}"
        verdict = {None: "", True: "reached", False: "missed"}[result.reached]
        lines.append(f"| {result.name} | {median:.1f} {result.unit} | {lower:.1f} … {upper:.1f} | {target} | {verdict} |")
    lines += ["", ", ".join(f"{key} {value}" for key, value in machine().items()), ""]
    return "\n".join(lines)


def write_results(folder: Path, part: str, title: str, results: Sequence[Result]) -> None:
    """Write ``bench_PART.json`` and ``bench_PART.md``."""
    plain = [
        {"name": r.name, "unit": r.unit, "quartiles": r.quartiles, "figures": r.figures, "target": r.target, "reached": r.reached} for r in results
    ]
    content = {"part": part, "machine": machine(), "results": plain}
    for suffix, text in (("json", json.dumps(content, indent=2, ensure_ascii=False) + "\n"), ("md", as_markdown(title, results))):
        with atomic_path(folder / f"bench_{part}.{suffix}") as temporary:
            temporary.write_text(text, encoding="utf-8")
