"""The arrays of a sequence in ``.npz`` form, apart from its events."""

import json
from collections.abc import Sequence as ListOf
from typing import Any

import numpy as np
import torch

from torchtrack.core.camera import Camera
from torchtrack.errors import PoseError
from torchtrack.io.sequence_types import Sequence
from torchtrack.io.trajectory import Trajectory


def sequence_arrays(sequence: Sequence, stem: str) -> dict[str, Any]:
    """Camera, names, true poses and all else of a sequence that is to be called ``stem``."""
    truth = [obj.ground_truth for obj in sequence.objects]
    known = [trajectory for trajectory in truth if trajectory is not None]
    if known and len(known) != len(truth):
        raise PoseError("this form has true poses for all objects or for none. Keep the sequence in HDF5.")
    return {
        "K": sequence.camera.matrix,
        **distortion_arrays(sequence.camera),
        **(pose_arrays(known) if known else {}),
        "labels": np.array([obj.label for obj in sequence.objects]),
        "mesh_files": np.array([f"{stem}_{obj.label}{obj.mesh_path.suffix}" for obj in sequence.objects]),
        "meta": np.array(json.dumps(sequence.meta)),
        **sequence.extra,
    }


def distortion_arrays(camera: Camera) -> dict[str, np.ndarray]:
    """Model and coefficients of the lens; nothing where it has no distortion."""
    if camera.distortion_model == "none":
        return {}
    return {"distortion_model": np.array(camera.distortion_model), "distortion": np.array(camera.distortion, dtype=np.float64)}


def pose_arrays(trajectories: ListOf[Trajectory]) -> dict[str, np.ndarray]:
    """True poses, one trajectory per object.

    Raises:
        PoseError: if they do not share their times.
    """
    t_us = trajectories[0].t_us
    if any(not torch.equal(trajectory.t_us, t_us) for trajectory in trajectories):
        raise PoseError("the trajectories of a sequence must share their times. Resample them with Trajectory.at().")
    poses = np.stack([trajectory.T_cam_obj.cpu().numpy() for trajectory in trajectories])
    return {"poses": poses[0] if len(poses) == 1 else poses, "pose_t": t_us.cpu().numpy()}
