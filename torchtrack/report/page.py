"""One self-contained HTML page of one run or several, side by side: nothing is fetched when it is opened."""

import base64
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import yaml
from markupsafe import Markup

from torchtrack.core.atomic import atomic_path
from torchtrack.errors import ConfigError
from torchtrack.report.finished import FinishedRun, read_run
from torchtrack.report.plots import Limits, as_svg, error_plot, shared_limits, status_plot, trajectory_plot

# A larger video is linked, where it is: the page would take long to open.
MOST_EMBEDDED_BYTES = 12_000_000
_MOST_STILLS = 4


@dataclass(frozen=True)
class Plot:
    """A plot of the page: its title, its SVG."""

    title: str
    svg: Markup


@dataclass(frozen=True)
class Video:
    """A video of the page: its name, and its content as an address, or where it lies."""

    name: str
    address: str
    is_embedded: bool


def write_report(folders: Sequence[Path], output: Path) -> None:
    """Write the page of the runs in ``folders``.

    Raises:
        ConfigError: if there is none, or one twice.
        MissingFileError, UnknownFormatError: if a folder is not of a run.
        OutputError: if the page cannot be written.
    """
    if len({folder.resolve() for folder in folders}) != len(folders) or not folders:
        raise ConfigError("report: give one folder of a run or several, each once.")
    runs = [read_run(folder) for folder in folders]
    page = _template().render(
        runs=[_of_run(run, shared_limits(runs), output) for run in runs],
        table=[row for run in runs for row in _rows(run)],
        facts=_facts(runs),
        differences=_differences(runs),
    )
    with atomic_path(output) as temporary:
        temporary.write_text(page, encoding="utf-8")


def _template() -> jinja2.Template:
    environment = jinja2.Environment(loader=jinja2.PackageLoader("torchtrack.report", "."), autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.get_template("page.html")


def _of_run(run: FinishedRun, limits: Limits, output: Path) -> dict[str, Any]:
    """What the page shows of one run."""
    plots = [("Status and quality", status_plot(run)), ("Accuracy", error_plot(run, limits)), ("Trajectory", trajectory_plot(run))]
    return {
        "name": run.name,
        "ended": run.summary["ended"],
        "message": run.summary.get("message", ""),
        "plots": [Plot(title, Markup(as_svg(figure))) for title, figure in plots] if run.tracks else [],
        "stills": [{"name": path.name, "address": _embedded(path, "image/png")} for path in run.stills[:_MOST_STILLS]],
        "videos": [_video(path, output) for path in run.videos],
        "config": run.config,
    }


def _embedded(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def _video(path: Path, output: Path) -> Video:
    if path.stat().st_size <= MOST_EMBEDDED_BYTES:
        return Video(path.name, _embedded(path, "video/mp4"), True)
    return Video(path.name, Path(os.path.relpath(path.resolve(), output.resolve().parent)).as_posix(), False)


def _rows(run: FinishedRun) -> list[dict[str, str]]:
    """One row of the table of results per object."""
    return [_row(run, label, of_object) for label, of_object in run.summary["objects"].items()]


def _row(run: FinishedRun, label: str, of_object: Mapping[str, Any]) -> dict[str, str]:
    errors = of_object.get("errors") or {}
    lost = errors.get("lost_fraction")
    return {
        "run": run.name,
        "object": label,
        "mean error": _error(errors, "mean"),
        "largest error": _error(errors, "max"),
        "lost": "-" if lost is None else f"{100 * lost:.1f} %",
        "quality": _number(of_object.get("mean_quality"), 2),
        "windows by status": ", ".join(f"{name} {count}" for name, count in of_object["status"].items()),
        "step": f"{_number(run.summary.get('step_median_ms'), 1)} ms",
        "real time": f"{_number(run.summary.get('tracking_real_time_factor'), 2)} x",
    }


def _error(errors: Mapping[str, Any], of_which: str) -> str:
    rotation, translation = errors.get(f"{of_which}_rotation_deg"), errors.get(f"{of_which}_translation_cm")
    return "-" if rotation is None or translation is None else f"{rotation:.3f}°, {10 * translation:.2f} mm"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _facts(runs: Sequence[FinishedRun]) -> list[tuple[str, list[str]]]:
    """What ran where: a row per fact, a column per run."""
    names = ("source", "ended", "windows", "events", "duration_s", "wall_s", "device", "threads", "versions", "machine", "problems", "gap_count")
    by_run = [_flat({name: run.summary[name] for name in names if name in run.summary}) for run in runs]
    return [(key, [str(facts.get(key, "-")) for facts in by_run]) for key in dict.fromkeys(key for facts in by_run for key in facts)]


def _differences(runs: Sequence[FinishedRun]) -> list[tuple[str, list[str]]]:
    """Settings that are not the same in all runs: a row per setting, a column per run."""
    settings = [_flat(yaml.safe_load(run.config) or {}) for run in runs]
    keys = dict.fromkeys(key for of_run in settings for key in of_run if key != "output")
    rows = [(key, [str(of_run.get(key, "-")) for of_run in settings]) for key in keys]
    return [(key, values) for key, values in rows if len(set(values)) > 1]


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values by dotted key; numbers as short as they are read."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return {key: f"{value:.6g}" if isinstance(value, float) else value for key, value in flat.items()}
