"""Settings of what is behind the objects."""

from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from pydantic import Field

from torchtrack.config.settings import ConfigPath, Settings
from torchtrack.core.camera import Camera
from torchtrack.errors import MissingFileError, UnknownFormatError
from torchtrack.sim.backdrop import Backdrop, Placement, at_infinity, on_sensor, on_wall
from torchtrack.sim.render import plain_background
from torchtrack.sim.surface import grey_reflectance
from torchtrack.sim.textures import clutter

# Luminance below which contrast is not changed: black has no logarithm.
_DARKEST = 1e-3
# Grey values of an 8-bit image as colours, for one table of linear light.
_ALL_GREYS = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)


class BackgroundConfig(Settings):
    """What is behind the objects: plain, messy, or an image."""

    kind: Literal["plain", "messy"] = Field("plain", description="Even, or a messy picture of polygons, lines, discs and words.")
    luminance: float = Field(0.1, ge=0, le=1, description="Of a plain background, linear in light: 1 is white.")
    image: ConfigPath | None = Field(None, description="An image instead.")
    brightness: float = Field(1.0, gt=0, le=1, description="Dims a messy background or an image.")
    contrast: float = Field(1.0, ge=0, le=2, description="Of a messy background or an image, in log luminance about its mean: 0 is even.")
    blur_px: float = Field(0.6, ge=0, le=20, description="Standard deviation of its blur, pixels; one below 0.5 flickers when it moves.")
    projection: Literal["screen", "wall", "panorama"] = Field(
        "screen", description="Fixed before the sensor; on a wall that stands in the world; or at infinity all around (an equirectangular image)."
    )
    distance_m: float = Field(2.0, gt=0.05, le=100, description="Distance of the wall from the camera at first, m.")
    pan_px_s: tuple[float, float] = Field((0.0, 0.0), description="How fast the picture slides right and down, px/s.")
    seed: int = Field(0, ge=0, le=2**31, description="Of a messy picture.")

    @property
    def is_even(self) -> bool:
        """Whether it is the same everywhere, so that it cannot be seen to move."""
        return self.kind == "plain" and self.image is None

    def moves(self, camera_moves: bool) -> bool:
        """Whether it moves in the image."""
        return not self.is_even and (any(self.pan_px_s) or (camera_moves and self.projection != "screen"))

    def build(self, camera: Camera) -> Backdrop:
        """The picture at its place.

        Raises:
            MissingFileError: if the image is not there.
            UnknownFormatError: if it cannot be read as an image.
        """
        width, height = self._picture_size(camera)
        picture = self.picture(width, height)
        if self.blur_px and not self.is_even:
            picture = cv2.GaussianBlur(picture, (0, 0), self.blur_px, borderType=cv2.BORDER_REFLECT_101)
        centre = ((width - 1) / 2, (height - 1) / 2)
        return Backdrop(
            picture, camera, self._placement(camera, centre), self.projection == "screen", self.pan_px_s, wraps=self.projection == "panorama"
        )

    def picture(self, width: int, height: int) -> Float[ndarray, "h w"]:
        """Luminance of every texel, linear in light.

        Raises:
            MissingFileError: if the image is not there.
            UnknownFormatError: if it cannot be read as an image.
        """
        if self.image is not None:
            return self._toned(_read_linear(self.image, width, height))
        if self.kind == "plain":
            return plain_background(width, height, self.luminance)
        linear = grey_reflectance(_ALL_GREYS).astype(np.float32)
        half = clutter(height, (width + 1) // 2 if self.projection == "panorama" else width, self.seed)
        grey = np.concatenate([half, half[:, ::-1]], 1)[:, :width] if self.projection == "panorama" else half
        # The seams of the mirrored halves come to lie at the sides.
        grey = np.roll(grey, width // 4, axis=1) if self.projection == "panorama" else grey
        return self._toned(linear[grey])

    def _toned(self, luminance: Float[ndarray, "h w"]) -> Float[ndarray, "h w"]:
        """With the brightness and the contrast asked for."""
        if self.contrast != 1:
            level = np.log(np.maximum(luminance, _DARKEST))
            luminance = np.exp(level.mean() + self.contrast * (level - level.mean())).clip(max=1)
        return (self.brightness * luminance).astype(np.float32)

    def _picture_size(self, camera: Camera) -> tuple[int, int]:
        """Width and height of the picture, texels: one per pixel, and enough to look around."""
        if self.is_even or self.projection == "screen":
            return camera.width, camera.height
        if self.projection == "wall":
            return 2 * camera.width, 2 * camera.height
        return round(2 * np.pi * camera.fx), round(np.pi * camera.fx)

    def _placement(self, camera: Camera, centre: tuple[float, float]) -> Placement:
        if self.projection == "wall":
            return on_wall(self.distance_m, camera.fx / self.distance_m, centre)
        return at_infinity(camera.fx, centre) if self.projection == "panorama" else on_sensor(camera)


def _read_linear(path: ConfigPath, width: int, height: int) -> Float[ndarray, "h w"]:
    """An image stretched to a size, linear in light."""
    if not path.is_file():
        raise MissingFileError(f"the background image '{path}' does not exist.")
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise UnknownFormatError(f"'{path}' cannot be read as an image. Use PNG or JPEG.")
    linear = grey_reflectance(image[..., ::-1]).astype(np.float32)
    return cv2.resize(linear, (width, height), interpolation=cv2.INTER_AREA)
