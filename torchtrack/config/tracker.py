"""Settings of the tracker, stage by stage in data-flow order; what is not in the paper can be left out, by a setting or in ``disabled``."""

from typing import Literal

from pydantic import Field, field_serializer, model_validator

from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.settings import Settings
from torchtrack.config.validation import ValidationConfig


class WindowConfig(Settings):
    """How the stream is cut into windows, one pose each."""

    mode: Literal["time", "count"] = Field("time", description="Windows of equal duration, or of an equal number of events.")
    duration_us: int = Field(5_000, ge=100, le=1_000_000, description="Length of a window in mode 'time' (µs).")
    count: int = Field(5_000, ge=10, description="Events of a window in mode 'count'.")


class SurfaceConfig(Settings):
    """The time surface (Eq. 5)."""

    tau_s: float = Field(0.03, gt=0, le=10, description="Decay constant τ (s).")


class CornerConfig(Settings):
    """Harris corners of the filtered surface."""

    max_corners: int = Field(0, ge=0, le=2000, description="Corners per object that are observed beside the events; 0 switches corners off.")
    cell_px: int = Field(8, ge=3, le=64, description="At most one corner in a cell of this side (px): corners are spread evenly.")


class FlowConfig(Settings):
    """Event flow (Eq. 6-11), where association makes use of it."""

    model: Literal["arrival", "irls"] = Field(
        "arrival", description="The speed of edges across themselves, by when they came to each pixel; or least squares on newest events (the paper)."
    )
    radius_px: int = Field(3, ge=1, le=20, description="Pixels within this distance take part (px).")
    iterations: int = Field(3, ge=1, le=50, description="Reweightings.")


class ContourConfig(Settings):
    """Visible 3D contours of the object at a pose."""

    source: Literal["mesh", "splat"] = Field(
        "mesh", description="Exact contours of the mesh, or the boundary of its splatted point cloud (the paper)."
    )
    creases: bool = Field(True, description="Sharp edges of the mesh.")
    texture: bool = Field(True, description="Edges of the texture.")
    max_edge_points: int = Field(800, ge=16, le=10_000, description="Points sampled on occluding contours, creases and segments.")
    remove_hidden: bool = Field(True, description="Remove contours behind a surface of any object of the stream.")


class AssociationConfig(Settings):
    """Association of corners and events with contours."""

    search: Literal["nearest", "guided", "along_flow"] = Field(
        "nearest", description="The nearest contour; guided by how it moves, as the flow says; or the one along a corner's flow (the paper)."
    )
    residual: Literal["normal", "point"] = Field("normal", description="Distance normal to the contour, or to the matched point in both coordinates.")
    gates_px: tuple[float, ...] = Field((5.0, 2.5, 1.5, 1.2), min_length=1, description="One round of matching and solving per gate (px).")
    motion_compensation: bool = Field(True, description="Move each observation to the window's end with its contour's velocity.")
    concentration: bool = Field(True, description="Trust observations less where those around them are smeared across the contour.")
    polarity: bool = Field(True, description="Trust events less whose polarity is not that of most others on the contour around them.")
    weighting_network: Literal["none", "silhouettes", "all"] = Field(
        "silhouettes",
        description="Which observations to trust as a small network has learned from the events around them: those of smooth silhouettes, or all.",
    )
    max_events: int = Field(1500, ge=0, le=100_000, description="Recent events used as observations beside the corners, per object.")


class SolverConfig(Settings):
    """Levenberg-Marquardt on SE(3) (Eq. 12-17)."""

    iterations: int = Field(1, ge=1, le=100, description="Iterations in each round.")
    loss: Literal["tukey", "huber", "none"] = Field("tukey", description="Robust loss, with the round's gate as its scale.")
    damping: float = Field(1e-6, ge=0, description="Initial damping, as a share of the Hessian's diagonal.")
    prior: bool = Field(True, description="Weigh the observations against the prediction by its covariance, and find the velocity with the pose.")
    observation_px: float = Field(1.5, gt=0, description="Standard deviation of one observation (px).")


class MotionConfig(Settings):
    """Prediction of the next pose."""

    model: Literal["constant_velocity", "hold"] = Field("constant_velocity", description="Carry the velocity on, or start from the last pose.")
    initial_shift: float = Field(0.005, gt=0, le=1, description="Standard deviation of the initial pose (diameters).")
    initial_speed_m_s: float = Field(0.6, gt=0, description="Standard deviation of the initial speed (m/s).")
    acceleration_rate_hz: float = Field(20.0, ge=0, description="Acceleration to be expected, as a multiple of the speed (1/s).")
    acceleration_floor_m_s2: float = Field(2.0, gt=0, description="Acceleration to be expected of an object at rest (m/s²).")
    without_events: Literal["rest", "predict", "hold"] = Field(
        "rest", description="Poses that are not found go on as predicted, but rest where hardly anything fires; or they go on, or rest, in any case."
    )


class AdaptationConfig(Settings):
    """Contours learned online on the surface of objects whose models have few faces: texture that a model does not show."""

    learned_points: int = Field(512, ge=0, le=10_000, description="Contour points that are learned per object, at most; 0 for none.")


class SmoothingConfig(Settings):
    """Poses of a recording refined by what came after them, see :mod:`torchtrack.tracking.motion.smoother` and :mod:`torchtrack.run.retracing`."""

    lag_s: float = Field(
        0.0, ge=0, le=10, description="Each pose of a recording is refined by the windows of so much time after it (s); 0 for not at all."
    )
    retrace_s: float = Field(
        0.0, ge=0, le=10, description="Objects of a recording that are found again are followed back in time, by up to so much (s); 0 for not."
    )

    @property
    def holds_back(self) -> bool:
        """Whether poses wait for what comes after them."""
        return self.lag_s > 0 or self.retrace_s > 0


class TrackerConfig(Settings):
    """All settings of the tracker."""

    window: WindowConfig = WindowConfig()
    surface: SurfaceConfig = SurfaceConfig()
    corners: CornerConfig = CornerConfig()
    flow: FlowConfig = FlowConfig()
    contours: ContourConfig = ContourConfig()
    association: AssociationConfig = AssociationConfig()
    solver: SolverConfig = SolverConfig()
    motion: MotionConfig = MotionConfig()
    adaptation: AdaptationConfig = AdaptationConfig()
    relocalization: RelocalizationConfig = RelocalizationConfig()
    validation: ValidationConfig = ValidationConfig()
    smoothing: SmoothingConfig = SmoothingConfig()
    disabled: frozenset[Component] = Field(
        frozenset(), description="Components that are left out, for an ablation: docs/method.md lists their names."
    )

    def uses(self, component: Component) -> bool:
        """Whether a component takes part."""
        return component not in self.disabled

    @property
    def searches(self) -> bool:
        """Whether other poses than the predicted ones are ever tried."""
        return self.relocalization.hypotheses > 0 and self.solver.prior

    def without_searches(self) -> "TrackerConfig":
        """The same settings, but no other poses are tried."""
        return self.model_copy(update={"relocalization": self.relocalization.model_copy(update={"hypotheses": 0})})

    @field_serializer("disabled", when_used="json")
    def _in_order(self, disabled: frozenset[Component]) -> list[str]:
        return sorted(disabled)

    @model_validator(mode="after")
    def _observes_something(self) -> "TrackerConfig":
        if not (self.corners.max_corners or self.association.max_events):
            raise ValueError(
                "nothing would be observed: corners.max_corners and association.max_events are both 0; "
                "set association.max_events, such as to 1500, or for corners alone corners.max_corners, such as to 400"
            )
        return self

    @model_validator(mode="after")
    def _smoothed_by_a_filter(self) -> "TrackerConfig":
        if self.smoothing.holds_back and not (self.solver.prior and self.motion.model == "constant_velocity"):
            raise ValueError(
                "smoothing weighs poses by what the filter knows of their motion: it needs solver.prior true and motion.model constant_velocity; "
                "otherwise set smoothing.lag_s and smoothing.retrace_s to 0"
            )
        return self
