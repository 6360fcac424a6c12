"""What is told of poses that are none."""

import pytest
import torch
from helpers import random_pose

from torchtrack.core.pose_checks import check_pose
from torchtrack.errors import PoseError


def bad(change) -> torch.Tensor:
    T = random_pose(3)
    change(T)
    return T


def scale(T):
    T[1, :3, :3] *= 1.01


def reflect(T):
    T[1, :3, 0] *= -1


def not_a_number(T):
    T[2, 0, 3] = float("nan")


def infinite(T):
    T[2, 0, 0] = float("inf")


def transpose(T):
    T[:] = T.transpose(-1, -2).clone()


@pytest.mark.parametrize(
    ("change", "message"),
    [(scale, "not a rotation"), (reflect, "reflection"), (not_a_number, "NaN"), (infinite, "infinite"), (transpose, "last row")],
)
def test_check_pose_says_what_is_wrong(change, message):
    with pytest.raises(PoseError, match=message) as caught:
        check_pose(bad(change), "T_start")
    assert str(caught.value).startswith("T_start: ")


@pytest.mark.parametrize("shape", [(4,), (3, 4), (2, 4, 3), (3, 3)])
def test_check_pose_wants_4x4_matrices(shape):
    with pytest.raises(PoseError, match=r"expected matrices of shape \[..., 4, 4\]"):
        check_pose(torch.zeros(shape))


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (0,)])
def test_check_pose_accepts_poses(batch, dtype):
    check_pose(random_pose(*batch, dtype=dtype))
