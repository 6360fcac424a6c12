"""Presets: ``default``, ``causal``, ``learned`` (ours), ``guided`` (the paper's method made to work), ``paper`` (its letter), its comparisons."""

from collections.abc import Callable
from typing import Literal, get_args

from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import (
    AdaptationConfig,
    AssociationConfig,
    ContourConfig,
    CornerConfig,
    FlowConfig,
    MotionConfig,
    SmoothingConfig,
    SolverConfig,
    TrackerConfig,
    WindowConfig,
)
from torchtrack.config.validation import ValidationConfig
from torchtrack.errors import ConfigError

PresetName = Literal["default", "causal", "learned", "guided", "paper", "line", "ls", "nns"]


# What comes later than this tells hardly anything of a pose, and few objects are out of sight for longer.
_SMOOTHED = SmoothingConfig(lag_s=0.05, retrace_s=0.5)
# Of methods of others: all edges count alike, and nothing is made of the directions that they face.
_ALL_ALIKE = frozenset({Component.COMMON_ERROR, Component.ALL_DIRECTIONS})


def _default() -> TrackerConfig:
    """Our best of recordings and of live cameras; of recordings, each pose is refined by what comes after it."""
    return TrackerConfig(smoothing=_SMOOTHED)


def _learned() -> TrackerConfig:
    """The default, with a network's word on how far each observation is to be believed, not on those of smooth silhouettes alone.

    It believes less where an object is seen badly, and explains less there: that is no sign of a slow drift.
    """
    return TrackerConfig(
        association=AssociationConfig(weighting_network="all"),
        relocalization=RelocalizationConfig(slow_drift_below=0, not_validated_below=0),
        smoothing=_SMOOTHED,
    )


def _paper() -> TrackerConfig:
    """Corners alone, matched along their flow with the splatted boundary, from the last pose, without a prior.

    Where the paper is silent, as its idea works best: windows are so short that a pose is found before its edges are out of
    reach, distances count across edges, robustly, and the boundary is extracted anew in each round of matching.
    """
    return TrackerConfig(
        window=WindowConfig(duration_us=3_000),
        corners=CornerConfig(max_corners=400, cell_px=5),
        flow=FlowConfig(model="irls", radius_px=6, iterations=10),
        contours=ContourConfig(source="splat", texture=False, creases=False),
        association=AssociationConfig(
            search="along_flow",
            gates_px=(8.0, 8.0, 8.0),
            motion_compensation=False,
            max_events=0,
            concentration=False,
            polarity=False,
            weighting_network="none",
        ),
        solver=SolverConfig(iterations=5, damping=1e-3, prior=False),
        motion=MotionConfig(model="hold", without_events="hold"),
        adaptation=AdaptationConfig(learned_points=0),
        validation=ValidationConfig(min_observations=6),
        disabled=_ALL_ALIKE,
    )


def _lines(loss: Literal["tukey", "none"]) -> TrackerConfig:
    """Events against the straight edges of the model, in short windows (:mod:`torchtrack.baselines`)."""
    return TrackerConfig(
        window=WindowConfig(duration_us=3_000),
        corners=CornerConfig(max_corners=0),
        association=AssociationConfig(gates_px=(5.0, 3.0, 2.0), max_events=1500, weighting_network="none"),
        solver=SolverConfig(iterations=3, loss=loss, damping=1e-4, prior=False),
        adaptation=AdaptationConfig(learned_points=0),
        disabled=_ALL_ALIKE,
    )


def _line() -> TrackerConfig:
    """Chamorro et al.: a Kalman filter on robust distances."""
    return _lines(loss="tukey")


def _ls() -> TrackerConfig:
    """Plain least squares."""
    return _lines(loss="none")


def _corners(search: Literal["nearest", "guided"]) -> TrackerConfig:
    """Corners, as dense as they are to be had, and events where corners are few; all else is as in ``default``.

    Corners alone lost `ape_occl` in 69 % of its windows. With events it was held, at 0.33 to 0.42°, whether these made up 600 observations or 1,500.
    """
    corners = CornerConfig(max_corners=1000, cell_px=3)
    return TrackerConfig(corners=corners, association=AssociationConfig(search=search), smoothing=_SMOOTHED)


def _guided() -> TrackerConfig:
    """The paper's method made to work: the flow of corners says which contour each is of, and how far to trust it."""
    return _corners("guided")


def _nns() -> TrackerConfig:
    """The same without flow: each with the nearest point of our contours."""
    return _corners("nearest")


def preset(name: PresetName | str) -> TrackerConfig:
    """The tracker settings of a preset.

    Raises:
        ConfigError: if there is no such preset.
    """
    makers: dict[str, Callable[[], TrackerConfig]] = {
        "default": _default,
        # The default as of a live camera: poses stand on what came before them.
        "causal": TrackerConfig,
        "learned": _learned,
        "guided": _guided,
        "paper": _paper,
        "line": _line,
        "ls": _ls,
        "nns": _nns,
    }
    if name in makers:
        return makers[name]()
    raise ConfigError(f"unknown preset '{name}': use one of {', '.join(get_args(PresetName))}.")
