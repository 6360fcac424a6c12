"""Drawing with the numba kernels (extra ``sim``)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from torchtrack.sim import rasterizer, shading
from torchtrack.sim.drawing import Light, Picture, Region, sample_offsets
from torchtrack.sim.surface import Scene


class RasterDrawer:
    """A z-buffer rasteriser on one core.

    Args:
        scene: what to draw.
        intrinsics: ``fx, fy, cx, cy``.
        near_m: surfaces nearer than this are not drawn.
        supersampling: samples per pixel along each axis.
    """

    def __init__(self, scene: Scene, intrinsics: tuple[float, float, float, float], near_m: float, supersampling: int) -> None:
        self._scene, self._offsets = scene, sample_offsets(supersampling)
        self._intrinsics = np.array([*intrinsics, near_m])
        count, normals = len(scene.corners), np.empty(scene.normals.shape, np.float32)
        self._faces = rasterizer.Faces(np.empty_like(scene.corners), normals, np.empty(count, np.bool_), np.zeros((count, 3, 3)))
        self._surface = shading.Surface(self._faces, **scene.look)
        self._buffers = np.empty(0, np.float32), np.empty(0, np.int32)

    def place(self, T_cam_obj: Float[ndarray, "o 4 4"], light: Light) -> list[Float[ndarray, "_ 3"]]:
        """Set poses and light for the next image; returns corners of every object in the camera frame."""
        scene = self._scene
        rasterizer.place(scene.corners, scene.normals, scene.look["face_object"], T_cam_obj, scene.is_closed, self._faces)
        self._lighting = shading.Lighting(light.ambient, light.diffuse, light.unit)
        return [self._faces.corners[faces].reshape(-1, 3) for faces in scene.object_faces]

    def draw(self, region: Region, numbers: Sequence[int], picture: Picture) -> None:
        """Draw some of the objects into one region, over the background that its picture holds."""
        ranges = np.array([[self._scene.object_faces[number].start, self._scene.object_faces[number].stop] for number in numbers])
        samples = self._samples(picture.luminance.shape)
        view = rasterizer.View(self._intrinsics, np.array([region.left, region.top], dtype=np.float64), self._offsets)
        rasterizer.draw(self._faces, ranges, view, samples)
        shading.shade(samples, self._surface, self._lighting, view, picture)

    def _samples(self, shape: tuple[int, ...]) -> rasterizer.Samples:
        """Room for the samples of a region, the same every time: new memory would cost more than the drawing."""
        count = len(self._offsets) * shape[0] * shape[1]
        if count > len(self._buffers[0]):
            self._buffers = np.empty(count, np.float32), np.empty(count, np.int32)
        return rasterizer.Samples(*(buffer[:count].reshape(*shape, len(self._offsets)) for buffer in self._buffers))
