"""Sequences: what the shared ones hold, round trips, and every way in which one can be wrong."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from helpers import random_events, random_pose
from io_files import everything
from PIL import Image

from torchtrack.core.camera import Camera
from torchtrack.core.events import concatenate
from torchtrack.errors import CalibrationError, EventDataError, MissingFileError, PoseError, TorchtrackWarning, UnknownFormatError
from torchtrack.io import LabelledMesh, Trajectory, read_sequence, write_sequence

CAMERA = Camera(60.0, 61.0, 31.5, 23.5, 64, 48)
LENS = Camera(60.0, 61.0, 31.5, 23.5, 64, 48, "plumb_bob", (-0.1, 0.02, 0.001, 0.0, 0.0))
TIMES = torch.tensor([0, 5_000, 10_000])
EVENTS = random_events(500, width=64, height=48)


def textured_box() -> trimesh.Trimesh:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    uv = np.random.default_rng(0).random((len(box.vertices), 2))
    image = Image.fromarray(np.random.default_rng(1).integers(0, 255, (8, 8, 3), dtype=np.uint8))
    box.visual = trimesh.visual.TextureVisuals(uv=uv, image=image)
    return box


def contents(objects: int = 1, camera: Camera = CAMERA) -> dict:
    """Arguments of write_sequence."""
    return {
        "events": EVENTS,
        "camera": camera,
        "objects": [labelled(f"object{i}", height_m=0.1 + 0.1 * i, seed=i) for i in range(objects)],
        "meta": {"speed": "slow", "seed": 3},
    }


def labelled(label, height_m=0.1, t_us=TIMES, seed=0) -> LabelledMesh:
    """A box and three true poses."""
    return LabelledMesh(label, trimesh.creation.box((0.1, 0.2, height_m)), Trajectory(t_us, random_pose(3, seed=seed)))


@pytest.fixture
def written(tmp_path):
    """A valid sequence of two objects, and a way to change arrays of it."""
    path = tmp_path / "scene.npz"
    write_sequence(path, **contents(2))

    def change(**arrays) -> None:
        with np.load(path) as stored:
            kept = {key: stored[key] for key in stored.files}
        np.savez(path, **{key: value for key, value in {**kept, **arrays}.items() if value is not None})

    return path, change


# ---- shared sequences

EXPECTED = {
    "ape_messy": (775078, ["ape"], [], 1501),
    "ape_normal": (741733, ["ape"], [], 1501),
    "ape_occl": (4801943, ["ape"], [], 1501),
    "book_normal": (2487418, ["book"], ["book"], 601),
    "bunny_normal": (1184514, ["bunny"], [], 1501),
    "bunny_realistic": (1488438, ["bunny"], [], 1501),
    "cube_slow": (1538583, ["cube"], ["cube"], 1001),
    "lbracket_fast": (2131297, ["lbracket"], [], 1001),
    "lbracket_normal": (1252254, ["lbracket"], [], 1501),
    "satellite_normal": (1840683, ["satellite"], [], 1501),
    "three_normal": (2738322, ["cube", "lbracket", "bunny"], ["cube"], 1501),
}


@pytest.mark.parametrize(("name", "facts"), EXPECTED.items(), ids=EXPECTED)
def test_shared_sequences(data_dir, name, facts):
    count, labels, textured, poses = facts
    sequence = read_sequence(data_dir / "sequences" / f"{name}.npz")
    assert sequence.name == sequence.meta["name"] == name
    assert sequence.camera == Camera(612.3, 610.9, 318.2, 241.7, 640, 480)
    assert [of_object.label for of_object in sequence.objects] == labels
    assert [of_object.label for of_object in sequence.objects if of_object.textured_path] == textured
    assert all(len(of_object.ground_truth) == poses for of_object in sequence.objects)
    assert all(of_object.mesh_path.is_file() for of_object in sequence.objects)
    chunks = list(sequence.events.chunks())
    assert sum(len(chunk) for chunk in chunks) == count
    assert 0 <= int(chunks[0].t_us[0]) <= 20


def test_model_path_falls_back_to_the_geometry(data_dir):
    cube, bracket, _ = read_sequence(data_dir / "sequences" / "three_normal.npz").objects
    assert cube.model_path("textured").name == "three_normal_cube_textured.glb"
    assert cube.model_path("geometry").name == "three_normal_cube.ply"
    assert bracket.model_path("textured") == bracket.model_path("geometry") == bracket.mesh_path


# ---- round trips


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("objects", [1, 3])
def test_what_is_written_is_read(tmp_path, objects, camera):
    given = contents(objects, camera)
    write_sequence(tmp_path / "new" / "scene.npz", **given)
    sequence = read_sequence(tmp_path / "new" / "scene.npz")
    assert (sequence.name, sequence.camera, sequence.meta) == ("scene", camera, given["meta"])
    events = concatenate(sequence.events.chunks(100))
    for name in ("x", "y", "t_us", "polarity"):
        assert torch.equal(getattr(events, name), getattr(EVENTS, name))
    for of_object, expected in zip(sequence.objects, given["objects"], strict=True):
        assert of_object.label == expected.label
        assert of_object.textured_path is None
        assert torch.equal(of_object.ground_truth.t_us, expected.trajectory.t_us)
        assert torch.equal(of_object.ground_truth.T_cam_obj, expected.trajectory.T_cam_obj)
        np.testing.assert_allclose(trimesh.load_mesh(of_object.mesh_path).extents, expected.mesh.extents, atol=1e-6)
    assert len(list((tmp_path / "new").iterdir())) == 1 + objects


def test_it_has_the_layout_of_the_shared_sequences(tmp_path):
    write_sequence(tmp_path / "one.npz", **contents(1))
    write_sequence(tmp_path / "two.npz", **contents(2))
    with np.load(tmp_path / "one.npz", allow_pickle=False) as first, np.load(tmp_path / "two.npz", allow_pickle=False) as two:
        assert [str(first[key].dtype) for key in "txyp"] == ["int64", "uint16", "uint16", "uint8"]
        assert first["poses"].shape == (3, 4, 4)
        assert two["poses"].shape == (2, 3, 4, 4)
        assert first["pose_t"].tolist() == TIMES.tolist()
        assert two["mesh_files"].tolist() == ["two_object0.ply", "two_object1.ply"]
        assert json.loads(str(first["meta"]))["speed"] == "slow"


def test_textured_models_lie_beside_it(tmp_path):
    box = textured_box()
    plain, given = labelled("object0"), contents()
    given["objects"] = [plain, LabelledMesh("object1", box, plain.trajectory, textured=box)]
    write_sequence(tmp_path / "scene.npz", **given)
    first, second = read_sequence(tmp_path / "scene.npz").objects
    assert first.textured_path is None
    assert second.model_path("textured").name == "scene_object1_textured.glb"
    assert b"texture" not in second.mesh_path.read_bytes()[:400].lower()
    loaded = trimesh.load(second.textured_path, force="mesh")
    assert loaded.visual.kind == "texture"


def test_ground_truth_is_optional(written):
    path, change = written
    change(poses=None, pose_t=None, meta=None)
    sequence = read_sequence(path)
    assert all(of_object.ground_truth is None for of_object in sequence.objects)
    assert sequence.meta == {}


# ---- what is refused


def test_missing_sequence(tmp_path):
    with pytest.raises(MissingFileError, match=r"nowhere\.npz' does not exist"):
        read_sequence(tmp_path / "nowhere.npz")


def test_not_a_sequence(tmp_path):
    (tmp_path / "scene.npz").write_text("hello")
    with pytest.raises(UnknownFormatError, match=r"not an \.npz file"):
        read_sequence(tmp_path / "scene.npz")


def test_a_missing_mesh_is_named_with_its_key(written):
    path, _ = written
    path.with_name("scene_object1.ply").unlink()
    with pytest.raises(MissingFileError, match=r"names the mesh 'scene_object1\.ply' for its object 'object1' \(key 'mesh_files'\)"):
        read_sequence(path)


def bad_poses(change) -> np.ndarray:
    poses = random_pose(2, 3).numpy()
    change(poses)
    return poses


def scale(poses):
    poses[1, 2, :3, :3] *= 1.1


def lose(poses):
    poses[0, 0, 0, 3] = np.nan


@pytest.mark.parametrize(
    ("arrays", "error", "message"),
    [
        ({"labels": None}, EventDataError, "has no array 'labels'"),
        ({"K": None}, EventDataError, "has no array 'K'"),
        ({"width": None}, EventDataError, "does not say the sensor's width"),
        ({"pose_t": None}, EventDataError, "has no array 'pose_t'"),
        ({"labels": np.array(["object0"])}, EventDataError, "got 1 and 2"),
        ({"labels": np.array([]), "mesh_files": np.array([])}, EventDataError, "'labels' must be a list of texts"),
        ({"labels": np.zeros(0, "<U1"), "mesh_files": np.zeros(0, "<U1")}, EventDataError, "one or more objects"),
        ({"labels": np.array("object0")}, EventDataError, "'labels' must be a list of texts"),
        ({"labels": np.array(["a", None], dtype=object)}, EventDataError, "'labels' holds Python objects"),
        ({"K": np.eye(4)}, CalibrationError, "must be 3x3"),
        ({"K": np.diag([0.0, 600, 1])}, CalibrationError, "focal lengths must be positive"),
        ({"K": np.full((3, 3), np.nan)}, CalibrationError, "finite"),
        ({"K": np.array([["a"] * 3] * 3)}, EventDataError, "'K' must hold numbers"),
        ({"distortion_model": np.array("barrel"), "distortion": np.zeros(4)}, CalibrationError, "unknown distortion model 'barrel'"),
        ({"distortion_model": np.array("plumb_bob"), "distortion": np.zeros(3)}, CalibrationError, "coefficients, got 3"),
        ({"poses": random_pose(3).numpy()}, EventDataError, r"\[2, P, 4, 4\] for its 2 labels.*got \(3, 4, 4\) and \(3,\)"),
        ({"poses": random_pose(2, 4).numpy()}, EventDataError, r"got \(2, 4, 4, 4\) and \(3,\)"),
        ({"pose_t": np.int64(3)}, EventDataError, r"got \(2, 3, 4, 4\) and \(\)"),
        ({"pose_t": np.array([0, 5, 5])}, PoseError, r"scene\.npz', poses: .*pose 2 is at 5 µs after 5 µs"),
        ({"pose_t": np.array([0.0, 0.1, 0.2])}, PoseError, "integer microseconds"),
        ({"poses": bad_poses(scale)}, PoseError, "not a rotation"),
        ({"poses": bad_poses(lose)}, PoseError, "NaN"),
        ({"meta": np.array("{")}, EventDataError, "'meta' is not JSON"),
        ({"t": None}, EventDataError, "has no array 't'"),
    ],
)
def test_sequences_that_are_refused(written, arrays, error, message):
    path, change = written
    change(**arrays)
    with pytest.raises(error, match=message) as caught:
        read_sequence(path)
    assert "scene.npz" in str(caught.value)


def test_unsorted_events_are_found_as_they_are_streamed(written):
    path, change = written
    change(t=np.arange(500)[::-1].copy())
    with pytest.raises(EventDataError, match="time goes back"):
        list(read_sequence(path, strict=True).events.chunks())
    with pytest.warns(TorchtrackWarning, match="499 events that came late, sorted in"):
        events = everything(read_sequence(path).events)
    assert events.t_us.tolist() == list(range(500))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"events": replace(EVENTS, x=torch.full_like(EVENTS.x, 64))}, EventDataError, "outside the sensor of 64x48"),
        ({"events": replace(EVENTS, t_us=EVENTS.t_us.flip(0))}, EventDataError, "time goes back"),
        ({"objects": [labelled("a/b"), labelled("c")]}, EventDataError, "labels go into file names"),
        ({"objects": [labelled("a"), labelled("a")]}, EventDataError, "each must differ"),
        ({"objects": []}, EventDataError, "scene.npz' needs at least one object"),
        ({"objects": [labelled("a"), labelled("b", t_us=TIMES + 1)]}, PoseError, "must share their times"),
    ],
)
def test_what_write_sequence_refuses_leaves_nothing_behind(tmp_path, change, error, message):
    with pytest.raises(error, match=message):
        write_sequence(tmp_path / "scene.npz", **{**contents(2), **change})
    assert list(tmp_path.iterdir()) == []


def test_a_sequence_is_an_npz_file(tmp_path):
    with pytest.raises(EventDataError, match=r"written to a \.npz file"):
        write_sequence(tmp_path / "scene.h5", **contents())


def test_a_failure_while_writing_leaves_what_was_there(written, monkeypatch):
    path, _ = written
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}

    def full_disk(stream, **_):
        stream.write(b"PK")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", full_disk)
    with pytest.raises(OSError, match="disk full"):
        write_sequence(path, **{**contents(), "objects": [labelled("object0", height_m=0.3), labelled("object1", height_m=0.3)]})
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before
