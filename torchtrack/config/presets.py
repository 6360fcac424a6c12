"""The two presets of one pipeline: ``default`` (ours) and ``paper`` (the paper's letter, for comparison)."""

from typing import Literal, get_args

from torchtrack.config.tracker import (
    ContourConfig,
    CornerConfig,
    FlowConfig,
    MatchingConfig,
    MotionConfig,
    QualityConfig,
    SolverConfig,
    SurfaceConfig,
    TrackerConfig,
    WindowConfig,
)
from torchtrack.errors import ConfigError

PresetName = Literal["default", "paper"]


def _paper() -> TrackerConfig:
    """Corners alone, matched along their flow with the splatted boundary, from the last pose, without a prior."""
    return TrackerConfig(
        window=WindowConfig(duration_us=10_000),
        surface=SurfaceConfig(margin_px=16),
        corners=CornerConfig(max_corners=200, snap=False, fresh_only=False),
        flow=FlowConfig(radius_px=6, iterations=10),
        contours=ContourConfig(source="splat", texture=False, creases=False),
        matching=MatchingConfig(
            along_flow=True, residual="point", gates_px=(8.0, 8.0, 8.0), motion_compensation=False, max_events=0, concentration=False
        ),
        solver=SolverConfig(iterations=5, loss="none", damping=1e-3, prior=False),
        motion=MotionConfig(model="hold", without_events="hold"),
        quality=QualityConfig(min_observations=6),
    )


def preset(name: PresetName | str) -> TrackerConfig:
    """The tracker settings of a preset.

    Raises:
        ConfigError: if there is no such preset.
    """
    if name == "default":
        return TrackerConfig()
    if name == "paper":
        return _paper()
    raise ConfigError(f"unknown preset '{name}': use one of {', '.join(get_args(PresetName))}.")
