"""Drawing with the numba kernels (extra ``sim``)."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from torchtrack.sim import rasterizer, shading
from torchtrack.sim.drawing import Light, Region, sample_offsets
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
        faces = len(scene.corners)
        self._corners, self._normals = np.empty_like(scene.corners), np.empty(scene.normals.shape, np.float32)
        self._is_seen, self._planes = np.empty(faces, np.bool_), np.zeros((faces, 3, 3))
        self._buffers = np.empty(0, np.float32), np.empty(0, np.int32)

    def place(self, T_cam_obj: Float[ndarray, "o 4 4"], light: Light) -> list[Float[ndarray, "_ 3"]]:
        """Set poses and light for the next image; returns corners of every object in the camera frame."""
        scene = self._scene
        rasterizer.place(
            scene.corners, scene.normals, scene.look["face_object"], T_cam_obj, scene.is_closed, self._corners, self._normals, self._is_seen
        )
        self._lighting = shading.Lighting(light.ambient, light.diffuse, light.unit)
        return [self._corners[faces].reshape(-1, 3) for faces in scene.object_faces]

    def draw(
        self,
        region: Region,
        numbers: Sequence[int],
        luminance: Float[ndarray, "rows columns"],
        depth: Float[ndarray, "rows columns"],
        object_index: Int[ndarray, "rows columns"],
    ) -> None:
        """Draw some of the objects into one region, over the background that ``luminance`` holds."""
        ranges = np.array([[self._scene.object_faces[number].start, self._scene.object_faces[number].stop] for number in numbers])
        inverse_depth, face_index = self._samples(luminance.shape)
        origin = np.array([region.left, region.top], dtype=np.float64)
        rasterizer.draw(self._corners, ranges, self._is_seen, self._intrinsics, origin, self._offsets, self._planes, inverse_depth, face_index)
        surface = shading.Surface(normals=self._normals, **self._scene.look)
        shading.shade(
            face_index, inverse_depth, self._planes, self._offsets, surface, self._lighting, self._intrinsics, origin,
            luminance, depth, object_index,
        )  # fmt: skip

    def _samples(self, shape: tuple[int, ...]) -> tuple[ndarray, ndarray]:
        """Room for inverse depth and face index ``[h, w, s]``, the same every time: new memory would cost more than the drawing."""
        count = len(self._offsets) * shape[0] * shape[1]
        if count > len(self._buffers[0]):
            self._buffers = np.empty(count, np.float32), np.empty(count, np.int32)
        inverse_depth, face_index = (buffer[:count].reshape(*shape, len(self._offsets)) for buffer in self._buffers)
        return inverse_depth, face_index
