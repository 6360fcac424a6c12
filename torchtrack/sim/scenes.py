"""Settings of a simulated scene: objects that move before a fixed camera."""

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import Field, model_validator

from torchtrack.camera import Camera
from torchtrack.config.settings import ConfigPath, Settings
from torchtrack.errors import MissingFileError, UnknownFormatError
from torchtrack.sim.event_camera import EVENT_CAMERA_PROFILES, EventCameraConfig
from torchtrack.sim.render import RenderConfig, plain_background
from torchtrack.sim.surface import grey_reflectance
from torchtrack.sim.trajectory import MotionConfig


class CameraConfig(Settings):
    """A pinhole camera without distortion."""

    width: int = Field(640, ge=8, le=4096, description="Sensor width, pixels.")
    height: int = Field(480, ge=8, le=4096, description="Sensor height, pixels.")
    fx: float = Field(600.0, gt=0, description="Focal length along x, pixels.")
    fy: float = Field(600.0, gt=0, description="Focal length along y, pixels.")
    cx: float | None = Field(None, description="Principal point, x; the middle of the sensor when not given.")
    cy: float | None = Field(None, description="Principal point, y; the middle of the sensor when not given.")

    def build(self) -> Camera:
        """The camera."""
        cx = self.cx if self.cx is not None else (self.width - 1) / 2
        cy = self.cy if self.cy is not None else (self.height - 1) / 2
        return Camera(self.fx, self.fy, cx, cy, self.width, self.height)


class BackgroundConfig(Settings):
    """What is behind the objects; it does not move."""

    luminance: float = Field(0.1, ge=0, le=1, description="Of a plain background, linear in light: 1 is white.")
    image: ConfigPath | None = Field(None, description="An image instead, stretched to the sensor's size.")

    def build(self, width: int, height: int) -> Float[ndarray, "h w"]:
        """Luminance of every pixel, linear in light.

        Raises:
            MissingFileError: if the image is not there.
            UnknownFormatError: if it cannot be read as an image.
        """
        if self.image is None:
            return plain_background(width, height, self.luminance)
        if not self.image.is_file():
            raise MissingFileError(f"the background image '{self.image}' does not exist.")
        image = cv2.imread(str(self.image), cv2.IMREAD_COLOR)
        if image is None:
            raise UnknownFormatError(f"'{self.image}' cannot be read as an image. Use PNG or JPEG.")
        linear = grey_reflectance(image[..., ::-1]).astype(np.float32)
        return cv2.resize(linear, (width, height), interpolation=cv2.INTER_AREA)


class ObjectConfig(Settings):
    """One object: its shape, its look and its motion."""

    label: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$", description="Name, also in file names.")
    shape: Literal["cube", "lbracket", "satellite", "book"] = Field(description="Which object.")
    scale: float = Field(1.0, gt=0.05, le=20, description="Enlargement; at 1 the objects measure 10 to 25 cm.")
    reflectance: float = Field(0.6, gt=0, le=1, description="Share of light that an object without texture gives back.")
    gloss: float = Field(0.08, ge=0, le=2, description="Strength of the highlight.")
    motion: MotionConfig = Field(default_factory=MotionConfig, description="Mean pose and swing.")


class SceneConfig(Settings):
    """A scene to simulate."""

    name: str = Field("scene", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$", description="Name, also in file names.")
    objects: tuple[ObjectConfig, ...] = Field(min_length=1, description="What moves.")
    camera: CameraConfig = Field(default_factory=CameraConfig, description="The camera.")
    duration_s: float = Field(1.0, gt=0, le=600, description="Duration, s.")
    speed: float = Field(1.0, ge=0, le=20, description="Multiplies the frequency of every motion, and so every velocity.")
    noise: Literal["ideal", "default"] = Field("default", description="Event camera profile: no imperfection, or those of a good sensor.")
    event_camera: EventCameraConfig | None = Field(None, description="Event camera parameters, instead of a profile.")
    background: BackgroundConfig = Field(default_factory=BackgroundConfig, description="What is behind the objects.")
    render: RenderConfig = Field(default_factory=RenderConfig, description="Light and sampling.")
    seed: int = Field(0, ge=0, le=2**31, description="Of motions, thresholds and noise.")
    max_motion_px: float = Field(0.5, gt=0.01, le=2, description="Furthest way of any vertex between two frames, pixels.")

    @model_validator(mode="after")
    def _labels_differ(self) -> "SceneConfig":
        labels = [item.label for item in self.objects]
        if len(set(labels)) != len(labels):
            raise ValueError(f"labels must differ, got {', '.join(labels)}")
        return self

    @property
    def event_camera_config(self) -> EventCameraConfig:
        """The event camera's parameters: those given, else those of the profile."""
        return self.event_camera or EVENT_CAMERA_PROFILES[self.noise]
