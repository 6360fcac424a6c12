"""Motions about an object's centre: the chart of the solver and of velocities, and its shortcuts for small steps."""

import math

import pytest
import torch
from helpers import far_from, generator, random_pose, random_twist, rotation_vectors
from torch.autograd import gradcheck

from torchtrack.core import lie

BATCHES = [(), (1,), (5,), (2, 3), (0,)]
TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-13}


@pytest.mark.parametrize("batch", BATCHES)
def test_retraction_turns_about_the_centre_and_moves_it(batch):
    T, delta = random_pose(*batch), random_twist(*batch, seed=1, rotation_rad=0.5)
    centre = torch.randn((*batch, 3), generator=generator(2), dtype=torch.float64)
    moved = lie.retract_about(T, delta, centre)
    assert far_from(moved[..., :3, :3], lie.so3_exp(delta[..., :3]) @ T[..., :3, :3]) < 1e-14
    before, after = (lie.transform_points(pose, centre[..., None, :]).squeeze(-2) for pose in (T, moved))
    assert far_from(after - before, delta[..., 3:]) < 1e-14
    assert far_from(lie.difference_about(T, moved, centre), delta) < 1e-13


def test_retraction_about_the_camera_is_a_turn_and_a_shift():
    T, delta = random_pose(4), random_twist(4, seed=1, rotation_rad=0.3)
    camera_in_object = lie.se3_inverse(T)[:, :3, 3]
    expected = lie.se3_exp(torch.cat([delta[:, :3], torch.zeros(4, 3, dtype=torch.float64)], -1)) @ T
    expected[:, :3, 3] += delta[:, 3:]
    assert far_from(lie.retract_about(T, delta, camera_in_object), expected) < 1e-13


@pytest.mark.parametrize("batch", BATCHES)
def test_moving_about_the_centre_turns_there_and_nowhere_else(batch, dtype):
    T, rotation = random_pose(*batch).to(dtype), lie.so3_exp(rotation_vectors(0.8, *batch, seed=3, dtype=dtype))
    move, centre = (torch.randn((*batch, 3), generator=generator(seed), dtype=torch.float64).to(dtype) for seed in (4, 5))
    moved = lie.move_about(T, rotation, move, centre)
    assert moved.shape == T.shape
    assert moved.dtype == dtype
    assert torch.equal(moved[..., 3, :], T[..., 3, :])
    # Any point of the object: turned about the centre, and moved with it.
    offset = torch.randn((*batch, 3), generator=generator(6), dtype=torch.float64).to(dtype)
    at = [lie.transform_points(pose, (centre + offset)[..., None, :]).squeeze(-2) for pose in (T, moved)]
    centre_cam = lie.transform_points(T, centre[..., None, :]).squeeze(-2)
    expected = centre_cam + move + (rotation @ (at[0] - centre_cam)[..., None]).squeeze(-1)
    assert far_from(at[1], expected) < 10 * TOLERANCE[dtype]


def test_moving_by_nothing_leaves_the_pose_and_moves_add_up():
    T, centre = random_pose(4), torch.randn((4, 3), generator=generator(7), dtype=torch.float64)
    eye, nothing = torch.eye(3, dtype=torch.float64).expand(4, 3, 3), torch.zeros(4, 3, dtype=torch.float64)
    assert torch.equal(lie.move_about(T, eye, nothing, centre), T)
    first, second = (lie.so3_exp(rotation_vectors(0.5, 4, seed=seed)) for seed in (8, 9))
    shift = torch.randn((4, 3), generator=generator(10), dtype=torch.float64)
    twice = lie.move_about(lie.move_about(T, first, shift, centre), second, shift, centre)
    assert far_from(twice, lie.move_about(T, second @ first, 2 * shift, centre)) < 1e-14


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.01, 0.3, 1.5])
def test_the_chord_is_the_sine_of_the_angle_along_the_axis(angle, batch, dtype):
    phi = rotation_vectors(angle, *batch, dtype=dtype)
    chord = lie.chord(lie.so3_exp(phi))
    assert far_from(chord, math.sin(angle) / max(angle, 1e-300) * phi) < TOLERANCE[dtype]
    assert far_from(chord, phi) <= angle**3 / 6 + TOLERANCE[dtype]


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.01, 0.1])
def test_small_differences_are_the_difference_but_for_the_cube_of_the_angle(angle, batch):
    T, centre = random_pose(*batch), torch.randn((*batch, 3), generator=generator(2), dtype=torch.float64)
    delta = torch.cat([rotation_vectors(angle, *batch, seed=11), torch.randn((*batch, 3), generator=generator(12), dtype=torch.float64)], -1)
    moved = lie.retract_about(T, delta, centre)
    small, exact = lie.small_difference_about(T, moved, centre), lie.difference_about(T, moved, centre)
    assert small.shape == (*batch, 6)
    assert torch.equal(small[..., 3:], exact[..., 3:])
    assert far_from(small, delta) <= angle**3 / 6 + 1e-13


def test_the_solvers_step_is_told_by_the_small_difference():
    """Cayley forth and chord back: what the solver adds up agrees with what it is said to have moved, to third order."""
    T, centre = random_pose(5), torch.randn((5, 3), generator=generator(2), dtype=torch.float64)
    for angle in (1e-3, 1e-2, 0.1):
        phi, move = rotation_vectors(angle, 5, seed=13), torch.randn((5, 3), generator=generator(14), dtype=torch.float64)
        there = lie.move_about(T, lie.cayley(phi), move, centre)
        assert far_from(lie.small_difference_about(T, there, centre), torch.cat([phi, move], -1)) < angle**3
    assert far_from(lie.move_about(there, lie.cayley(-phi), -move, centre), T) < 1e-13


def test_cayley_turns_by_twice_the_arc_tangent_of_half_the_angle(dtype):
    for angle in (1e-3, 0.5, 2.0, 3.0):
        turned = lie.so3_log(lie.cayley(rotation_vectors(angle, 20, dtype=dtype))).norm(dim=-1)
        assert far_from(turned, torch.full_like(turned, 2 * math.atan(angle / 2))) < 5 * TOLERANCE[dtype]


@pytest.mark.parametrize("function", [lie.cayley, lambda phi: lie.chord(lie.so3_exp(phi))], ids=["cayley", "chord"])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.01, 1.0])
def test_gradients_of_the_solvers_shortcuts_are_right(function, angle):
    assert gradcheck(function, rotation_vectors(angle, 3).requires_grad_(), atol=1e-7)


@pytest.mark.parametrize("batch", BATCHES)
def test_cayley_gives_rotations_that_agree_with_exp_to_second_order(batch, dtype):
    phi = rotation_vectors(1.0, *batch, dtype=dtype)
    eye = torch.eye(3, dtype=dtype).expand(*batch, 3, 3)
    for angle in (0.0, 0.01, 1.0, 3.0):
        rotation = lie.cayley(angle * phi)
        assert far_from(rotation @ rotation.transpose(-1, -2), eye) < 5 * TOLERANCE[dtype]
        assert far_from(rotation, lie.so3_exp(angle * phi)) <= angle**3 / 6 + TOLERANCE[dtype]


def test_turning_a_rotation_is_the_product_with_cayleys(dtype):
    rotation, phi = random_pose(5).to(dtype)[:, :3, :3], random_twist(5, rotation_rad=1.0, translation_m=1.0).to(dtype)[:, :3]
    torch.testing.assert_close(lie.turned(rotation, phi), lie.cayley(phi) @ rotation)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.01, 1.0, 3.0])
def test_small_steps_turn_by_cayley_and_move_the_centre(angle, dtype):
    T, centre = random_pose(5).to(dtype), torch.randn((5, 3), generator=generator(2), dtype=torch.float64).to(dtype)
    phi, move = rotation_vectors(angle, 5, seed=13, dtype=dtype), torch.randn((5, 3), generator=generator(14), dtype=torch.float64).to(dtype)
    torch.testing.assert_close(lie.step_about(T, torch.cat([phi, move], 1), centre), lie.move_about(T, lie.cayley(phi), move, centre))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.1])
def test_gradients_of_small_steps_are_right(angle):
    T, centre = random_pose(2), torch.randn((2, 3), generator=generator(2), dtype=torch.float64)
    step = torch.cat([rotation_vectors(angle, 2), torch.full((2, 3), 0.1, dtype=torch.float64)], 1)
    assert gradcheck(lie.step_about, tuple(value.requires_grad_() for value in (T, step, centre)), atol=1e-7)
