"""Rotations that bring an object onto itself: how many there are of known shapes, and how poses are compared with them left aside."""

import math

import pytest
import torch
import trimesh
from solid_models import l_prism

from torchtrack.core.lie import so3_exp
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.rotational_symmetry import rotation_group


@pytest.mark.parametrize(
    ("mesh", "count"),
    [
        (trimesh.creation.box((0.12, 0.1, 0.06)), 4),
        (trimesh.creation.box((0.1, 0.1, 0.06)), 8),
        (trimesh.creation.box((0.1, 0.1, 0.1)), 24),
        (trimesh.creation.box((0.12, 0.1, 0.06)).apply_translation((0.3, 0, 0)), 4),
        (trimesh.creation.cylinder(0.03, 0.1, sections=64), 144),
    ],
    ids=["box", "square box", "cube", "box off its origin", "cylinder"],
)
def test_rotations_of_known_shapes(mesh, count):
    group = rotation_group(ObjectModel.from_mesh(mesh))
    assert len(group.rotations) == count
    assert torch.allclose(group.rotations.mT @ group.rotations, torch.eye(3, dtype=torch.float64).expand(count, 3, 3), atol=1e-9)


def test_an_l_can_be_rotated_about_its_own_diagonal_alone():
    group = rotation_group(ObjectModel.from_mesh(l_prism()))
    assert len(group.rotations) == 2
    half = group.rotations[1]
    assert float(half.trace()) == pytest.approx(-1, abs=1e-6)
    axis = torch.linalg.eigh(half + half.mT).eigenvectors[:, -1].abs()
    assert torch.allclose(axis, torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64) / math.sqrt(2), atol=0.02)


def test_polylines_have_none():
    square = [[[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0, 0, 0]]]
    group = rotation_group(ObjectModel.from_polylines(square))
    assert torch.equal(group.rotations, torch.eye(3, dtype=torch.float64)[None])


def test_angles_leave_the_rotations_of_the_object_aside():
    group = rotation_group(ObjectModel.from_mesh(trimesh.creation.box((0.1, 0.1, 0.06))))
    about_z = so3_exp(torch.tensor([[0, 0, math.radians(angle)] for angle in (0.0, 10.0, 90.0, 135.0)], dtype=torch.float64))
    angles = group.angles_deg(about_z, about_z[:1])
    assert torch.allclose(angles[:, 0], torch.tensor([0.0, 10.0, 0.0, 45.0], dtype=torch.float64), atol=1e-4)
