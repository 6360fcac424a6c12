"""A bracket that moves before a camera: a sequence of its events, its mesh in mm, and where it is at a time."""

from pathlib import Path

import torch
from solid_models import l_prism
from tiny_sequence import CAMERA, box_events, true_poses

from torchtrack.io import LabelledMesh, Trajectory, write_sequence
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.rotational_symmetry import rotation_group

AT_US = 20_000


def write_bracket(folder: Path) -> torch.Tensor:
    """``bracket.npz`` and ``in_mm.stl`` in a folder; gives the pose at ``AT_US``."""
    mesh, trajectory = l_prism(), true_poses(120_000, step_us=250)
    write_sequence(folder / "bracket.npz", box_events(mesh, trajectory), CAMERA, [LabelledMesh("bracket", mesh, trajectory)])
    mesh.copy().apply_scale(1000).export(folder / "in_mm.stl")
    return pose_at(trajectory, AT_US)


def pose_at(trajectory: Trajectory, t_us: int) -> torch.Tensor:
    return trajectory.at(torch.tensor([t_us]))[0]


def error_deg(T: torch.Tensor, truth: torch.Tensor) -> float:
    """How far a pose is turned from the true one, with the rotations of the bracket left aside."""
    group = rotation_group(ObjectModel.from_mesh(l_prism()))
    return float(group.angles_deg(T[None, :3, :3], truth[None, :3, :3]))
