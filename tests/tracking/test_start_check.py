"""What a camera cannot see where a run starts is refused, and what it hardly sees is told."""

import numpy as np
import pytest
import torch
import trimesh

from torchtrack.core.camera import Camera
from torchtrack.core.lie import se3_exp
from torchtrack.errors import PoseError, TorchtrackWarning
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.start_check import check_in_view
from torchtrack.tracking.tracker import Tracker

CAMERA = Camera(230.0, 230.0, 119.5, 89.5, 240, 180)
FISHEYE = Camera(130.0, 130.0, 119.5, 89.5, 240, 180, "fisheye", (-0.02, 0.004, -0.003, 0.0008))
BOX = ObjectModel.from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)), name="mug")
PLATE = ObjectModel.from_polylines([[[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0], [-0.2, -0.2, 0]]], name="plate")


def at(x: float, y: float, z: float) -> torch.Tensor:
    T = se3_exp(torch.tensor([0.3, 0.2, 0.1, 0, 0, 0], dtype=torch.float64))
    T[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return T[None]


@pytest.mark.parametrize("model", [BOX, PLATE], ids=["box", "plate"])
def test_what_is_well_seen_is_no_trouble(model):
    check_in_view(at(0, 0, 0.5), [model], [CAMERA])
    check_in_view(at(0.15, 0.05, 0.5), [model], [CAMERA])


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (at(10, 5, 502), r"'mug' is 0\.079 px across at 502 m at the start: too small.*in metres .translation_m., or in mm"),
        (at(2, 0, 0.5), r"'mug' is outside the image at the start: its centre is at pixel \(1040, 90\) of 240x180, 2\.06 m away"),
        (at(0, -1, 0.5), "outside the image"),
        (at(0, 0, -0.5), r"'mug' is behind the camera at the start: its centre is at z = -0\.5 m.*perhaps it is the inverse"),
        (at(0, 0, 0.02), r"the camera is inside 'mug' at the start: the object's centre is 0\.02 m away"),
    ],
    ids=["in_mm", "right", "above", "behind", "within"],
)
def test_what_cannot_be_seen_is_refused(T, message):
    with pytest.raises(PoseError, match=message):
        check_in_view(T, [BOX], [CAMERA])


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (at(0, 0, 8), r"'mug' is 5 px across"),
        (at(0.32, 0, 0.5), r"mostly outside the image \(\d+ % of it within\)"),
        (at(0, 0, 0.11), None),
    ],
    ids=["small", "partly_outside", "near"],
)
def test_what_is_hardly_seen_is_told(T, message):
    if message is None:
        check_in_view(T, [BOX], [CAMERA])
        return
    with pytest.warns(TorchtrackWarning, match=message):
        check_in_view(T, [BOX], [CAMERA])


def test_what_is_larger_than_the_image_is_told():
    with pytest.warns(TorchtrackWarning, match=r"px across, in an image of 240x180"):
        check_in_view(at(0, 0, 0.1), [PLATE], [CAMERA])


def test_a_wide_lens_sees_what_a_pinhole_does_not():
    T = at(0.45, 0, 0.4)
    with pytest.raises(PoseError, match="outside the image"):
        check_in_view(T, [BOX], [CAMERA])
    check_in_view(T, [BOX], [FISHEYE])


def test_each_object_is_looked_at_in_its_own_camera():
    both = torch.cat([at(0, 0, 0.5), at(0.45, 0, 0.4)])
    check_in_view(both, [BOX, BOX], [CAMERA, FISHEYE])
    with pytest.raises(PoseError, match="outside the image"):
        check_in_view(both, [BOX, BOX], [CAMERA, CAMERA])


def test_a_tracker_checks_where_it_starts():
    tracker = Tracker([BOX], CAMERA)
    assert np.isclose(float(tracker.init(at(0, 0, 0.5), 0).T_cam_obj[0, 2, 3]), 0.5)
    with pytest.raises(PoseError, match=r"too small to be seen"):
        tracker.init(at(0, 0, 500), 0)
    with pytest.raises(PoseError, match=r"outside the image"):
        tracker.init(at(2, 0, 0.5), 0)
    with pytest.raises(PoseError, match=r"behind the camera"):
        tracker.init(at(0, 0, -0.5), 0)
