"""All that the kernels accelerate: importing this registers it."""

from torchtrack.backends.numba import (
    conclusion,
    contour_table,
    contours,
    events,
    filtering,
    forecast,
    hypotheses,
    index,
    measures,
    rounds,
    selection,
    silhouette_features,
    solving,
    visibility,
)

__all__ = [
    "conclusion",
    "contour_table",
    "contours",
    "events",
    "filtering",
    "forecast",
    "hypotheses",
    "index",
    "measures",
    "rounds",
    "selection",
    "silhouette_features",
    "solving",
    "visibility",
]
