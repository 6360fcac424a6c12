import math

import pytest
import torch
import trimesh
from helpers import random_pose

from torchtrack.core.lie import se3_exp, so3_exp
from torchtrack.io import Trajectory
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.symmetry import RevolutionAxis, revolution_axis, symmetry_planes, turning_axis
from torchtrack.run.metrics import pose_errors
from torchtrack.sim.curved import vase

SEEN_AXIS = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def axis_of(mesh, **options):
    return revolution_axis(ObjectModel.from_mesh(mesh, **options))


TURNED_SHAPES = {
    "cylinder": trimesh.creation.cylinder(0.03, 0.1, sections=32),
    "cone": trimesh.creation.cone(0.03, 0.1),
    "capsule": trimesh.creation.capsule(0.1, 0.03),
    "ring": trimesh.creation.annulus(0.02, 0.03, 0.01),
    "torus": trimesh.creation.torus(0.05, 0.01),
}


@pytest.mark.parametrize("name", TURNED_SHAPES)
def test_axis_of_a_turned_shape_wherever_it_lies(name):
    moved = TURNED_SHAPES[name].copy()
    T = se3_exp(torch.tensor([0.4, -0.9, 0.3, 0.2, -0.1, 0.3], dtype=torch.float64))
    moved.apply_transform(T.numpy())
    axis = axis_of(moved)
    assert axis is not None
    direction = T[:3, :3] @ SEEN_AXIS
    assert abs(float(axis.direction_obj @ direction)) == pytest.approx(1, abs=1e-6)
    assert float(torch.linalg.cross(axis.point_obj - T[:3, 3], direction).norm()) < 1e-5


def handle(extents_m, x_m, z_m=0.0):
    """A box beside the axis z."""
    box = trimesh.creation.box(extents_m)
    box.apply_translation((x_m, 0, z_m))
    return box


def printed_can():
    can = trimesh.creation.cylinder(0.03, 0.1, sections=32)
    colours = [[255, 255, 255, 255] if x > 0 else [20, 20, 20, 255] for x in can.triangles_center[:, 0]]
    can.visual = trimesh.visual.ColorVisuals(can, face_colors=colours)
    return can


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.box((0.1, 0.1, 0.02)),
        trimesh.creation.cylinder(0.03, 0.1, sections=6),
        trimesh.creation.icosphere(subdivisions=3, radius=0.05),
        trimesh.util.concatenate([trimesh.creation.cylinder(0.03, 0.1, sections=48), handle((0.02, 0.005, 0.03), 0.038)]),
    ],
    ids=["box", "hexagonal prism", "ball", "with a handle"],
)
def test_other_shapes_have_none(mesh):
    assert axis_of(mesh) is None


def test_print_shows_turns():
    assert axis_of(printed_can()) is None


def test_polylines_have_none():
    assert revolution_axis(ObjectModel.from_polylines([[[0.0, 0, 0], [0.1, 0, 0]]])) is None


@pytest.mark.parametrize("shape", [(), (3,), (2, 2)])
def test_turns_about_the_axis_are_undone_and_others_stay(shape):
    axis = RevolutionAxis(torch.tensor([0.01, -0.02, 0.0], dtype=torch.float64), SEEN_AXIS)
    T_true = random_pose(*shape)
    for angle in (1e-4, 2.0, math.pi, -3.0):
        tilt, turn = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
        tilt[:3, :3] = so3_exp(torch.tensor([0.0, 0.05, 0.0], dtype=torch.float64))
        turn[:3, :3] = so3_exp(angle * SEEN_AXIS)
        turn[:3, 3] = axis.point_obj - turn[:3, :3] @ axis.point_obj
        assert torch.allclose(axis.turned_to_match(T_true @ turn, T_true), T_true, atol=1e-9)
        assert torch.allclose(axis.turned_to_match(T_true @ tilt @ turn, T_true), T_true @ tilt, atol=1e-9)


def test_errors_of_a_vase_do_not_count_its_turns_but_its_tilts():
    model = ObjectModel.from_mesh(vase())
    axis, t_us, T = revolution_axis(model), torch.arange(4) * 1000, random_pose(4)
    turned, tilted = T.clone(), T.clone()
    turned[:, :3, :3] = T[:, :3, :3] @ so3_exp(torch.tensor([0.0, 2.0, 0.0], dtype=torch.float64))
    tilted[:, :3, :3] = T[:, :3, :3] @ so3_exp(torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))
    assert float(pose_errors(t_us, turned, Trajectory(t_us, T), axis).rotation_deg.max()) < 1e-4
    assert float(pose_errors(t_us, turned, Trajectory(t_us, T)).rotation_deg.min()) == pytest.approx(math.degrees(2.0))
    assert float(pose_errors(t_us, tilted, Trajectory(t_us, T), axis).rotation_deg.min()) == pytest.approx(math.degrees(0.1))


# ---- axes that most of an object can be turned about


HANDLED_SHAPES = {
    "can": [trimesh.creation.cylinder(0.03, 0.1, sections=32), handle((0.03, 0.012, 0.06), 0.042, 0.01)],
    "ring": [trimesh.creation.torus(0.05, 0.014), handle((0.03, 0.012, 0.02), 0.07)],
    "cone": [trimesh.creation.cone(0.04, 0.12), handle((0.02, 0.02, 0.02), 0.035, 0.02)],
    "printed can": [printed_can()],
}


@pytest.mark.parametrize("name", HANDLED_SHAPES)
def test_the_axis_of_most_of_a_shape_wherever_it_lies(name):
    parts = HANDLED_SHAPES[name]
    mesh = trimesh.util.concatenate(parts) if len(parts) > 1 else parts[0].copy()
    T = se3_exp(torch.tensor([0.4, -0.9, 0.3, 0.2, -0.1, 0.3], dtype=torch.float64))
    mesh.apply_transform(T.numpy())
    axis, direction = turning_axis(ObjectModel.from_mesh(mesh)), T[:3, :3] @ SEEN_AXIS
    assert axis is not None
    assert abs(float(axis.direction_obj @ direction)) == pytest.approx(1, abs=2e-5)
    # To a third of a millimetre, although the handle shifts the middle by several.
    assert float(torch.linalg.cross(axis.point_obj - T[:3, 3], direction).norm()) < 3e-4


@pytest.mark.parametrize(
    "mesh",
    [
        TURNED_SHAPES["cylinder"],
        trimesh.creation.box((0.1, 0.1, 0.02)),
        trimesh.creation.box((0.2, 0.2, 0.002)),
        trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=3, radius=0.05), handle((0.02, 0.01, 0.01), 0.055)]),
        trimesh.util.concatenate([handle((0.03, 0.08, 0.03 * (step + 1)), 0.03 * step, -0.015 * (step + 1)) for step in range(4)]),
        trimesh.util.concatenate([trimesh.creation.cylinder(0.01, 0.05, sections=32), handle((0.1, 0.1, 0.05), 0.07)]),
    ],
    ids=["cylinder", "box", "plate", "ball with a handle", "stairs", "box with a knob"],
)
def test_all_other_shapes_cannot_be_turned_nearly_unseen(mesh):
    assert turning_axis(ObjectModel.from_mesh(mesh)) is None


def test_lines_have_no_axis_either():
    assert turning_axis(ObjectModel.from_polylines([[[0.0, 0, 0], [0.1, 0, 0]]])) is None


# ---- planes


def l_shape():
    """A bracket, the same on both sides of z = 0, which is its only plane of symmetry."""
    parts = [trimesh.creation.box((0.1, 0.02, 0.05)), trimesh.creation.box((0.02, 0.06, 0.05))]
    parts[1].apply_translation((-0.04, 0.04, 0))
    return trimesh.util.concatenate(parts)


def planes_of(mesh):
    point, normals = symmetry_planes(ObjectModel.from_mesh(mesh))
    return point, normals


def test_planes_of_a_box_are_those_across_its_sides_wherever_it_lies():
    T = se3_exp(torch.tensor([0.4, -0.9, 0.3, 0.2, -0.1, 0.3], dtype=torch.float64))
    mesh = trimesh.creation.box((0.05, 0.08, 0.12))
    mesh.apply_transform(T.numpy())
    point, normals = planes_of(mesh)
    assert len(normals) == 3
    assert float((normals @ T[:3, :3]).abs().max(1).values.min()) > 0.999
    assert float((point - T[:3, 3]).norm()) < 0.002


def test_the_plane_of_a_bracket_is_the_only_one():
    _, normals = planes_of(l_shape())
    assert normals.shape == (1, 3)
    assert abs(float(normals[0, 2])) > 0.999


def test_a_body_without_symmetry_has_no_plane_and_polylines_have_none():
    lump = trimesh.creation.box((0.03, 0.04, 0.1))
    lump.apply_translation((0.03, 0.03, 0.06))
    assert planes_of(trimesh.util.concatenate([l_shape(), lump]))[1].shape == (0, 3)
    square = ObjectModel.from_polylines([[[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0, 0]]], name="square")
    assert symmetry_planes(square)[1].shape == (0, 3)


def test_the_same_shape_has_the_same_planes_every_time():
    first, again = (planes_of(l_shape()) for _ in range(2))
    assert torch.equal(first[0], again[0]) and torch.equal(first[1], again[1])
