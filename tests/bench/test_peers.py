"""Other libraries beside ours: the same inputs, the same results, and those named that are not installed."""

import builtins
import json

import cv2
import numpy as np
import pytest
import torch

from torchtrack.bench import scene
from torchtrack.bench.peers import filters, poses, surfaces, trackers
from torchtrack.bench.peers.comparison import Comparison
from torchtrack.bench.setup import Setup
from torchtrack.bench.solver import RESIDUALS, poses_of_points
from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main

QUICK = Setup(repeats=1)


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(poses, "COUNTS", (1, 2))
    monkeypatch.setattr(filters, "SIZES", ((64, 48),))
    monkeypatch.setattr(surfaces, "EVENTS", 2000)
    monkeypatch.setattr(scene, "DURATION_S", 0.04)
    monkeypatch.setattr(scene, "WARM_UP_WINDOWS", 6)


@pytest.fixture
def nothing_installed(monkeypatch):
    """Without any library that is not needed."""
    original = builtins.__import__

    def without(name, *args, **kwargs):
        if name.split(".")[0] in ("pypose", "theseus", "tonic", "dv_processing"):
            raise ImportError(f"No module named '{name}'")
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    for module in ("ximgproc", "rapid"):
        monkeypatch.delattr(cv2, module, raising=False)


def names_of(comparison):
    return [result.name for result in comparison.results]


def test_what_is_missing_is_named_and_the_rest_measured(tiny, nothing_installed, tmp_path, capsys):
    threads = cv2.getNumThreads()
    assert main(["bench", "peers", "-o", str(tmp_path), "--repeats", "1"]) == ExitCode.DONE
    assert cv2.getNumThreads() == threads
    content = json.loads((tmp_path / "bench_peers.json").read_text())
    names = [entry["name"] for entry in content["results"]]
    for expected in ("B=2: torchtrack", "B=2: SciPy", "B=2: OpenCV, over ours", "guided filter 64x48: kornia", "Harris 64x48: OpenCV"):
        assert expected in names
    assert not any(missing in name for name in names for missing in ("PyPose", "Theseus", "tonic", "dv-processing", "rapid"))
    text = "\n".join(content["notes"])
    for package in ("pypose", "theseus-ai", "tonic", "dv-processing", "opencv-contrib-python-headless"):
        assert f"pip install {package}" in text
    assert text.count("pip install pypose") == 1
    assert (tmp_path / "bench_peers_poses.png").is_file()


def test_all_that_are_here_find_the_same_poses(tiny):
    comparison = Comparison(QUICK)
    poses.compare(comparison)
    assert {"B=1: SciPy", "B=2: OpenCV"} <= set(names_of(comparison))
    notes = [note for note in comparison.notes if "poses" in note]
    assert len(notes) >= 4
    assert all("the same poses as ours" in note for note in notes)


def test_poses_that_differ_are_told(tiny, monkeypatch):
    monkeypatch.setattr(poses, "PEERS", {"Other": ("other", lambda given: lambda: given.T_start)})
    comparison = Comparison(QUICK)
    poses.compare(comparison)
    assert "B=2: Other: other poses than ours" in comparison.notes[1]


def test_what_would_take_too_long_is_left_out(tiny, monkeypatch):
    monkeypatch.setattr(poses, "MOST_S", 1e-9)
    comparison = Comparison(QUICK)
    poses.compare(comparison)
    assert "B=1: SciPy" in names_of(comparison) and "B=2: SciPy" not in names_of(comparison)
    assert any(note.startswith("SciPy: not measured from B=2 on") for note in comparison.notes)


def test_filters_are_equal_to_ours(tiny):
    comparison = Comparison(QUICK)
    filters.compare(comparison)
    equal = {note.partition(": equal")[0]: float(note.split("equal to ours to ")[1].split(",")[0]) for note in comparison.notes if "equal" in note}
    assert equal["guided filter 64x48: kornia"] < 1e-5
    assert equal["Harris 64x48: kornia"] < 1e-5
    assert all(value < 1e-3 for value in equal.values())


@pytest.mark.parametrize(
    ("library", "package", "note"), [("tonic", "tonic", "equal to ours to"), ("dv_processing", "dv-processing", "falls linearly")]
)
def test_surfaces_of_others(tiny, library, package, note):
    pytest.importorskip(library, reason=f"{library} is not installed: pip install {package}", exc_type=ImportError)
    comparison = Comparison(QUICK)
    surfaces.compare(comparison)
    assert any(note in line for line in comparison.notes)


def test_rapid_tracks_beside_ours(tiny):
    if not hasattr(cv2, "rapid"):
        pytest.skip("OpenCV's contributed modules are not installed: pip install opencv-contrib-python-headless")
    comparison = Comparison(QUICK)
    trackers.compare(comparison)
    assert names_of(comparison)[1] == "tracking an object, one window: OpenCV rapid"
    assert "median error" in comparison.notes[-1]


def test_rapid_is_given_images_of_the_surface_and_asked_for_every_window(tiny, monkeypatch):
    """With one that finds nothing in the place of OpenCV's, which few have."""
    pytest.importorskip("numba", reason="the simulator needs numba: pip install 'torchtrack[sim]'")
    calls = []

    class Rapid:
        @staticmethod
        def rapid(image, lines, reach, vertices, faces, K, rotation, translation):
            calls.append(image)
            return 1.0, rotation, translation, 0.0

    monkeypatch.setattr(cv2, "rapid", Rapid, raising=False)
    scene.simulated.cache_clear()
    comparison = Comparison(QUICK)
    trackers.compare(comparison)
    scene.simulated.cache_clear()
    assert names_of(comparison)[0] == "tracking an object, one window: torchtrack"
    assert all(image.shape == (480, 640) and image.dtype == np.uint8 and image.max() > 100 for image in calls)
    assert len(calls) % (8 * 3) == 0
    error_deg = float(comparison.notes[-1].split("median error ")[1].split("°")[0])
    assert error_deg > 0.1


def test_points_are_seen_in_both_coordinates():
    given = poses_of_points(3, torch.device("cpu")).problem
    assert given.points_obj.shape == (3, RESIDUALS, 3)
    assert torch.equal(given.points_obj[:, ::2], given.points_obj[:, 1::2])
    assert torch.equal(given.targets[:, ::2], given.targets[:, 1::2])
    assert given.directions[0, :2].tolist() == [[1, 0], [0, 1]]
