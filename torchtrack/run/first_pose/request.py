"""What a first pose is asked for with: the settings of a run and one of its objects, whose initial pose is not known yet."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.config.load import load, read_yaml
from torchtrack.config.run import ObjectConfig, PoseConfig, RunConfig
from torchtrack.config.settings import Settings
from torchtrack.core.camera import Camera, undistort
from torchtrack.core.lie import quaternion_from_rotation
from torchtrack.core.pose_checks import check_pose
from torchtrack.errors import ConfigError
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.settings import METRES_PER_UNIT
from torchtrack.run.first_pose.picks import Picks
from torchtrack.run.first_pose.start import Box
from torchtrack.run.initial_pose import configured_pose
from torchtrack.run.session import Session, open_session

# Stands for the pose that is asked for while everything else of a run is opened; nothing looks at it.
_NOT_KNOWN = PoseConfig(translation_m=(0.0, 0.0, 1.0))


class PoseFile(Settings):
    """What ``torchtrack pose`` writes: the pose of one object, to be put into a config of ``torchtrack track``."""

    initial_pose: PoseConfig


def object_of(config: RunConfig, label: str | None) -> ObjectConfig:
    """The object of a run that a pose is asked for: by its label, or the only one.

    Raises:
        ConfigError: if there is none, or are several and no label says which.
    """
    labels = [obj.label for obj in config.objects]
    if label is None and len(labels) != 1:
        known = f"there are {', '.join(labels)}: say which, with --label" if labels else "none is configured: give --mesh"
        raise ConfigError(f"objects: a first pose is of one object, and {known}.")
    if label is not None and label not in labels:
        raise ConfigError(f"objects: there is no '{label}'; there are {', '.join(labels)}.")
    return config.objects[labels.index(label) if label is not None else 0]


def opened(config: RunConfig, obj: ObjectConfig) -> Session:
    """Events, camera and model of a run, for one of its objects.

    Raises:
        TorchtrackError: of the kind that fits, if a file, model or camera is missing or wrong, or there are no events.
    """
    alone = obj.model_copy(update={"initial_pose": _NOT_KNOWN})
    return open_session(config.model_copy(update={"objects": (alone,)}))


def known_pose(obj: ObjectConfig, start_us: int) -> Float[Tensor, "4 4"] | None:
    """The pose (float64) that an object is configured with; None where it has none.

    Raises:
        PoseError: if it is no rigid motion.
    """
    if obj.initial_pose is None:
        return None
    T = configured_pose(obj.initial_pose, start_us)
    check_pose(T, f"initial_pose of '{obj.label}'")
    return T


def read_near(path: Path, label: str | None, start_us: int) -> Float[Tensor, "4 4"]:
    """The pose (float64) in a file that ``torchtrack pose`` wrote, or of an object of a config.

    Raises:
        MissingFileError, ConfigError: if it is not there, or has none.
        PoseError: if it is no rigid motion.
    """
    if "objects" in read_yaml(path):
        pose = object_of(load(RunConfig, path), label).initial_pose
        if pose is None:
            raise ConfigError(f"{path}: the object has no initial_pose to look near. Search for it with --search instead.")
    else:
        pose = load(PoseFile, path).initial_pose
    T = configured_pose(pose, start_us)
    check_pose(T, f"initial_pose in {path}")
    return T


def placed_picks(picks: Picks, obj: ObjectConfig) -> Picks:
    """Picks in the numbers of an object's model file, in metres in the object's frame."""
    metres = METRES_PER_UNIT[obj.unit] * obj.scale
    if not obj.centre:
        return picks.scaled(metres, np.zeros(3))
    path = obj.mesh or obj.polylines
    if path is None:
        raise ConfigError("objects: centre is of a mesh or polylines given here.")
    # In the file's own frame: where the middle of the model is says where the origin went.
    as_in_file = ObjectModel.from_file(path, name=obj.label, unit=obj.unit, scale=obj.scale)
    return picks.scaled(metres, as_in_file.centre.double().numpy())


def parsed_box(text: str, camera: Camera) -> Box:
    """The box of ``u0,v0,u1,v1`` in sensor pixels, as one of ideal pixels.

    Raises:
        ConfigError: if these are not the left, top, right and bottom side of a part of the image.
    """
    try:
        u0, v0, u1, v1 = (float(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(f"--box: expected left, top, right and bottom side in pixels, as in --box 100,80,260,220, got '{text}'.") from None
    inside = max(u0, 0) + 2 < min(u1, camera.width - 1) and max(v0, 0) + 2 < min(v1, camera.height - 1)
    if not inside:
        size = f"{camera.width}x{camera.height}"
        raise ConfigError(f"--box: {text} is no part of the image of {size}; expected left,top,right,bottom, some pixels apart.")
    u, v = np.linspace(u0, u1, 9), np.linspace(v0, v1, 9)
    border = [np.stack([u, np.full(9, end)], 1) for end in (v0, v1)] + [np.stack([np.full(9, end), v], 1) for end in (u0, u1)]
    return Box.around(torch.from_numpy(undistort(np.concatenate(border), camera)).float())


def as_block(T_cam_obj: Float[Tensor, "4 4"], label: str, at_us: int) -> str:
    """A pose as the ``initial_pose:`` block of an object in a config of ``torchtrack track``."""
    quaternion = quaternion_from_rotation(T_cam_obj[:3, :3])
    place, turn = (", ".join(f"{value:.9g}" for value in values.tolist()) for values in (T_cam_obj[:3, 3], quaternion / quaternion.norm()))
    return f"# T_cam_obj of '{label}' at start_us: {at_us}\ninitial_pose:\n  translation_m: [{place}]\n  quaternion_xyzw: [{turn}]\n"
