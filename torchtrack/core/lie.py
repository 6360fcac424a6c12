"""Rotations SO(3) and rigid motions SE(3) as matrices, batched and differentiable.

Conventions, stated once:

- ``T_cam_obj [..., 4, 4]`` maps points of the object frame to the camera frame, in metres;
  inner names cancel: ``T_cam_obj = T_cam_world @ T_world_obj``.
- A twist is ``[rotation φ, translation ρ]`` (rad, m), the order of the paper's Eq. 13.
- Perturbations act on the left: ``T <- exp(ξ^) T``.

Every function has finite values and gradients at the identity and near a half turn: both branches of each ``where``
see a safe denominator. Formulas: Barfoot, *State Estimation for Robotics*, ch. 7.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchtrack.core import host_sync
from torchtrack.core.constants import constant

# Below this squared angle the Taylor series are exact to float64 rounding (next terms are O(θ⁶)).
_SMALL_ANGLE_SQ = 1e-4
# Skew-symmetric matrices of the three axes, a row each.
_GENERATORS = ((0, 0, 0, 0, 0, -1, 0, 1, 0), (0, 0, 1, 0, 0, 0, -1, 0, 0), (0, -1, 0, 1, 0, 0, 0, 0, 0))


def hat(phi: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Skew-symmetric matrix of a vector: ``hat(a) @ b == cross(a, b)``."""
    return (phi @ constant(_GENERATORS, phi.dtype, phi.device)).unflatten(-1, (3, 3))


def vee(skew: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """The vector of a skew-symmetric matrix: the inverse of :func:`hat`."""
    return torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)


def chord(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """``sin θ · axis`` of a small rotation: its rotation vector but for ``θ³/6``, at a tenth of the cost."""
    return 0.5 * vee(rotation - rotation.transpose(-1, -2))


def _exp_coefficients(angle_sq: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """``sin θ / θ``, ``(1 - cos θ) / θ²`` and ``(θ - sin θ) / θ³``."""
    small = angle_sq < _SMALL_ANGLE_SQ
    safe_sq = torch.where(small, torch.ones_like(angle_sq), angle_sq)
    angle = safe_sq.sqrt()
    sin, half_sin = angle.sin(), (0.5 * angle).sin()
    a = torch.where(small, 1 - angle_sq / 6 * (1 - angle_sq / 20), sin / angle)
    b = torch.where(small, 0.5 - angle_sq / 24 * (1 - angle_sq / 30), 2 * half_sin.square() / safe_sq)
    c = torch.where(small, 1 / 6 - angle_sq / 120 * (1 - angle_sq / 42), (angle - sin) / (safe_sq * angle))
    return a, b, c


def so3_exp(phi: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrix of a rotation vector (rad), by Rodrigues' formula."""
    a, b, _ = _exp_coefficients(phi.square().sum(-1))
    skew = hat(phi)
    eye = torch.eye(3, dtype=phi.dtype, device=phi.device)
    return eye + a[..., None, None] * skew + b[..., None, None] * (skew @ skew)


def quaternion_from_rotation(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternion ``[x, y, z, w]`` with ``w >= 0`` of a rotation matrix.

    Shepperd's method: of the four algebraically equal forms, take the one with the largest divisor.
    """
    m = [[rotation[..., i, j] for j in range(3)] for i in range(3)]
    xx, yy, zz = m[0][0], m[1][1], m[2][2]
    x_w, y_w, z_w = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    x_y, x_z, y_z = m[1][0] + m[0][1], m[0][2] + m[2][0], m[2][1] + m[1][2]
    forms = torch.stack(
        [
            torch.stack([1 + xx - yy - zz, x_y, x_z, x_w], -1),
            torch.stack([x_y, 1 - xx + yy - zz, y_z, y_w], -1),
            torch.stack([x_z, y_z, 1 - xx - yy + zz, z_w], -1),
            torch.stack([x_w, y_w, z_w, 1 + xx + yy + zz], -1),
        ],
        -2,
    )
    best = torch.stack([xx - yy - zz, yy - xx - zz, zz - xx - yy, xx + yy + zz], -1).argmax(-1)
    quaternion = forms.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    return torch.where(quaternion[..., 3:] < 0, -quaternion, quaternion)


def continuous_quaternions(quaternion: Float[Tensor, "p 4"]) -> Float[Tensor, "p 4"]:
    """The same rotations, one after the other, with signs such that no quaternion jumps to its negative, which means the same."""
    turned_back = (quaternion[1:] * quaternion[:-1]).sum(-1) < 0
    signs = torch.where(turned_back, -1.0, 1.0).to(quaternion).cumprod(0)
    return torch.cat([quaternion[:1], quaternion[1:] * signs[:, None]])


def with_signs_of(quaternion: Float[Tensor, "*b 4"], before: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """The same rotations, each with the sign that is nearer to the quaternion before it."""
    return torch.where((quaternion * before).sum(-1, keepdim=True) < 0, -quaternion, quaternion)


def rotation_from_quaternion(quaternion: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrix of a quaternion ``[x, y, z, w]``, which is normalised first."""
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    skew = hat(quaternion[..., :3])
    eye = torch.eye(3, dtype=quaternion.dtype, device=quaternion.device)
    return eye + 2 * (quaternion[..., 3, None, None] * skew + skew @ skew)


def so3_log(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """Rotation vector (rad, length at most π) of a rotation matrix."""
    quaternion = quaternion_from_rotation(rotation)
    vector, w = quaternion[..., :3], quaternion[..., 3]
    sin_sq = vector.square().sum(-1)
    small = sin_sq < _SMALL_ANGLE_SQ / 4
    sin = torch.where(small, torch.ones_like(sin_sq), sin_sq).sqrt()
    # atan(x)/x with x = |v|/w: 1 - x²/3 + x⁴/5 is exact to rounding below the threshold.
    ratio_sq = sin_sq / torch.where(small, w, torch.ones_like(w)).square()
    series = 2 / torch.where(small, w, torch.ones_like(w)) * (1 - ratio_sq / 3 + ratio_sq.square() / 5 - ratio_sq**3 / 7)
    factor = torch.where(small, series, 2 * torch.atan2(sin, w) / sin)
    return factor[..., None] * vector


def _assemble(rotation: Tensor, translation: Tensor) -> Tensor:
    """``[R t; 0 1]``."""
    top = torch.cat([rotation, translation[..., None]], -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 3] = 1
    return torch.cat([top, bottom], -2)


def se3_exp(xi: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 4 4"]:
    """Rigid motion of a twist ``[φ, ρ]`` (the paper's Eq. 13)."""
    phi, rho = xi[..., :3], xi[..., 3:]
    a, b, c = _exp_coefficients(phi.square().sum(-1))
    skew = hat(phi)
    skew_sq = skew @ skew
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    rotation = eye + a[..., None, None] * skew + b[..., None, None] * skew_sq
    left_jacobian = eye + b[..., None, None] * skew + c[..., None, None] * skew_sq
    return _assemble(rotation, (left_jacobian @ rho[..., None]).squeeze(-1))


def se3_log(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 6"]:
    """Twist ``[φ, ρ]`` of a rigid motion, with rotation of at most π."""
    phi = so3_log(T[..., :3, :3])
    angle_sq = phi.square().sum(-1)
    small = angle_sq < _SMALL_ANGLE_SQ
    safe_sq = torch.where(small, torch.ones_like(angle_sq), angle_sq)
    a, b, _ = _exp_coefficients(safe_sq)
    d = torch.where(small, 1 / 12 + angle_sq / 720 * (1 + angle_sq / 42), (1 - 0.5 * a / b) / safe_sq)
    skew = hat(phi)
    eye = torch.eye(3, dtype=T.dtype, device=T.device)
    inverse_jacobian = eye - 0.5 * skew + d[..., None, None] * (skew @ skew)
    return torch.cat([phi, (inverse_jacobian @ T[..., :3, 3:]).squeeze(-1)], -1)


def se3_inverse(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """Inverse of a rigid motion, by transposition."""
    rotation_t = T[..., :3, :3].transpose(-1, -2)
    return _assemble(rotation_t, -(rotation_t @ T[..., :3, 3:]).squeeze(-1))


def affine(matrix: Float[Tensor, "b r 3"], rows: Float[Tensor, "b 3 n"], offset: Float[Tensor, "b r #n"] | None = None) -> Float[Tensor, "b r n"]:
    """``matrix @ rows + offset``, of points with their coordinates as rows.

    On a CPU it is one operation, which takes a third of the time for the few points of one object. On a GPU, libraries take several times
    as long for products this thin as three sums do, which a compiler makes a part of what comes before and after.
    """
    if not host_sync.on_gpu(rows):
        return torch.bmm(matrix, rows) if offset is None else torch.baddbmm(offset, matrix, rows)
    first = matrix[..., :1] * rows[:, :1] if offset is None else torch.addcmul(offset, matrix[..., :1], rows[:, :1])
    return torch.addcmul(torch.addcmul(first, matrix[..., 1:2], rows[:, 1:2]), matrix[..., 2:], rows[:, 2:])


def transform_points(T_a_b: Float[Tensor, "*b 4 4"], points_b: Float[Tensor, "*b n 3"]) -> Float[Tensor, "*b n 3"]:
    """Points of frame b, seen in frame a.

    The product is taken with the coordinates as rows, and stays so in memory: what follows works on long rows.
    """
    rotation, translation = T_a_b[..., :3, :3], T_a_b[..., :3, 3:]
    if T_a_b.dim() == points_b.dim() == 3 and len(T_a_b) == len(points_b):
        return affine(rotation, points_b.transpose(-1, -2), translation).transpose(-1, -2)
    return (rotation @ points_b.transpose(-1, -2) + translation).transpose(-1, -2)


def se3_interpolate(T_start: Float[Tensor, "*b 4 4"], T_end: Float[Tensor, "*b 4 4"], fraction: Float[Tensor, "*b"]) -> Float[Tensor, "*b 4 4"]:
    """Constant-twist interpolation on SE(3): ``T_start`` at fraction 0, ``T_end`` at fraction 1."""
    xi = se3_log(T_end @ se3_inverse(T_start))
    return se3_exp(fraction[..., None] * xi) @ T_start


def orthonormalise(T: Float[Tensor, "*b 4 4"]) -> Float[Tensor, "*b 4 4"]:
    """A pose whose rotation is exact again: rounding adds up over thousands of products.

    One step of Newton's iteration for the nearest rotation, which squares the deviation.
    """
    rotation = T[..., :3, :3]
    exact = 1.5 * rotation - 0.5 * rotation @ (rotation.transpose(-1, -2) @ rotation)
    return torch.cat([torch.cat([exact, T[..., :3, 3:]], -1), T[..., 3:, :]], -2)


def rotation_angle_deg(rotation_a: Float[Tensor, "*b 3 3"], rotation_b: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle between two rotations in degrees: the paper's δR.

    The paper writes it as an arc cosine of the trace, which loses half the digits near zero; the logarithm does not.
    """
    return torch.rad2deg(so3_log(rotation_a.transpose(-1, -2) @ rotation_b).norm(dim=-1))


def move_about(
    T: Float[Tensor, "*b 4 4"], rotation: Float[Tensor, "*b 3 3"], move: Float[Tensor, "*b 3"], centre_obj: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 4 4"]:
    """Turn by ``rotation`` about the object's centre, and move the centre by ``move``, both in the camera's axes."""
    turned = rotation @ T[..., :3, :3]
    shift = ((T[..., :3, :3] - turned) @ centre_obj[..., None]).squeeze(-1)
    top = torch.cat([turned, (T[..., :3, 3] + shift + move)[..., None]], -1)
    return torch.cat([top, T[..., 3:, :]], -2)


def retract_about(T: Float[Tensor, "*b 4 4"], delta: Float[Tensor, "*b 6"], centre_obj: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 4 4"]:
    """Rotate by ``φ`` about the object's centre, and move the centre by ``ρ``, both in the camera's axes.

    A chart of SE(3) that is better conditioned than the left perturbation for an object far from the camera.
    """
    return move_about(T, so3_exp(delta[..., :3]), delta[..., 3:], centre_obj)


def cayley(phi: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation of the quaternion ``[φ/2, 1]``: exact rotations that agree with ``so3_exp`` to second order.

    Half the operations of the exponential, and smooth everywhere: the solver's retraction.
    """
    skew, factor = _skew_and_factor(phi)
    return torch.eye(3, dtype=phi.dtype, device=phi.device) + 8 * factor * (skew + skew @ skew)


def _skew_and_factor(phi: Tensor) -> tuple[Tensor, Tensor]:
    """Cayley's rotation is ``1 + 8 factor (skew + skew²)``: these two."""
    four = constant((4.0,), phi.dtype, phi.device)
    return hat(0.5 * phi), (four + torch.linalg.vecdot(phi, phi)[..., None]).reciprocal()[..., None]


def turned(rotation: Float[Tensor, "b 3 3"], phi: Float[Tensor, "b 3"]) -> Float[Tensor, "b 3 3"]:
    """``cayley(phi) @ rotation``, in fewer operations."""
    skew, factor = _skew_and_factor(phi)
    across = torch.bmm(skew, rotation)
    return torch.addcmul(rotation, factor, torch.baddbmm(across, skew, across), value=8)


def step_about(T: Float[Tensor, "b 4 4"], step: Float[Tensor, "b 6"], centre_obj: Float[Tensor, "b 3"]) -> Float[Tensor, "b 4 4"]:
    """:func:`retract_about` for small steps, with :func:`cayley` in the place of the exponential."""
    rotation = turned(T[:, :3, :3], step[:, :3])
    shift = torch.baddbmm(step[:, 3:, None], T[:, :3, :3] - rotation, centre_obj[..., None])
    return torch.cat([torch.cat([rotation, T[:, :3, 3:] + shift], 2), T[:, 3:]], 1)


def difference_about(T_from: Float[Tensor, "*b 4 4"], T_to: Float[Tensor, "*b 4 4"], centre_obj: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 6"]:
    """The ``delta`` with ``retract_about(T_from, delta, centre_obj) == T_to``."""
    phi = so3_log(T_to[..., :3, :3] @ T_from[..., :3, :3].transpose(-1, -2))
    return torch.cat([phi, _centre_moved(T_from, T_to, centre_obj)], -1)


def small_difference_about(
    T_from: Float[Tensor, "*b 4 4"], T_to: Float[Tensor, "*b 4 4"], centre_obj: Float[Tensor, "*b 3"]
) -> Float[Tensor, "*b 6"]:
    """:func:`difference_about` for small rotations, with the :func:`chord` in the place of the rotation vector."""
    return torch.cat([chord(T_to[..., :3, :3] @ T_from[..., :3, :3].transpose(-1, -2)), _centre_moved(T_from, T_to, centre_obj)], -1)


def _centre_moved(T_from: Tensor, T_to: Tensor, centre_obj: Tensor) -> Tensor:
    """How far the object's centre moves from one pose to the other."""
    moved = (T_to - T_from)[..., :3, :]
    return (moved[..., :3] @ centre_obj[..., None]).squeeze(-1) + moved[..., 3]
