"""What a tracker is made from and starts with is checked before anything is computed."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import lie
from torchtrack.core.camera import MIN_DEPTH_M, Camera
from torchtrack.errors import ModelError, PoseError
from torchtrack.object_model import ObjectModel


def check_setup(objects: Sequence[ObjectModel], cameras: Sequence[Camera], streams: Sequence[int], config: TrackerConfig) -> None:
    """Raise ``ValueError`` unless objects, cameras and streams fit together, and ``ModelError`` for a model without contours."""
    if not objects:
        raise ValueError("a tracker needs at least one object.")
    if len(streams) != len(objects):
        raise ValueError(f"stream_index needs one entry per object: got {len(streams)} for {len(objects)} objects.")
    if not all(0 <= s < len(cameras) for s in streams):
        raise ValueError(f"stream_index must be within the {len(cameras)} cameras given (one per stream), got {streams}.")
    for model in objects:
        if config.contours.source == "splat" and len(model.surface_points) == 0:
            raise ModelError(
                f"'{model.name}' has no surface to take splatted contours from: give a mesh, or set contours.source to 'mesh', which takes polylines."
            )


def check_poses(T_cam_obj: Tensor, centre_obj: Float[Tensor, "b 3"], names: Sequence[str]) -> None:
    """Raise ``PoseError`` unless there is a rigid motion for every object that puts it before the camera.

    Args:
        T_cam_obj: initial poses, or what was given for them.
        centre_obj: centre of each object (m).
        names: of the objects.
    """
    T_cam_obj = T_cam_obj.detach()
    lie.check_pose(T_cam_obj)
    if T_cam_obj.shape != (len(centre_obj), 4, 4):
        raise PoseError(f"expected one initial pose per object, shape {[len(centre_obj), 4, 4]}, got {list(T_cam_obj.shape)}.")
    depth = lie.transform_points(T_cam_obj, centre_obj.to(T_cam_obj.dtype)[:, None])[:, 0, 2]
    for name, z in zip(names, depth.tolist(), strict=True):
        if z < MIN_DEPTH_M:
            raise PoseError(f"object '{name}' is behind the camera (depth {z:.3f} m): the z axis must point from the camera to the scene.")
