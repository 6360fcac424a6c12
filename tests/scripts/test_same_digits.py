"""``scripts/same_digits``: what it compares, and that it sees every difference."""

import importlib
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from places import REPOSITORY

from torchtrack import ObjectModel

TOOLS = REPOSITORY / "scripts" / "digits"


@pytest.fixture(scope="module", autouse=True)
def tools_on_path():
    sys.path.insert(0, str(TOOLS))
    yield
    sys.path.remove(str(TOOLS))


def tool(name):
    return importlib.import_module(name)


def difference(base, here, **kwargs):
    return tool("comparison").first_difference(base, here, **{"renamed": {}, "added": frozenset(), **kwargs})


def windows(count=3):
    return [{"poses": torch.arange(4.0) + window, "status": torch.tensor([window])} for window in range(count)]


def changed(window, **fields):
    return [before | fields if number == window else before for number, before in enumerate(windows())]


def test_what_is_the_same_has_no_difference():
    assert difference(windows(), windows()) is None


def test_what_is_not_a_number_is_equal_to_what_is_not_a_number():
    values = torch.tensor([1.0, torch.nan])
    assert difference([{"quality": values}], [{"quality": values.clone()}]) is None
    assert difference([{"quality": values}], [{"quality": torch.tensor([torch.nan, 1.0])}]) is not None


def test_the_last_bit_of_one_number_is_a_difference():
    poses = windows()[1]["poses"].clone()
    poses[2] = torch.nextafter(poses[2], torch.tensor(torch.inf))
    first = difference(windows(), changed(1, poses=poses))
    assert (first.window, first.field) == (1, "poses")
    assert "1 of 4 numbers differ, by up to 2.38e-07" in first.what
    assert "at [2]" in first.what


def test_the_first_window_that_differs_is_told():
    assert difference(windows(), [windows()[0], *changed(1, status=torch.tensor([9]))[1:2], changed(2, status=torch.tensor([9]))[2]]).window == 1


@pytest.mark.parametrize("other", [torch.arange(4.0, dtype=torch.float64), torch.arange(3.0)], ids=["dtype", "shape"])
def test_another_type_or_shape_is_a_difference(other):
    assert "at BASE" in difference(windows(), changed(0, poses=other)).what


def test_a_run_that_ends_early_is_a_difference():
    assert difference(windows(3), windows(2)).what == "3 windows at BASE, 2 here"


def test_fields_are_compared_by_name_and_under_new_names_if_listed():
    there = [{"contours.normals": torch.ones(2), "quality": torch.ones(1), "gone": torch.ones(1)}]
    here = [{"outline.normals": torch.ones(2), "quality": torch.ones(1), "more": torch.ones(1)}]
    renamed = {"contours": "outline", "gone": None}
    assert difference(there, here, renamed=renamed, added=frozenset({"more"})) is None
    assert difference(there, here, renamed=renamed).field == "more"
    assert difference(there, here, renamed={"contours": "outline"}, added=frozenset({"more"})).field == "gone"
    assert difference(there, here, added=frozenset({"more", "outline.normals"})).field == "contours.normals"


def test_a_pose_that_jumps_was_searched_for():
    steady = [{"T_cam_obj": torch.eye(4)[None] + 0.5 * (torch.arange(16).view(4, 4) == 11), "status": torch.tensor([0])} for _ in range(5)]
    assert not tool("comparison").is_searched_for(steady, 250.0)
    far = steady[0]["T_cam_obj"].clone()
    far[0, 0, 3] = 0.1
    jumped = [*steady[:3], *[{"T_cam_obj": far, "status": torch.tensor([0])}] * 2]
    assert tool("comparison").is_searched_for(jumped, 250.0)
    assert not tool("comparison").is_searched_for([*jumped, {"T_cam_obj": far, "status": torch.tensor([2])}], 250.0)


def test_events_are_the_same_each_time_and_on_the_sensor():
    events, scene = tool("event_images"), tool("scenes").SCENES["box"]
    once, again = (events.fired([scene.objects[0][1]], scene.cameras[0], 5_000, seed=1) for _ in range(2))
    assert all(np.array_equal(once[name], again[name]) for name in once)
    assert (np.diff(once["t_us"]) >= 0).all()
    assert once["x"].min() >= 0 and once["x"].max() < scene.cameras[0].width
    assert once["y"].min() >= 0 and once["y"].max() < scene.cameras[0].height
    assert len(once["x"]) > 100


def test_the_printed_plate_shows_its_print_and_the_ellipsoid_none(tmp_path):
    tool("scenes").write_scenes(tmp_path, [])
    plate, ellipsoid = (ObjectModel.from_file(tmp_path / f"{name}.glb") for name in ("plate", "ellipsoid"))
    assert len(plate.texture_points) > 100
    # All of it on the side that faces the camera, where the rays see it.
    assert (plate.texture_normals[:, 2] < -0.99).all()
    assert len(ellipsoid.texture_points) == 0


def test_every_scene_preset_precision_and_way_is_run_and_what_cannot_be_is_left_out():
    script = tool("same_digits")
    runs = script.all_runs()
    assert len(runs) == 6 * 5 * 2 * 2 - 4 + 5
    assert not [run for run in runs if run.scene == "smooth object" and run.preset == "line"]
    short = script.short_runs()
    assert {run.scene for run in short} == set(tool("scenes").SCENES)
    assert {run.preset for run in short} == set(script.WINDOW_US)
    assert {run.dtype for run in short} == {"float32", "float64"}


def test_a_scene_goes_through_the_tracker_of_this_tree_and_a_changed_digit_is_seen(tmp_path):
    runner = tool("runner")
    tool("scenes").write_scenes(tmp_path, ["box"], duration_us=10_000)
    run = {"preset": "default", "dtype": "float32", "kernels": False, "refined": False, "window_us": 5_000, "windows": 2}
    scene = runner.Scene(tmp_path, "box")
    results = runner.results_of(scene, run)
    once, again = ([runner.numbers_of(result) for result in taken] for taken in (results, runner.results_of(scene, run)))
    assert {"T_cam_obj", "covariance", "status", "quality", "observation_count", "t_us"} <= set(once[0])
    assert difference(once, again) is None
    results[1] = replace(results[1], quality=results[1].quality * (1 + 1e-6))
    assert difference(once, [runner.numbers_of(result) for result in results]).field == "quality"


def test_a_commit_that_the_clone_lacks_is_told(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["same_digits", "0" * 40])
    with pytest.raises(SystemExit, match="there is no commit '0000"):
        tool("same_digits").main()


def test_the_pinned_commit_is_skipped_visibly_where_the_clone_lacks_it(tmp_path, monkeypatch, capsys):
    script = tool("same_digits")
    (tmp_path / "base").write_text("1" * 40 + "\n")
    monkeypatch.setattr(script, "PINNED", tmp_path / "base")
    monkeypatch.setattr(sys, "argv", ["same_digits", "--short"])
    script.main()
    assert capsys.readouterr().out == f"same_digits: skipped: commit {'1' * 40} is not in this clone\n"
