"""Renderer of known rigid objects: meshes at poses in, luminance, depth and object indices out (extra ``sim``).

::

    objects = [RenderObject.from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)))]
    renderer = Renderer(objects, Camera(600, 600, 319.5, 239.5, 640, 480), plain_background(640, 480, 0.2))
    frame = renderer.render(T_cam_obj)        # [objects, 4, 4] -> frame.luminance [480, 640], linear in light

Conventions of :mod:`torchtrack.core.camera`: pixel ``i`` gathers the light between ``i - 0.5`` and ``i + 0.5``. Luminance is
linear in light: 1 is a white surface that faces the light. Lens distortion is not drawn: images are ideal.

Samples lie in a canonical multi-jittered arrangement (Chiu, Shirley & Wang 1994; Kensler 2013): ``n x n`` samples fall into
``n²`` different columns and rows, so an edge along the pixel grid moves in steps of ``1/n²`` pixel. On a regular grid it would
move in steps of ``1/n``, and the events of a slow upright edge would come in bursts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from pydantic import Field
from torch import Tensor

from torchtrack.config.settings import Settings
from torchtrack.core.camera import Camera
from torchtrack.errors import CalibrationError, MissingExtraError, ModelError, PoseError
from torchtrack.sim.drawing import Drawer, Light, Picture, Region, merge_regions
from torchtrack.sim.surface import Parts, merge_objects

# The blur's weights beyond this many standard deviations are below 1e-4.
_BLUR_REACH = 4.0


class RenderConfig(Settings):
    """How a scene is lit and sampled."""

    backend: Literal["rasterizer", "opengl"] = Field("rasterizer", description="What draws: numba (extra sim), or OpenGL through EGL (extra gl).")
    supersampling: int = Field(4, ge=1, le=8, description="Samples per pixel along each axis.")
    lens_blur_px: float = Field(0.4, ge=0, le=5, description="Standard deviation of the lens blur, pixels.")
    near_m: float = Field(0.01, gt=0, description="Surfaces nearer than this are not drawn, m.")
    light_direction: tuple[float, float, float] = Field((-0.4, -0.7, -0.6), description="Direction towards the light, world frame.")
    ambient: float = Field(0.35, ge=0, le=1, description="Share of light that comes from everywhere.")
    diffuse: float = Field(0.65, ge=0, le=1, description="Share of light that comes from the light's direction.")


@dataclass(frozen=True)
class Frame:
    """A rendered image.

    Args:
        luminance: linear in light, 1 is white.
        depth: z of the surface at the pixel's centre, m; infinite on the background.
        object_index: which object holds most of the pixel; -1 on the background.
        regions: rectangles outside of which there is background alone.
    """

    luminance: Float[ndarray, "h w"]
    depth: Float[ndarray, "h w"]
    object_index: Int[ndarray, "h w"]
    regions: tuple[Region, ...]


@dataclass(frozen=True)
class Scenery:
    """What may differ from image to image beside the poses.

    Args:
        background: luminance, linear; None for that of the renderer.
        light_direction: towards the light, camera frame; None for that of the config.
        brightness: multiplies all light.
    """

    background: Float[ndarray, "h w"] | None = None
    light_direction: tuple[float, float, float] | None = None
    brightness: float = 1.0


def blurred(image: Float[ndarray, "h w"], sigma_px: float) -> Float[ndarray, "h w"]:
    """The image as a lens that is not quite sharp shows it."""
    size = 2 * _blur_radius(sigma_px) + 1
    return cv2.GaussianBlur(image, (size, size), sigma_px, borderType=cv2.BORDER_REPLICATE) if sigma_px > 0 else image


def _blur_radius(sigma_px: float) -> int:
    return int(np.ceil(_BLUR_REACH * sigma_px))


def plain_background(width: int, height: int, luminance: float) -> Float[ndarray, "h w"]:
    """An even background."""
    return np.full((height, width), luminance, dtype=np.float32)


class Renderer:
    """Draws a fixed set of objects before a fixed background.

    Args:
        objects: what to draw; one may have parts with a texture each.
        camera: pinhole camera without distortion.
        background: luminance ``[H, W]``, linear, finite and not negative.
        config: light and sampling.

    Raises:
        MissingExtraError: if what should draw is not installed.
        CalibrationError: if the camera has distortion, or the background's size is not the sensor's.
        ModelError: if there is no object.
    """

    def __init__(
        self,
        objects: Sequence[Parts],
        camera: Camera,
        background: Float[ndarray, "h w"],
        config: RenderConfig | None = None,
    ) -> None:
        self.camera, self.config = camera, config or RenderConfig()
        _check_inputs(objects, camera, background)
        self._drawer, self._objects = make_drawer(objects, camera, self.config), len(objects)
        self._first_background = np.ascontiguousarray(background, dtype=np.float32)
        self._sharp_background = self._first_background
        self._background = self._blur(self._sharp_background)

    def render(self, T_cam_obj: Float[ndarray, "o 4 4"] | Float[Tensor, "o 4 4"], scenery: Scenery | None = None) -> Frame:
        """One image of all objects at their poses; parts behind the camera or outside the image are left out.

        Args:
            T_cam_obj: one pose per object.
            scenery: what differs from the background and light that the renderer was made with.

        Raises:
            PoseError: if there is not one pose per object, or one is not finite.
        """
        T_cam_obj, scenery = np.asarray(T_cam_obj, dtype=np.float64), scenery or Scenery()
        _check_poses(T_cam_obj, self._objects)
        self._set_background(self._first_background if scenery.background is None else scenery.background)
        light = Light(self.config.ambient, self.config.diffuse, scenery.light_direction or self.config.light_direction)
        boxes = [self._box(corners) for corners in self._drawer.place(T_cam_obj, light)]
        regions = merge_regions([box for box in boxes if box is not None])
        luminance = self._background.copy()
        depth = np.full(luminance.shape, np.inf, dtype=np.float32)
        object_index = np.full(luminance.shape, -1, dtype=np.int16)
        for region in regions:
            inside = [number for number, box in enumerate(boxes) if box is not None and box.overlaps(region)]
            sharp = self._sharp_background[region.slices].copy()
            self._drawer.draw(region, inside, Picture(sharp, depth[region.slices], object_index[region.slices]))
            luminance[region.slices] = self._blurred_region(sharp, region)
        if scenery.brightness != 1:
            luminance *= np.float32(scenery.brightness)
        return Frame(luminance, depth, object_index, regions)

    def _set_background(self, background: Float[ndarray, "h w"]) -> None:
        """The background of the next image."""
        if background is not self._sharp_background:
            self._sharp_background, self._background = background, self._blur(background)

    @property
    def _blur_radius(self) -> int:
        return _blur_radius(self.config.lens_blur_px)

    def _blur(self, image: Float[ndarray, "h w"]) -> Float[ndarray, "h w"]:
        return blurred(image, self.config.lens_blur_px)

    def _blurred_region(self, sharp: Float[ndarray, "h w"], region: Region) -> Float[ndarray, "h w"]:
        """The rectangle as it looks in the blurred whole: near its inner borders there is background alone."""
        blurred, radius = self._blur(sharp), self._blur_radius
        result = self._background[region.slices].copy()
        top, left = (0 if start == 0 else radius for start in (region.top, region.left))
        bottom = sharp.shape[0] - (0 if region.bottom == self.camera.height else radius)
        right = sharp.shape[1] - (0 if region.right == self.camera.width else radius)
        result[top:bottom, left:right] = blurred[top:bottom, left:right]
        return result

    def _box(self, corners: Float[ndarray, "n 3"]) -> Region | None:
        """Pixels that an object can touch, blur included; the whole image where it reaches through the camera plane."""
        width, height = self.camera.width, self.camera.height
        depth = corners[..., 2]
        if not (depth > self.config.near_m).any():
            return None
        if (depth < self.config.near_m).any():
            return Region(0, height, 0, width)
        camera = self.camera
        u, v = corners[..., 0] / depth * camera.fx + camera.cx, corners[..., 1] / depth * camera.fy + camera.cy
        # The pixel that a point falls into, then the blur of its light, then what that blur sees.
        margin = 2 * self._blur_radius + 1
        top, left = np.clip(np.floor([v.min(), u.min()]) - margin, 0, [height, width]).astype(int).tolist()
        bottom, right = np.clip(np.ceil([v.max(), u.max()]) + margin + 1, 0, [height, width]).astype(int).tolist()
        return Region(top, bottom, left, right) if top < bottom and left < right else None


def _check_inputs(objects: Sequence[Parts], camera: Camera, background: ndarray) -> None:
    if not objects:
        raise ModelError("a renderer needs at least one object, got none.")
    if camera.distortion_model != "none":
        raise CalibrationError(f"the renderer draws ideal pinhole images, got a camera with '{camera.distortion_model}' distortion. Leave it out.")
    if background.shape != (camera.height, camera.width):
        raise CalibrationError(
            f"the background must have the sensor's size {camera.width}x{camera.height}, got {background.shape[1]}x{background.shape[0]}."
        )
    if not np.isfinite(background).all() or (background < 0).any():
        raise CalibrationError("the background's luminance must be finite and not negative.")


def _check_poses(T_cam_obj: ndarray, objects: int) -> None:
    if T_cam_obj.shape != (objects, 4, 4) or not np.isfinite(T_cam_obj).all():
        raise PoseError(f"the renderer needs one finite pose per object, [{objects}, 4, 4]; got shape {list(T_cam_obj.shape)}.")


def make_drawer(objects: Sequence[Parts], camera: Camera, config: RenderConfig) -> Drawer:
    """The one that the config asks for; each loads its library only when asked for.

    Raises:
        MissingExtraError: if that is not installed, or finds no OpenGL.
    """
    scene, intrinsics = merge_objects(objects), (camera.fx, camera.fy, camera.cx, camera.cy)
    if config.backend == "opengl":
        try:
            from torchtrack.sim.opengl_drawer import OpenGLDrawer
        except ImportError as error:
            raise MissingExtraError("moderngl", "gl", "Rendering simulated scenes with OpenGL") from error
        return OpenGLDrawer(scene, intrinsics, config.near_m, config.supersampling)
    try:
        from torchtrack.sim.raster_drawer import RasterDrawer
    except ImportError as error:
        raise MissingExtraError("numba", "sim", "Rendering simulated scenes") from error
    return RasterDrawer(scene, intrinsics, config.near_m, config.supersampling)
