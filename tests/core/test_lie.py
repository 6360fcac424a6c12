"""Rotations and rigid motions: round trips, identities, gradients where the formulas are delicate, and bad poses."""

import math

import pytest
import torch
from helpers import far_from, generator, random_pose, random_twist, rotation_vectors
from scipy.spatial.transform import Rotation
from torch.autograd import gradcheck, gradgradcheck

from torchtrack.core import lie
from torchtrack.core.pose_checks import check_pose

BATCHES = [(), (1,), (5,), (2, 3), (0,)]
TOLERANCE = {torch.float32: 2e-6, torch.float64: 1e-13}
ANGLES = {
    "identity": 0.0,
    "tiny": 1e-9,
    "small": 1e-3,
    "threshold": 1e-2,
    "one": 1.0,
    "near_pi": math.pi - 1e-4,
    "nearer_pi": math.pi - 1e-9,
    "pi": math.pi,
}


def twists(angle: float, *batch: int, seed: int = 0, dtype=torch.float64) -> torch.Tensor:
    phi = rotation_vectors(angle, *batch, seed=seed)
    rho = torch.randn((*batch, 3), generator=generator(seed + 1), dtype=torch.float64)
    return torch.cat([phi, rho], -1).to(dtype)


# ---- values


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", ANGLES.values(), ids=ANGLES)
def test_so3_exp_agrees_with_scipy(angle, batch):
    phi = rotation_vectors(angle, *batch)
    expected = torch.from_numpy(Rotation.from_rotvec(phi.reshape(-1, 3).numpy()).as_matrix()) if phi.numel() else torch.zeros(0, 3, 3)
    assert far_from(lie.so3_exp(phi).reshape(-1, 3, 3), expected) < 1e-13


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("angle", ANGLES.values(), ids=ANGLES)
def test_exp_gives_rigid_motions_that_log_undoes(angle, batch, dtype):
    T = lie.se3_exp(twists(angle, *batch, dtype=dtype))
    check_pose(T, tolerance=TOLERANCE[dtype] * 2)
    assert T.shape == (*batch, 4, 4)
    again = lie.se3_exp(lie.se3_log(T))
    assert far_from(again, T) < 20 * TOLERANCE[dtype]


@pytest.mark.parametrize("angle", [angle for angle in ANGLES.values() if angle < 3.14159], ids=lambda angle: f"{angle:.4g}")
def test_log_undoes_exp(angle, dtype):
    xi = twists(angle, 7, dtype=dtype)
    # Near a half turn the angle is read from w = cos(θ/2), which rounding moves; the error grows with the translation.
    assert far_from(lie.se3_log(lie.se3_exp(xi)), xi) < 50 * TOLERANCE[dtype]


def test_tiny_rotations_keep_all_their_digits(dtype):
    phi = rotation_vectors(1e-9, 10, dtype=dtype)
    torch.testing.assert_close(lie.so3_log(lie.so3_exp(phi)), phi, rtol=1e-5, atol=0)


def test_log_at_exactly_a_half_turn():
    for rotation in (torch.diag(torch.tensor(diagonal, dtype=torch.float64)) for diagonal in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1])):
        phi = lie.so3_log(rotation)
        assert math.isclose(float(phi.norm()), math.pi, rel_tol=1e-15)
        assert far_from(lie.so3_exp(phi), rotation) < 1e-15


def test_exp_is_the_matrix_exponential():
    xi = random_twist(4, 2)
    generator_matrix = torch.zeros(4, 2, 4, 4, dtype=torch.float64)
    generator_matrix[..., :3, :3] = lie.hat(xi[..., :3])
    generator_matrix[..., :3, 3] = xi[..., 3:]
    assert far_from(lie.se3_exp(xi), torch.linalg.matrix_exp(generator_matrix)) < 1e-14


def test_hat_is_the_cross_product():
    a, b = torch.randn(2, 6, 3, generator=generator(), dtype=torch.float64)
    torch.testing.assert_close((lie.hat(a) @ b[..., None]).squeeze(-1), torch.linalg.cross(a, b))
    assert torch.equal(lie.vee(lie.hat(a)), a)


@pytest.mark.parametrize("angle", ANGLES.values(), ids=ANGLES)
def test_quaternions_round_trip(angle, dtype):
    rotation = lie.so3_exp(rotation_vectors(angle, 50, dtype=dtype))
    quaternion = lie.quaternion_from_rotation(rotation)
    assert bool((quaternion[:, 3] >= 0).all())
    assert far_from(quaternion.norm(dim=-1), torch.ones(50, dtype=dtype)) < 5e-7
    assert far_from(lie.rotation_from_quaternion(quaternion), rotation) < 10 * TOLERANCE[dtype]
    assert far_from(lie.rotation_from_quaternion(-3 * quaternion), rotation) < 10 * TOLERANCE[dtype]


def test_quaternion_order_is_x_y_z_w():
    quaternion = lie.quaternion_from_rotation(lie.so3_exp(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64)))
    torch.testing.assert_close(quaternion, torch.tensor([0, 0, math.sqrt(0.5), math.sqrt(0.5)], dtype=torch.float64))


@pytest.mark.parametrize("batch", BATCHES)
def test_inverse(batch, dtype):
    T = random_pose(*batch, dtype=dtype)
    eye = torch.eye(4, dtype=dtype).expand(*batch, 4, 4)
    assert far_from(lie.se3_inverse(T) @ T, eye) < 5 * TOLERANCE[dtype]
    assert far_from(T @ lie.se3_inverse(T), eye) < 5 * TOLERANCE[dtype]


def test_transform_points_is_the_homogeneous_product():
    T, points = random_pose(3), torch.randn(3, 10, 3, generator=generator(), dtype=torch.float64)
    homogeneous = torch.cat([points, torch.ones(3, 10, 1, dtype=torch.float64)], -1)
    expected = torch.einsum("bij,bnj->bni", T, homogeneous)[..., :3]
    torch.testing.assert_close(lie.transform_points(T, points), expected)


# ---- interpolation and angles


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, 3.0], ids=str)
def test_interpolation_starts_at_the_start_and_ends_at_the_end(angle):
    T_start = random_pose(6)
    T_end = lie.se3_exp(twists(angle, 6, seed=4)) @ T_start
    zero, whole = torch.zeros(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64)
    assert far_from(lie.se3_interpolate(T_start, T_end, zero), T_start) == 0
    assert far_from(lie.se3_interpolate(T_start, T_end, whole), T_end) < 1e-12


def test_interpolation_moves_with_constant_twist():
    T_start, xi = random_pose(), random_twist()
    T_end = lie.se3_exp(xi) @ T_start
    for fraction in (0.25, 0.5, 1.5):
        expected = lie.se3_exp(fraction * xi) @ T_start
        assert far_from(lie.se3_interpolate(T_start, T_end, torch.tensor(fraction, dtype=torch.float64)), expected) < 1e-12


@pytest.mark.parametrize("angle_deg", [0.0, 1e-7, 0.01, 90.0, 179.999999, 180.0])
def test_rotation_angle(angle_deg):
    rotation = lie.so3_exp(rotation_vectors(1.0, 5))
    turned = rotation @ lie.so3_exp(rotation_vectors(math.radians(angle_deg), 5, seed=3))
    torch.testing.assert_close(lie.rotation_angle_deg(rotation, turned), torch.full((5,), angle_deg, dtype=torch.float64), rtol=1e-7, atol=1e-12)


def test_rotation_angle_has_a_finite_gradient_at_zero():
    rotation = torch.eye(3, dtype=torch.float64, requires_grad=True)
    lie.rotation_angle_deg(torch.eye(3, dtype=torch.float64), rotation).backward()
    assert bool(torch.isfinite(rotation.grad).all())


# ---- gradients

GRADIENT_ANGLES = {"identity": 0.0, "tiny": 1e-9, "small": 1e-3, "one": 1.0, "near_pi": math.pi - 1e-3}


@pytest.mark.parametrize("angle", GRADIENT_ANGLES.values(), ids=GRADIENT_ANGLES)
def test_gradients_are_right_everywhere(angle):
    phi = rotation_vectors(angle, 2, seed=5).requires_grad_()
    xi = twists(angle, 2, seed=5).requires_grad_()
    assert gradcheck(lie.so3_exp, phi)
    assert gradcheck(lie.cayley, phi)
    assert gradcheck(lie.se3_exp, xi)
    assert gradcheck(lie.so3_log, lie.so3_exp(phi.detach()).requires_grad_())
    assert gradcheck(lie.se3_log, lie.se3_exp(xi.detach()).requires_grad_())


@pytest.mark.parametrize("angle", GRADIENT_ANGLES.values(), ids=GRADIENT_ANGLES)
def test_second_derivatives_of_the_exponential_are_right(angle):
    assert gradgradcheck(lie.se3_exp, twists(angle, 1, seed=5).requires_grad_())


@pytest.mark.parametrize("angle", ANGLES.values(), ids=ANGLES)
def test_gradients_are_finite_in_both_precisions(angle, dtype):
    xi = twists(angle, 8, dtype=dtype).requires_grad_()
    lie.se3_log(lie.se3_exp(xi)).sum().backward()
    assert bool(torch.isfinite(xi.grad).all())


@pytest.mark.parametrize("angle", [1e-3, 1.1e-2, 0.1, 1.0])
def test_float32_gradients_agree_with_float64(angle):
    gradients = []
    for dtype in (torch.float32, torch.float64):
        xi = twists(angle, 8, dtype=dtype).requires_grad_()
        weights = torch.linspace(-1, 1, 16, dtype=dtype).view(4, 4)
        (lie.se3_exp(xi) * weights).sum().backward()
        gradients.append(xi.grad.double())
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-3)
