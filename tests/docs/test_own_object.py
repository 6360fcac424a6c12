"""docs/own_object.md: its commands, as they are printed, lead from a mesh to the true trajectory, and make its pictures."""

import csv
import re
import runpy

import cv2
import pytest
import torch
from places import REPOSITORY

from torchtrack.cli.main import main
from torchtrack.core.lie import rotation_angle_deg
from torchtrack.io import read_sequence, read_trajectory

SCRIPT = runpy.run_path(str(REPOSITORY / "scripts" / "own_object.py"))
PAGE = (REPOSITORY / "docs" / "own_object.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def walked(tmp_path_factory):
    """The folder after all commands of the page, each of which ends well; in this process, which saves their start."""
    folder = tmp_path_factory.mktemp("own")

    def execute(words):
        program, *rest = words
        if program == "python":
            runpy.run_path(rest[0])
        else:
            assert main(rest) == 0, words

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        SCRIPT["walk"](folder, execute)
    return folder


def test_the_trajectory_is_the_true_one(walked):
    truth = read_sequence(walked / "truth" / "bracket.npz").objects[0].ground_truth
    tracked = read_trajectory(walked / "outputs" / "bracket" / "trajectory_bracket.tum")
    there = truth.at(tracked.t_us)
    assert len(tracked) >= 49
    assert float(rotation_angle_deg(tracked.T_cam_obj[:, :3, :3], there[:, :3, :3]).mean()) < 1
    assert float((tracked.T_cam_obj - there)[:, :3, 3].norm(dim=1).mean()) < 0.002


def test_all_windows_are_tracked_as_the_page_says(walked):
    with (walked / "outputs" / "bracket" / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    # The first ones confirm the pose.
    assert {row["status"] for row in rows[:5]} <= {"TRACKING", "UNCERTAIN"} and {row["status"] for row in rows[5:]} == {"TRACKING"}
    assert torch.tensor([float(row["quality"]) for row in rows]).mean() > 0.9


def test_the_pictures_are_those_that_the_commands_make(walked):
    shown = set(re.findall(r"images/(\w+)\.webp", PAGE))
    assert shown == set(SCRIPT["PICTURES"])
    for name, (made, width) in SCRIPT["PICTURES"].items():
        picture = cv2.imread(str(REPOSITORY / "docs" / "images" / f"{name}.webp"))
        assert picture.shape[1] == width
        if name != "own_report":
            (height, across) = cv2.imread(str(max(walked.glob(made)))).shape[:2]
            assert abs(picture.shape[0] - height * width / across) <= 1
    assert (walked / "bracket.html").read_text(encoding="utf-8").count("<svg") >= 3
