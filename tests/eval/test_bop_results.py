"""Results for the BOP challenge: its columns, millimetres, and poses at the times of images."""

import csv

import numpy as np
import pytest
import torch
from helpers import random_pose

from torchtrack.core.lie import se3_exp
from torchtrack.errors import OutputError, PoseError
from torchtrack.eval.bop_results import BopEstimate, estimates_at_images, write_bop_results
from torchtrack.io import Trajectory

TWIST = torch.tensor([0.1, 0.2, -0.1, 0.01, 0.0, 0.02], dtype=torch.float64)
TRAJECTORY = Trajectory(5_000 + 7_000 * torch.arange(30), se3_exp(torch.arange(30)[:, None] * TWIST))


def test_rows_are_those_of_bop(tmp_path):
    poses = random_pose(2)
    estimates = [BopEstimate(3, 7, 2, poses[0], 0.5, 0.02), BopEstimate(3, 1, 4, poses[1])]
    write_bop_results(tmp_path / "torchtrack_ycbv-test.csv", estimates)
    text = (tmp_path / "torchtrack_ycbv-test.csv").read_text()
    assert text.splitlines()[0] == "scene_id,im_id,obj_id,score,R,t,time"
    first, second = csv.DictReader(text.splitlines())
    assert (first["im_id"], first["obj_id"], first["score"], first["time"]) == ("1", "4", "1", "-1")
    assert (second["scene_id"], second["im_id"], second["score"], second["time"]) == ("3", "7", "0.5", "0.02")
    np.testing.assert_allclose(np.array(second["R"].split(), float).reshape(3, 3), poses[0, :3, :3], atol=1e-8)
    np.testing.assert_allclose(np.array(second["t"].split(), float), 1000 * poses[0, :3, 3], rtol=1e-8)


def test_poses_are_interpolated_at_images():
    estimates = estimates_at_images(TRAJECTORY, scene_id=1, obj_id=5, frame_us=33_333, first_image=10)
    assert [estimate.im_id for estimate in estimates] == [11, 12, 13, 14, 15, 16]
    expected = se3_exp(torch.tensor((33_333 - 5_000) / 7_000, dtype=torch.float64) * TWIST)
    torch.testing.assert_close(estimates[0].T_cam_obj, expected, atol=1e-9, rtol=0)
    assert {(estimate.scene_id, estimate.obj_id) for estimate in estimates} == {(1, 5)}


def test_images_that_are_not_covered_are_refused():
    with pytest.raises(PoseError, match="from 5000 to 208000 µs cover no image"):
        estimates_at_images(TRAJECTORY, 1, 1, frame_us=300_000)
    with pytest.raises(PoseError, match="cover no image of a number from 0 on"):
        estimates_at_images(TRAJECTORY, 1, 1, frame_us=33_333, first_image=-5)
    with pytest.raises(PoseError, match="frame_us is the time from one image to the next"):
        estimates_at_images(TRAJECTORY, 1, 1, frame_us=0)


def test_what_is_no_estimate(tmp_path):
    with pytest.raises(PoseError, match="not a rotation"):
        BopEstimate(1, 1, 1, 2 * torch.eye(4))
    with pytest.raises(PoseError, match="not negative, got scene -1"):
        BopEstimate(-1, 1, 1, torch.eye(4))
    with pytest.raises(OutputError, match="it is a folder"):
        write_bop_results(tmp_path, [])
