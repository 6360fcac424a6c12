"""Every message in docs/when_it_fails.md is brought about by what its row says; some symptoms, too, with their cure."""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
import yaml
from tiny_sequence import CAMERA, write_tiny_sequence

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.core.camera import project
from torchtrack.core.lie import so3_exp, transform_points
from torchtrack.io import read_sequence
from torchtrack.run.first_pose.request import as_block, read_near

PAGE = Path(__file__).resolve().parents[2] / "docs" / "when_it_fails.md"
CAMERA_YAML = {"fx": 150.0, "fy": 150.0, "cx": 59.5, "cy": 44.5, "width": 120, "height": 90}


def rows(heading):
    """The rows of the table under a heading, as lists of cells."""
    table = PAGE.read_text(encoding="utf-8").partition(f"## {heading}\n")[2].partition("\n## ")[0]
    lines = [line for line in table.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """A folder where everything is right: events alone, a mesh in mm, a calibration, a config with the true first pose."""
    folder = tmp_path_factory.mktemp("good")
    sequence = read_sequence(write_tiny_sequence(folder))
    events = np.load(folder / "tiny.npz")
    np.savez(folder / "events.npz", **{name: events[name] for name in ("x", "y", "t", "p")})
    mesh = trimesh.creation.box((120.0, 100.0, 80.0))
    mesh.export(folder / "box.stl")
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA_YAML))
    (folder / "run.yaml").write_text(yaml.safe_dump(config(sequence.objects[0].ground_truth.T_cam_obj[0])))
    return folder


@pytest.fixture
def here(good, tmp_path, monkeypatch):
    """A copy of that folder to do something wrong in; commands run in it."""
    shutil.copytree(good, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def config(T_cam_obj):
    """A config of a run without a video, with a first pose."""
    pose = yaml.safe_load(as_block(T_cam_obj, "box", 0))["initial_pose"]
    obj = {"label": "box", "mesh": "box.stl", "unit": "mm", "initial_pose": pose}
    run = {"source": "events.npz", "output": "out", "camera": {"calibration": "camera.yaml"}, "overlay": {"enabled": False}}
    return {**run, "objects": [obj]}


def changed_pose(folder, **changes):
    """The config with another first pose; None leaves it out."""
    settings = yaml.safe_load((folder / "run.yaml").read_text())
    pose = settings["objects"][0]["initial_pose"] | changes
    settings["objects"][0]["initial_pose"] = pose if None not in changes.values() else None
    (folder / "run.yaml").write_text(yaml.safe_dump(settings))
    return "track run.yaml"


def changed_camera(folder, **changes):
    (folder / "camera.yaml").write_text(yaml.safe_dump(CAMERA_YAML | changes))
    return "track run.yaml"


def changed_times(folder, change):
    """The events at other times."""
    events = dict(np.load(folder / "events.npz"))
    np.savez(folder / "events.npz", **{**events, "t": change(events["t"])})


def calib_txt(folder):
    (folder / "camera.yaml").write_text("150 150 59.5 44.5 0 0 0 0\n")
    return "track run.yaml"


def other_clock(folder):
    changed_times(folder, lambda t_us: t_us + 30_000_000)
    return "track run.yaml --start-us 0"


def nanoseconds(folder):
    changed_times(folder, lambda t_us: 1_700_000_000_000_000_000 + 1000 * t_us)
    return "info events.npz --width 120 --height 90"


def wrong_pick(folder):
    """Six corners of the box where they are seen, one of them 40 px beside."""
    T_cam_obj = read_near(folder / "run.yaml", "box", 0)
    corners = 0.5 * torch.tensor([120.0, 100.0, 80.0]).double() * (2 * torch.cartesian_prod(*[torch.arange(2)] * 3)[:6] - 1)
    pixels = project(transform_points(T_cam_obj, corners / 1000), CAMERA.intrinsics(torch.float64))
    pixels[2, 0] += 40.0 if pixels[2, 0] < 60 else -40.0
    lines = [",".join(f"{value:.2f}" for value in (*pixel.tolist(), *corner.tolist())) for pixel, corner in zip(pixels, corners, strict=True)]
    (folder / "picks.csv").write_text("\n".join(["u,v,x,y,z", *lines]))
    return "pose events.npz --mesh box.stl --unit mm --calibration camera.yaml --points picks.csv"


SEARCH = "pose events.npz --mesh box.stl --unit mm --calibration camera.yaml --search"
CASES = {
    "expected 5 mm to 5 m": lambda folder: "model box.stl --unit m",
    "too small to be seen": lambda folder: changed_pose(folder, translation_m=[0.0, 0.0, 500.0]),
    "is behind the camera": lambda folder: changed_pose(folder, translation_m=[0.0, 0.0, -0.5]),
    "is outside the image at the start": lambda folder: changed_pose(folder, translation_m=[0.6, 0.0, 0.5]),
    "the camera is inside": lambda folder: changed_pose(folder, translation_m=[0.0, 0.0, 0.01]),
    "needs an initial_pose": lambda folder: changed_pose(folder, translation_m=None),
    "does not say the sensor size": calib_txt,
    "no lens has focal lengths as short as": lambda folder: changed_camera(folder, fx=4.0, fy=4.0),
    "width and height look exchanged": lambda folder: changed_camera(folder, cx=44.5, cy=59.5),
    "cannot be undone": lambda folder: changed_camera(folder, distortion_model="plumb_bob", distortion=[-4.0, 0.0, 0.0, 0.0]),
    "outside the sensor": lambda folder: changed_camera(folder, width=80, height=60, cx=39.5, cy=29.5),
    "they are on different clocks": other_clock,
    "no events after": lambda folder: f"{SEARCH} --at-us 90000000",
    "events.time_unit": nanoseconds,
    "nothing moves there": lambda folder: f"{SEARCH} --box 0,0,12,12",
    "in no rotation the object fills a box of this shape": lambda folder: f"{SEARCH} --box 0,40,119,50",
    "off the pose that fits all best": wrong_pick,
    "perhaps you meant": lambda folder: "track run.yaml --tracker.window.duration 5000",
}


@pytest.mark.parametrize("fragment", CASES)
def test_the_message_comes_of_what_the_row_says(fragment, here, capsys):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        code = main([*CASES[fragment](here).split()])
    shown = capsys.readouterr()
    said = " ".join([*shown.err.split(), *shown.out.split(), *(" ".join(str(warning.message).split()) for warning in caught)])
    assert fragment in said and "Traceback" not in said
    assert code != 0 or caught


def test_there_is_a_row_for_each_message():
    assert [cells[0].strip("`") for cells in rows("Before tracking")] == list(CASES)


def statuses(*more):
    """Windows by status of a run."""
    code, summary = main(["track", "run.yaml", "--quiet", *more]), json.loads(Path("out/summary.json").read_text())
    status = summary["objects"]["box"]["status"]
    assert code == (ExitCode.NOT_TRACKED if status.get("TRACKING", 0) < summary["windows"] / 10 else ExitCode.DONE)
    return status


def test_all_is_well_without_a_mistake(here):
    assert statuses()["TRACKING"] >= 10


def test_a_wrong_first_pose_is_not_tracked_until_one_is_searched_for(here):
    T_cam_obj = read_near(here / "run.yaml", "box", 0)
    wrong = T_cam_obj.clone()
    wrong[:3, :3] = so3_exp(torch.tensor([0.8, 0.0, 0.4]).double()) @ T_cam_obj[:3, :3]
    wrong[:3, 3] += torch.tensor([-0.12, 0.08, 0.1])
    (here / "run.yaml").write_text(yaml.safe_dump(config(wrong)))
    assert statuses().get("TRACKING", 0) == 0
    assert main(["pose", "run.yaml", "--search", "--config", "found.yaml"]) == 0
    (here / "found.yaml").replace(here / "run.yaml")
    assert statuses("--output", "out", "--overlay.enabled", "false")["TRACKING"] >= 8


def test_windows_of_few_events(here):
    assert statuses("--tracker.window.duration-us", "300").get("TOO_FEW_EVENTS", 0) > 100
    assert "TOO_FEW_EVENTS" not in statuses("--tracker.window.duration-us", "10000")
