"""Poses of picked points, and what is wrong with files of them."""

import numpy as np
import pytest
import torch

from torchtrack.core.camera import Camera, distort
from torchtrack.core.lie import rotation_angle_deg, se3_exp
from torchtrack.errors import MissingFileError, PoseError, TorchtrackWarning
from torchtrack.run.first_pose.picks import Picks, pose_of_picks, read_picks

CAMERA = Camera(fx=400.0, fy=410.0, cx=160.0, cy=120.0, width=320, height=240, distortion_model="plumb_bob", distortion=(-0.2, 0.05, 0.0, 0.0, 0.0))
CORNERS = 0.05 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)


def truth():
    T = se3_exp(torch.tensor([0.4, -0.3, 0.2, 0.0, 0.0, 0.0], dtype=torch.float64))
    T[:3, 3] = torch.tensor([0.02, -0.01, 0.4], dtype=torch.float64)
    return T


def picks(points=CORNERS, offset_px=0.0):
    T = truth().numpy()
    points_cam = points @ T[:3, :3].T + T[:3, 3]
    ideal = (points_cam @ CAMERA.matrix.T)[:, :2] / points_cam[:, 2:]
    return Picks(distort(ideal, CAMERA) + offset_px, points, "'picks.csv'")


@pytest.mark.parametrize("count", [4, 6, 8])
def test_exact_picks_give_the_pose(count):
    T = pose_of_picks(picks(CORNERS[[0, 3, 5, 6, 1, 2, 4, 7][:count]]), CAMERA)
    assert float(rotation_angle_deg(T[:3, :3], truth()[:3, :3])) < 0.1
    assert torch.allclose(T[:3, 3], truth()[:3, 3], atol=2e-4)


def test_points_on_a_plane_will_do():
    flat = CORNERS[CORNERS[:, 2] < 0]
    assert float(rotation_angle_deg(pose_of_picks(picks(flat), CAMERA)[:3, :3], truth()[:3, :3])) < 0.1


def test_a_wrong_point_is_told():
    noise = np.zeros((8, 2))
    noise[2] = 60
    with pytest.warns(TorchtrackWarning, match=r"pick 3 is \d+ px off the pose that fits all best"):
        pose_of_picks(picks(offset_px=noise), CAMERA)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (picks(CORNERS[:3]), "3 picks are too few; at least 4"),
        (picks(np.linspace(-1, 1, 5)[:, None] * [0.05, 0.02, 0.0]), "all points lie on a line"),
        (picks(offset_px=300.0), "is outside the image of 320x240"),
    ],
)
def test_picks_that_give_no_pose(chosen, message):
    with pytest.raises(PoseError, match=message):
        pose_of_picks(chosen, CAMERA)


def test_a_file_of_picks(tmp_path):
    path = tmp_path / "picks.csv"
    path.write_text("u,v,x,y,z\n# a corner\n1,2,3,4,5\n\n6.5,7,8,9,-10\n")
    read = read_picks(path)
    assert read.pixels.tolist() == [[1, 2], [6.5, 7]] and read.points.tolist() == [[3, 4, 5], [8, 9, -10]]
    in_metres = read.scaled(0.001, np.array([0.001, 0, 0]))
    assert np.allclose(in_metres.points, [[0.002, 0.004, 0.005], [0.007, 0.009, -0.01]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z,u,v\n1,2,3,4,5\n", "expected the first line 'u,v,x,y,z', got 'x,y,z,u,v'"),
        ("", "expected the first line 'u,v,x,y,z'"),
        ("u,v,x,y,z\n1,2,3,4\n", "the line '1,2,3,4' is not five numbers"),
        ("u,v,x,y,z\n1,2,3,4,nan\n", "is not five numbers"),
        ("u,v,x,y,z\n1,2,3,4,left\n", "is not five numbers"),
    ],
)
def test_a_file_that_is_none(tmp_path, text, message):
    path = tmp_path / "picks.csv"
    path.write_text(text)
    with pytest.raises(PoseError, match=message):
        read_picks(path)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(MissingFileError, match=r"file of picks .*nowhere\.csv' does not exist"):
        read_picks(tmp_path / "nowhere.csv")
