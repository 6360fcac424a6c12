"""Figures of a benchmark, and the files that tell them."""

import json
import os
import platform
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchtrack.bench.plots import Plot, draw
from torchtrack.core.atomic import atomic_path
from torchtrack.core.dispatch import LIBRARIES, backend_is_installed
from torchtrack.core.machine import processor
from torchtrack.errors import ConfigError, MissingFileError


@dataclass(frozen=True)
class Result:
    """What was measured.

    Args:
        name: of what was measured.
        unit: of the figures.
        figures: one per repeat.
        target: the figure to reach; None for no target.
        lower_is_better: whether the target is to be stayed below, as of times, or exceeded, as of rates.
    """

    name: str
    unit: str
    figures: tuple[float, ...]
    target: float | None = None
    lower_is_better: bool = False

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """Lower quartile, median, upper quartile."""
        if len(self.figures) == 1:
            return (self.figures[0],) * 3
        lower, median, upper = statistics.quantiles(self.figures, n=4, method="inclusive")
        return lower, median, upper

    @property
    def median(self) -> float:
        """The median."""
        return self.quartiles[1]

    @property
    def reached(self) -> bool | None:
        """Whether the median is at the target or better; None without a target."""
        if self.target is None:
            return None
        return self.median <= self.target if self.lower_is_better else self.median >= self.target

    def speed_up(self, older_median: float) -> float:
        """How many times better than an older median: above 1 is better."""
        ours, theirs = (older_median, self.median) if self.lower_is_better else (self.median, older_median)
        return ours / theirs if theirs else float("inf")


def time_result(name: str, seconds: list[float], target_ms: float | None = None) -> Result:
    """Times, in ms; the target is to be stayed below."""
    return Result(name, "ms", tuple(1e3 * value for value in seconds), target_ms, lower_is_better=True)


@dataclass(frozen=True)
class Report:
    """All that one part of the benchmark gave.

    Args:
        part: its name on the command line.
        title: what was measured, and how.
        results: the figures.
        notes: what else there is to know: what is missing here, and whether what was timed did its work.
        plots: pictures of the figures.
        yardstick: time of the fixed work (:mod:`torchtrack.bench.yardstick`) in the same run; None where it was not measured.
    """

    part: str
    title: str
    results: tuple[Result, ...]
    notes: tuple[str, ...] = ()
    plots: tuple[Plot, ...] = ()
    yardstick: Result | None = None

    def over_yardstick(self, result: Result) -> float | None:
        """A time as a multiple of the yardstick's; None for what is no time, or without a yardstick."""
        if self.yardstick is None or result.unit != self.yardstick.unit:
            return None
        return result.median / self.yardstick.median


def machine(device: torch.device | None = None) -> dict[str, Any]:
    """What the figures depend on."""
    return {
        "device": torch.cuda.get_device_name(device) if device is not None and device.type == "cuda" else "cpu",
        "processor": processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "torch": torch.__version__,
        "kernels": _kernels(),
    }


def _kernels() -> str:
    """The libraries that kernels are written with, where they are installed."""
    libraries = [f"{library} {version(library)}" for device, library in LIBRARIES.items() if backend_is_installed(device)]
    return ", ".join(libraries) or "none, as Numba is not installed"


def plain(value: float) -> str:
    """A figure with as many digits as tell something."""
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}" if abs(value) >= 0.1 else f"{value:.3g}"


def as_markdown(report: Report, setup: Mapping[str, Any], older: Mapping[str, float] | None = None) -> str:
    """A table of the figures, notes, and the machine they are from.

    Args:
        report: the figures.
        setup: what they depend on, as of :func:`machine`.
        older: medians by name that the figures are compared with.
    """
    columns = ["what", "median", "quartiles", "yardsticks", "target", "", *(["against before"] if older is not None else [])]
    lines = [f"# {report.title}", "", _cells(columns), "|" + "---|" * len(columns)]
    lines += [_row(report, result, older) for result in report.results]
    notes = [*report.notes, *([_yardstick(report.yardstick)] if report.yardstick is not None else [])]
    lines += ["", *(f"- {note}" for note in notes), *([""] if notes else [])]
    lines += [f"![{plot.title}]({plot_name(report, plot)})\n" for plot in report.plots]
    return "\n".join([*lines, ", ".join(f"{key} {value}" for key, value in setup.items()), ""])


def _row(report: Report, result: Result, older: Mapping[str, float] | None) -> str:
    lower, median, upper = (plain(value) for value in result.quartiles)
    target = "–" if result.target is None else f"{'≤' if result.lower_is_better else '≥'} {result.target:g}"
    verdict = {None: "", True: "reached", False: "missed"}[result.reached]
    ratio = report.over_yardstick(result)
    cells = [result.name, f"{median} {result.unit}", f"{lower} … {upper}", "" if ratio is None else plain(ratio), target, verdict]
    if older is not None:
        cells.append(f"{result.speed_up(older[result.name]):.2f}x" if result.name in older else "new")
    return _cells(cells)


def _cells(values: Sequence[str]) -> str:
    """A row of a table."""
    return "| " + " | ".join(values) + " |"


def _yardstick(measured: Result) -> str:
    lower, median, upper = (plain(value) for value in measured.quartiles)
    return f"The yardstick took {median} {measured.unit} ({lower} … {upper}): {measured.name}"


def plot_name(report: Report, plot: Plot) -> str:
    """Name of a plot's file."""
    return f"bench_{report.part}_{plot.name}.png"


def older_medians(path: Path, part: str) -> dict[str, float]:
    """Medians by name of an earlier benchmark of the same part.

    Args:
        path: what :func:`write_results` wrote: the file, or the folder with it.
        part: the part that is compared.

    Raises:
        MissingFileError: if there is no such file.
        ConfigError: if it holds something else, or another part.
    """
    file = path / f"bench_{part}.json" if path.is_dir() else path
    if not file.is_file():
        raise MissingFileError(f"there is no '{file}' to compare with. Give a bench_{part}.json that `torchtrack bench {part}` wrote, or its folder.")
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        part_in_file, medians = content["part"], {entry["name"]: float(entry["quartiles"][1]) for entry in content["results"]}
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise ConfigError(f"'{file}' is not a file that `torchtrack bench {part}` wrote ({error!r}). Give its bench_{part}.json.") from error
    if part_in_file != part:
        raise ConfigError(f"'{file}' holds figures of the part '{part_in_file}', and '{part}' is measured. Give a bench_{part}.json.")
    return medians


def write_results(folder: Path, report: Report, setup: Mapping[str, Any], older: Mapping[str, float] | None = None) -> None:
    """Write ``bench_PART.json``, ``bench_PART.md`` and the plots."""
    results = [
        {**asdict(result), "quartiles": result.quartiles, "reached": result.reached, "over_yardstick": report.over_yardstick(result)}
        for result in report.results
    ]
    if older is not None:
        for entry, result in zip(results, report.results, strict=True):
            entry["speed_up"] = result.speed_up(older[result.name]) if result.name in older else None
    content: dict[str, Any] = {"part": report.part, "title": report.title, "machine": dict(setup), "results": results, "notes": report.notes}
    if report.yardstick is not None:
        content["yardstick"] = {**asdict(report.yardstick), "quartiles": report.yardstick.quartiles}
    texts = (("json", json.dumps(content, indent=2, ensure_ascii=False) + "\n"), ("md", as_markdown(report, setup, older)))
    for suffix, text in texts:
        with atomic_path(folder / f"bench_{report.part}.{suffix}") as temporary:
            temporary.write_text(text, encoding="utf-8")
    for plot in report.plots:
        with atomic_path(folder / plot_name(report, plot)) as temporary:
            draw(plot, temporary)
