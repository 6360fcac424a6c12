"""Plots of a benchmark: lines over a number, or bars of shares."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_SIZE_INCH, _DPI = (7.0, 4.2), 120


@dataclass(frozen=True)
class Plot:
    """One picture.

    Args:
        name: for its file.
        title: above it.
        x, y: what the axes show.
        series: points ``(x, y)`` by label; of bars, x is their place in ``ticks``.
        kind: lines over logarithmic axes, or horizontal bars, stacked label upon label.
        ticks: of bars: what each is of.
    """

    name: str
    title: str
    x: str
    y: str
    series: Mapping[str, tuple[tuple[float, float], ...]]
    kind: Literal["lines", "bars"] = "lines"
    ticks: tuple[str, ...] = ()


def draw(plot: Plot, path: Path) -> None:
    """Write a plot as PNG."""
    # Not through pyplot, which keeps figures in a global list and picks a window system.
    figure = Figure(figsize=_SIZE_INCH, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    if plot.kind == "bars":
        _draw_bars(axes, plot)
    else:
        for label, points in plot.series.items():
            axes.plot(*zip(*points, strict=True), marker="o", label=label)
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
        axes.grid(alpha=0.3, which="both")
    axes.set(title=plot.title, xlabel=plot.x, ylabel=plot.y)
    if len(plot.series) > 1:
        # Bars fill the picture: what they mean stands beside it.
        if plot.kind == "bars":
            axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
        else:
            axes.legend(fontsize="small")
    figure.savefig(path, format="png")


def _draw_bars(axes: Axes, plot: Plot) -> None:
    """Horizontal bars, the first on top, stacked label upon label."""
    places, begun = range(len(plot.ticks)), [0.0] * len(plot.ticks)
    colours = matplotlib.colormaps["tab20"]
    for number, (label, points) in enumerate(plot.series.items()):
        values = [value for _, value in points]
        axes.barh(places, values, left=begun, label=label, color=colours(number % colours.N))
        begun = [sum(pair) for pair in zip(begun, values, strict=True)]
    axes.set_yticks(places, plot.ticks)
    axes.invert_yaxis()
