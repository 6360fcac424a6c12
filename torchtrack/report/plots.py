"""Plots of runs over time: status and quality, errors or standard deviations, position and path.

The axes of several runs reach as far, so that they can be compared side by side.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchtrack.core.atomic import atomic_path
from torchtrack.errors import ConfigError
from torchtrack.report.finished import FinishedRun, ObjectTrack
from torchtrack.tracking.validation.status import Status

STATUS_COLOURS = {
    Status.TRACKING: "#2e9e4f",
    Status.UNCERTAIN: "#f0a30a",
    Status.LOST: "#c9302c",
    Status.TOO_FEW_EVENTS: "#9aa5b1",
    Status.OUT_OF_VIEW: "#6f5fb5",
    Status.DIVERGED: "#7a1f1c",
}
_WIDTH_INCH, _ROW_INCH, _FILE_DPI = 6.4, 1.9, 150
# More points than a picture has pixels show nothing more; of so many windows at once, the largest value is shown.
_MOST_POINTS = 1500


@dataclass(frozen=True)
class Limits:
    """How far the axes reach that several runs share.

    Args:
        rotation_deg, translation_cm: of errors, or of standard deviations where no truth is known.
        has_truth: which of the two are shown.
    """

    rotation_deg: float
    translation_cm: float
    has_truth: bool


def shared_limits(runs: Sequence[FinishedRun]) -> Limits:
    """The limits that fit all runs; standard deviations are shown where a run has no truth at all."""
    tracks = [track for run in runs for track in run.tracks]
    has_truth = all(any(np.isfinite(track.error).any() for track in run.tracks) for run in runs)
    shown = [track.error if has_truth else track.std for track in tracks]
    rotation_deg, translation_cm = (_reach([values[:, column] for values in shown]) for column in (0, 1))
    return Limits(rotation_deg, translation_cm, has_truth)


def _reach(values: Sequence[np.ndarray]) -> float:
    every = np.concatenate([*values, np.zeros(1)])
    every = every[np.isfinite(every)]
    # One jump is not to flatten all else.
    return float(1.15 * min(every.max(), 5 * np.percentile(every, 99)) or 1.0)


def status_plot(run: FinishedRun) -> Figure:
    """The status of each object as a band, and its quality below."""
    figure = _figure(1 + 0.35 * len(run.tracks))
    band, quality = figure.subplots(2, 1, sharex=True, height_ratios=[0.3 * len(run.tracks) + 0.2, 1])
    for row, track in enumerate(run.tracks):
        _draw_band(band, row, track)
        quality.plot(*_thinned(track.t_us, track.quality, np.min), linewidth=1, label=track.label)
    band.set(yticks=range(len(run.tracks)), yticklabels=[track.label for track in run.tracks], ylim=(len(run.tracks) - 0.5, -0.5))
    shown = [status for status in STATUS_COLOURS if any((track.status == status).any() for track in run.tracks)]
    handles = [mpl.patches.Patch(color=STATUS_COLOURS[status], label=status.name) for status in shown]
    band.legend(handles=handles, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, fontsize="x-small", frameon=False)
    quality.set(ylabel="quality", ylim=(0, 1.03), xlabel="time (s)")
    return _finished(figure)


def _draw_band(axes: Axes, row: int, track: ObjectTrack) -> None:
    """One bar for each stretch of windows of the same status."""
    t_s = 1e-6 * track.t_us
    starts = np.flatnonzero(np.diff(track.status, prepend=-1))
    edges = np.append(t_s[starts], t_s[-1:])
    for begin, end, status in zip(edges[:-1], edges[1:], track.status[starts], strict=True):
        axes.barh(row, end - begin, left=begin, height=0.7, color=STATUS_COLOURS[Status(int(status))], linewidth=0)


def error_plot(run: FinishedRun, limits: Limits) -> Figure:
    """Errors over time, with what the tracker expects of them dotted; standard deviations alone where no truth is known."""
    figure = _figure(2.0)
    of_what = "error" if limits.has_truth else "standard deviation"
    rows = figure.subplots(2, 1, sharex=True)
    for column, (axes, unit, reach) in enumerate(
        zip(rows, ("rotation (°)", "position (cm)"), (limits.rotation_deg, limits.translation_cm), strict=True)
    ):
        for track in run.tracks:
            shown = track.error if limits.has_truth else track.std
            (line,) = axes.plot(*_thinned(track.t_us, shown[:, column], np.max), linewidth=1, label=track.label)
            if limits.has_truth:
                axes.plot(*_thinned(track.t_us, track.std[:, column], np.max), ":", linewidth=0.8, color=line.get_color())
        axes.set(ylabel=unit, ylim=(0, reach))
    rows[0].set_title(f"{of_what}; dotted: standard deviation as estimated" if limits.has_truth else of_what, fontsize="small", loc="left")
    rows[1].set_xlabel("time (s)")
    _legend(rows[0])
    return _finished(figure)


def trajectory_plot(run: FinishedRun) -> Figure:
    """The position of each object in the camera's frame over time, and its path from above."""
    figure = _figure(2.2)
    over_time, path = figure.subplots(1, 2, width_ratios=[1.5, 1])
    for number, track in enumerate(run.tracks):
        for axis, style in enumerate(("-", "--", ":")):
            times, values = _thinned(track.t_us, track.position_m[:, axis], np.mean)
            over_time.plot(times, values, style, linewidth=1, color=f"C{number}")
        path.plot(
            *(_thinned(track.t_us, track.position_m[:, axis], np.mean)[1] for axis in (0, 2)), linewidth=1, color=f"C{number}", label=track.label
        )
        path.plot(track.position_m[:1, 0], track.position_m[:1, 2], "o", markersize=4, color=f"C{number}")
    over_time.set(xlabel="time (s)", ylabel="position (m): x -, y - -, z ··")
    path.set(xlabel="x (m)", ylabel="z (m), away from the camera")
    path.set_aspect("equal", adjustable="datalim")
    _legend(path)
    return _finished(figure)


def _thinned(
    t_us: Shaped[np.ndarray, "n"], values: Float[np.ndarray, "n"], of_many: Callable[..., np.ndarray]
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Times (s) and values, where there are too many one for several windows."""
    several = -(-len(t_us) // _MOST_POINTS)
    if several <= 1:
        return 1e-6 * t_us, values
    kept = len(t_us) // several * several
    return 1e-6 * t_us[:kept:several], of_many(values[:kept].reshape(-1, several), axis=1)


def _figure(rows: float) -> Figure:
    # Not through pyplot, which keeps figures in a global list and picks a window system.
    return Figure(figsize=(_WIDTH_INCH, _ROW_INCH * rows), layout="constrained")


def _legend(axes: Axes) -> None:
    if axes.get_legend_handles_labels()[1]:
        axes.legend(fontsize="x-small")


def _finished(figure: Figure) -> Figure:
    for axes in figure.axes:
        axes.grid(alpha=0.25, linewidth=0.5)
        axes.tick_params(labelsize="x-small")
    return figure


def as_svg(figure: Figure) -> str:
    """The picture as an SVG element, letters as outlines: it needs no font and no network."""
    stream = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "path"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


def write_plots(run: FinishedRun, folder: Path) -> None:
    """Write ``status.png``, ``accuracy.png`` and ``trajectory.png`` of a run into a folder.

    Raises:
        ConfigError: if the run has no window.
        OutputError: if they cannot be written.
    """
    if not run.tracks:
        raise ConfigError(f"'{run.folder}' has no poses to plot. Track again.")
    figures = {"status": status_plot(run), "accuracy": error_plot(run, shared_limits([run])), "trajectory": trajectory_plot(run)}
    for name, figure in figures.items():
        with atomic_path(folder / f"{name}.png") as temporary:
            figure.savefig(temporary, format="png", dpi=_FILE_DPI)
