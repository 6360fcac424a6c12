"""Settings of a simulated scene: objects and a camera that move, what is behind and before them, light, sensor."""

from typing import Any, Literal

import numpy as np
import trimesh
from pydantic import Field, model_validator

from torchtrack.config.merge import merged
from torchtrack.config.settings import ConfigPath, Settings
from torchtrack.core.camera import Camera, DistortionModel
from torchtrack.core.limits import Limits, current_limits
from torchtrack.io.calibration import read_calibration
from torchtrack.object_model.loading import load_parts, place_part
from torchtrack.object_model.placement import Placement
from torchtrack.sim.background import BackgroundConfig
from torchtrack.sim.meshes import make_mesh
from torchtrack.sim.render import RenderConfig
from torchtrack.sim.sensor_profiles import EVENT_CAMERA_PROFILES, EventCameraConfig
from torchtrack.sim.trajectory import CameraMotionConfig, MotionConfig

SPEEDS_PX_S = {"slow": 250.0, "normal": 750.0, "fast": 2250.0}
"""Largest speed of any point of an object in the image, by name: what the shared development sequences have."""


Model = tuple[trimesh.Trimesh, ...]
"""The parts of an object."""


class CameraConfig(Settings):
    """The camera: a sensor, a focal length, and a lens that may distort; or all of it from a calibration file."""

    calibration: ConfigPath | None = Field(None, description="Calibration file, in place of all else here but a size that it does not say.")
    width: int = Field(640, ge=8, le=4096, description="Sensor width, pixels.")
    height: int = Field(480, ge=8, le=4096, description="Sensor height, pixels.")
    fx: float = Field(600.0, gt=0, description="Focal length along x, pixels.")
    fy: float = Field(600.0, gt=0, description="Focal length along y, pixels.")
    cx: float | None = Field(None, description="Principal point, x; the middle of the sensor when not given.")
    cy: float | None = Field(None, description="Principal point, y; the middle of the sensor when not given.")
    distortion_model: DistortionModel = Field("none", description="Lens model, as in OpenCV.")
    distortion: tuple[float, ...] = Field((), description="Its coefficients.")

    def build(self) -> Camera:
        """The camera.

        Raises:
            MissingFileError, CalibrationError: if there is something wrong with the calibration file, or the distortion.
        """
        if self.calibration is not None:
            given = self.model_fields_set
            return read_calibration(self.calibration, self.width if "width" in given else None, self.height if "height" in given else None)
        cx = self.cx if self.cx is not None else (self.width - 1) / 2
        cy = self.cy if self.cy is not None else (self.height - 1) / 2
        return Camera(self.fx, self.fy, cx, cy, self.width, self.height, self.distortion_model, self.distortion)


class ObjectConfig(Settings):
    """One object: its shape, its look and its motion."""

    label: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$", description="Name, also in file names.")
    shape: (
        Literal["cube", "lbracket", "satellite", "book", "wedge", "planar", "bar", "finger", "torus_knot", "vase", "mug", "animal", "robot", "duck"]
        | None
    ) = Field(None, description="A built-in object; or give mesh.")
    mesh: ConfigPath | None = Field(None, description="PLY, OBJ, STL, GLB, glTF or OFF file, with its texture or colours.")
    unit: Literal["m", "cm", "mm", "inch"] = Field("m", description="Unit of the mesh file's coordinates.")
    scale: float = Field(1.0, gt=0, le=1e6, description="Enlargement; at 1 the built-in objects measure 10 to 25 cm.")
    centre: bool = Field(False, description="The middle of the mesh's bounding box is the origin that its poses are of.")
    reflectance: float = Field(0.6, gt=0, le=1, description="Share of light that an object without texture gives back.")
    gloss: float = Field(0.08, ge=0, le=2, description="Strength of the highlight.")
    motion: MotionConfig = Field(default_factory=MotionConfig, description="Mean pose and swing.")
    attached_to: str | None = Field(None, description="Label of an object that carries it along, as it does fingers: its motion is relative to that.")

    @model_validator(mode="after")
    def _one_model(self) -> "ObjectConfig":
        if (self.shape is None) == (self.mesh is None):
            raise ValueError("give either shape or mesh, exactly one of them")
        if self.shape is not None and not 0.05 < self.scale <= 20:
            raise ValueError(f"scale: a built-in object is enlarged by 0.05 to 20; got {self.scale:g}")
        return self

    def build(self) -> Model:
        """The parts of its mesh, in metres, each with a texture of its own.

        Raises:
            MissingFileError, UnknownFormatError, ModelError: if there is something wrong with the mesh file.
        """
        if self.mesh is None:
            return (make_mesh(str(self.shape), self.scale),)
        parts = load_parts(self.mesh)
        points = np.concatenate([part.vertices for part in parts])
        factor, origin = Placement(self.unit, self.scale, self.centre).metres(points, self.label)
        for part in parts:
            place_part(part, factor, origin)
        return tuple(parts)


class LightConfig(Settings):
    """How the light changes over time; its direction and strength at first are settings of ``render``."""

    turn_deg_s: float = Field(0, ge=-36_000, le=36_000, description="How fast the light goes round the scene, degrees per second.")
    turn_axis: tuple[float, float, float] = Field((0.0, 1.0, 0.0), description="Axis that it goes round, world frame.")
    flicker_hz: float = Field(0, ge=0, le=2000, description="Frequency of a flicker, Hz; a lamp on 50 Hz mains flickers at 100.")
    flicker_depth: float = Field(0, ge=0, lt=1, description="Its depth: brightness swings between 1 less and 1 plus this.")


class SceneConfig(Settings):
    """A scene to simulate."""

    name: str = Field("scene", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$", description="Name, also in file names.")
    objects: tuple[ObjectConfig, ...] = Field(min_length=1, description="What moves, and is tracked.")
    occluders: tuple[ObjectConfig, ...] = Field((), description="What moves too, and is not tracked.")
    camera: CameraConfig = Field(default_factory=CameraConfig, description="The camera.")
    camera_motion: CameraMotionConfig | None = Field(None, description="How the camera moves; at rest when not given.")
    duration_s: float = Field(1.0, gt=0, le=600, description="Duration, s.")
    speed: float = Field(1.0, ge=0, le=20, description="Multiplies every velocity.")
    peak_speed: Literal["slow", "normal", "fast"] | float | None = Field(
        None,
        description="Largest speed of any point of an object in the image, px/s (slow: 250, normal: 750, fast: 2250); "
        "objects and camera are sped up or slowed down to reach it, and speed must be 1.",
    )
    noise: Literal["ideal", "default", "realistic"] = Field(
        "default", description="Event camera profile: no imperfection, those of a good sensor, or those of a sensor in poor light."
    )
    event_camera: EventCameraConfig | None = Field(None, description="Event camera parameters, instead of a profile.")
    background: BackgroundConfig = Field(default_factory=BackgroundConfig, description="What is behind the objects.")
    light: LightConfig = Field(default_factory=LightConfig, description="How the light changes.")
    render: RenderConfig = Field(default_factory=RenderConfig, description="Light and sampling.")
    seed: int = Field(0, ge=0, le=2**31, description="Of motions, thresholds and noise.")
    # A scene is the same whatever its files were allowed to be: left out of what is compared and written.
    limits: Limits = Field(default_factory=current_limits, exclude=True, description="How large files may be.")
    max_motion_px: float = Field(0.5, gt=0.01, le=2, description="Furthest way of any vertex between two frames, pixels.")
    variants: dict[str, dict[str, Any]] = Field({}, description="By name: settings that differ; each variant is a scene NAME_VARIANT.")
    variant: str | None = Field(None, description="The variant to take; by default what is given outside of all.")

    @model_validator(mode="before")
    @classmethod
    def _of_variant(cls, values: Any) -> Any:
        """Lay the chosen variant over the rest; what remains is a scene without variants."""
        if not isinstance(values, dict) or not isinstance(variants := values.get("variants") or {}, dict):
            return values
        name, rest = values.get("variant"), {key: value for key, value in values.items() if key not in ("variant", "variants")}
        if name is None:
            return rest
        if not isinstance(name, str) or not isinstance(variants.get(name), dict):
            raise ValueError(f"variant: there is none called '{name}' ({', '.join(map(str, variants)) or 'the scene has none'})")
        return {**merged(rest, variants[name]), "name": f"{rest.get('name', 'scene')}_{name}"}

    @model_validator(mode="after")
    def _consistent(self) -> "SceneConfig":
        labels = [item.label for item in (*self.objects, *self.occluders)]
        if len(set(labels)) != len(labels):
            raise ValueError(f"labels must differ, got {', '.join(labels)}")
        carriers = {item.label for item in self.objects if item.attached_to is None}
        for item in (*self.objects, *self.occluders):
            if item.attached_to is not None and item.attached_to not in carriers:
                raise ValueError(
                    f"attached_to: '{item.label}' cannot be carried by '{item.attached_to}'; name one of the objects that are not attached themselves"
                    f" ({', '.join(sorted(carriers)) or 'there is none'})"
                )
        if isinstance(self.peak_speed, float) and not 1 <= self.peak_speed <= 20_000:
            raise ValueError(f"peak_speed must be between 1 and 20000 px/s, got {self.peak_speed}")
        if self.peak_speed is not None and self.speed != 1:
            raise ValueError("give speed or peak_speed, not both")
        return self

    @property
    def peak_speed_px_s(self) -> float | None:
        """The largest speed asked for, px/s."""
        return SPEEDS_PX_S[self.peak_speed] if isinstance(self.peak_speed, str) else self.peak_speed

    @property
    def event_camera_config(self) -> EventCameraConfig:
        """The event camera's parameters: those given, else those of the profile."""
        return self.event_camera or EVENT_CAMERA_PROFILES[self.noise]
