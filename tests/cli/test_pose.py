"""The command ``pose``: each of its ways leads to the pose of a moving bracket, and what is wrong is said."""

import warnings

import cv2
import numpy as np
import pytest
import torch
import yaml
from moving_bracket import AT_US, error_deg, write_bracket
from solid_models import l_prism
from tiny_sequence import CAMERA

from torchtrack.cli.main import main
from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.core.camera import project
from torchtrack.core.lie import rotation_angle_deg, so3_exp, transform_points
from torchtrack.errors import TorchtrackWarning
from torchtrack.run.first_pose.request import PoseFile, as_block
from torchtrack.run.initial_pose import configured_pose


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A sequence of a bracket whose edges fire, its mesh in mm, and the pose at ``AT_US``."""
    folder = tmp_path_factory.mktemp("scene")
    return folder, write_bracket(folder)


def command(*arguments):
    return main(["pose", *(str(argument) for argument in arguments)])


def written_pose(path):
    pose = load(PoseFile, path).initial_pose
    return configured_pose(pose, 0)


def rough(truth, angle_deg, farther):
    T = truth.clone()
    T[:3, :3] = so3_exp(torch.deg2rad(torch.tensor([angle_deg, 0.0, 0.0], dtype=torch.float64))) @ T[:3, :3]
    T[:3, 3] *= farther
    return T


def arguments(folder):
    return (folder / "bracket.npz", "--mesh", folder / "in_mm.stl", "--unit", "mm", "--at-us", AT_US)


def test_a_search_in_a_box(scene, tmp_path, capsys):
    folder, truth = scene
    points = transform_points(truth[None], torch.from_numpy(l_prism().vertices)[None])
    pixels = project(points, CAMERA.intrinsics(torch.float64)[None])[0]
    sides = ",".join(f"{value:.0f}" for value in (*(pixels.amin(0) - 2).tolist(), *(pixels.amax(0) + 3).tolist()))
    assert command(*arguments(folder), "--search", "--box", sides, "-o", tmp_path / "pose.yaml") == 0
    assert error_deg(written_pose(tmp_path / "pose.yaml"), truth) < 5
    shown = capsys.readouterr()
    assert "the pose is in" in shown.out and "'in_mm': events explain" in shown.err
    assert f"start_us: {AT_US}" in (tmp_path / "pose.yaml").read_text()


def test_near_a_rough_pose(scene, tmp_path, monkeypatch, capsys):
    # As on a terminal.
    monkeypatch.setenv("FORCE_COLOR", "1")
    folder, truth = scene
    near = tmp_path / "near.yaml"
    near.write_text(as_block(rough(truth, 35.0, 1.15), "bracket", AT_US))
    assert command(*arguments(folder), "--near", near, "-o", tmp_path / "pose.yaml") == 0
    assert error_deg(written_pose(tmp_path / "pose.yaml"), truth) < 5
    assert "looking for the pose of in_mm" in capsys.readouterr().err


def test_picked_points_in_the_numbers_of_the_file(scene, tmp_path, capsys):
    folder, truth = scene
    corners = torch.from_numpy(l_prism().vertices)[[0, 1, 3, 5, 8, 10]]
    pixels = project(transform_points(truth[None], corners[None]), CAMERA.intrinsics(torch.float64)[None])[0]
    pixels = pixels + torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rows = [",".join(f"{value:.3f}" for value in (*pixel.tolist(), *(1000 * corner).tolist())) for pixel, corner in zip(pixels, corners, strict=True)]
    (tmp_path / "picks.csv").write_text("u,v,x,y,z\n" + "\n".join(rows) + "\n")
    assert command(*arguments(folder), "--points", tmp_path / "picks.csv") == 0
    block = yaml.safe_load(capsys.readouterr().out)
    path = tmp_path / "shown.yaml"
    path.write_text(yaml.safe_dump(block))
    T = written_pose(path)
    assert float(rotation_angle_deg(T[:3, :3], truth[:3, :3])) < 3
    assert torch.allclose(T[:3, 3], truth[:3, 3], atol=0.02)


def test_a_config_and_a_picture(scene, tmp_path, monkeypatch, capsys):
    folder, truth = scene
    (tmp_path / "mesh").mkdir()
    mesh = l_prism().apply_translation((0.3, 0.0, 0.0)).apply_scale(1000)
    mesh.export(tmp_path / "mesh" / "in_mm.stl")
    middle = torch.from_numpy(l_prism().bounds.mean(0))
    near = tmp_path / "near.yaml"
    near.write_text(as_block(rough(moved(truth, middle), 10.0, 1.02), "in_mm", AT_US))
    monkeypatch.chdir(tmp_path)
    given = (folder / "bracket.npz", "--mesh", "mesh/in_mm.stl", "--unit", "mm", "--centre", "--at-us", AT_US, "--near", "near.yaml")
    assert command(*given, "--config", "found.yaml", "--picture", "pose.png") == 0
    assert "torchtrack track found.yaml" in capsys.readouterr().out
    written = yaml.safe_load((tmp_path / "found.yaml").read_text())
    assert set(written) == {"source", "start_us", "output", "objects"}
    assert (written["start_us"], written["output"]) == (AT_US, "outputs/in_mm")
    config = load(RunConfig, tmp_path / "found.yaml")
    (obj,) = config.objects
    assert (obj.mesh, obj.unit, obj.centre) == (tmp_path / "mesh" / "in_mm.stl", "mm", True)
    T = configured_pose(obj.initial_pose, AT_US)
    assert error_deg(T, truth) < 3 and torch.allclose(T[:3, 3], moved(truth, middle)[:3, 3], atol=0.01)
    # The contours are there in red, and the events in grey.
    image = cv2.imread(str(tmp_path / "pose.png")).astype(int)
    assert ((image[..., 2] > 200) & (image[..., 0] < 100)).sum() > 500
    assert ((image > 100).all(2) & (np.ptp(image, axis=2) == 0)).sum() > 500


def moved(T_cam_obj, origin_obj):
    """The pose of the same object with another point as its origin."""
    T = T_cam_obj.clone()
    T[:3, 3] += T[:3, :3] @ origin_obj
    return T


def test_a_block_goes_into_a_config(scene, tmp_path):
    folder, truth = scene
    block = yaml.safe_load(as_block(truth, "bracket", AT_US))
    config = {"source": str(folder / "bracket.npz"), "start_us": AT_US, "objects": [{"label": "bracket", **block}]}
    (tmp_path / "bracket.yaml").write_text(yaml.safe_dump(config))
    pose = load(RunConfig, tmp_path / "bracket.yaml").objects[0].initial_pose
    assert torch.allclose(torch.tensor(pose.translation_m, dtype=torch.float64), truth[:3, 3], atol=1e-6)


@pytest.mark.parametrize(
    ("more", "code", "message"),
    [
        ((), 2, "pose needs one of --points FILE, --near FILE, --search [--box u0,v0,u1,v1] or --browser, got none of them"),
        (("--search", "--browser"), 2, "got --search and --browser"),
        (("--search", "--port", "8080"), 2, "--port is where the page of --browser is"),
        (("--search", "--near", "a.yaml"), 2, "got --near and --search"),
        (("--near", "a.yaml", "--box", "1,2,3,4"), 2, "--box is where to --search"),
        (("--search", "--box", "1,2,3"), 2, "expected left, top, right and bottom side in pixels"),
        (("--search", "--box", "500,500,600,600"), 2, "is no part of the image of 120x90"),
        (("--search", "--box", "0,0,12,12"), 1, "at least 300 are needed: nothing moves there"),
        (("--search", "--box", "0,40,119,50"), 1, "in no rotation the object fills a box of this shape"),
        (("--search", "--label", "mug", "--mesh", "nowhere.obj"), 1, "nowhere.obj"),
        (("--points", "nowhere.csv"), 1, "file of picks 'nowhere.csv' does not exist"),
        (("--near", "nowhere.yaml"), 1, "nowhere.yaml"),
        (("--search", "--at-us", "90000000"), 1, "no events"),
        (("--search", "-o", "bracket.npz"), 1, "bracket.npz"),
        (("--search", "--config", "bracket.npz"), 1, "bracket.npz"),
        (("--search", "--config", "found.json"), 1, "'found.json': configs are .yaml files"),
        (("--search", "--picture", "pose.jpg"), 1, "'pose.jpg': pictures are .png files"),
    ],
)
def test_what_is_wrong_is_said(scene, monkeypatch, capsys, more, code, message):
    folder, _ = scene
    monkeypatch.chdir(folder)
    given = ["bracket.npz", "--mesh", "in_mm.stl", "--unit", "mm", "--at-us", AT_US]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchtrackWarning)
        assert command(*given, *more) == code
    shown = " ".join(capsys.readouterr().err.split())
    assert message in shown and "Traceback" not in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("bracket.npz", "--search"), "none is configured: give --mesh"),
        (("bracket.npz", "--search", "--unit", "mm"), "of the file that --mesh names"),
        (("two.yaml", "--search"), "there are a, b: say which, with --label"),
        (("two.yaml", "--search", "--label", "c"), "there is no 'c'; there are a, b"),
        (("two.yaml", "--label", "a", "--near", "two.yaml"), "the object has no initial_pose to look near"),
    ],
)
def test_which_object_is_meant(scene, monkeypatch, capsys, arguments, message):
    folder, _ = scene
    monkeypatch.chdir(folder)
    objects = [{"label": label, "mesh": "in_mm.stl", "unit": "mm"} for label in "ab"]
    (folder / "two.yaml").write_text(yaml.safe_dump({"source": "bracket.npz", "objects": objects}))
    assert command(*arguments) == 2
    assert message in " ".join(capsys.readouterr().err.split())
