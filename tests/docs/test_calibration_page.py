"""docs/calibration.md: its script calibrates a camera from events of a blinking board, and what it writes is read."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from torchtrack.cli.main import main
from torchtrack.core.camera import Camera, undistort
from torchtrack.io import read_calibration
from torchtrack.io.convert import convert
from torchtrack.io.formats import Input

PAGE = Path(__file__).resolve().parents[2] / "docs" / "calibration.md"
TRUE = Camera(331.0, 330.6, 170.2, 131.6, 346, 260, "plumb_bob", (-0.36, 0.14, 0.0005, -0.0008, 0.0))
SQUARE_M, COLUMNS, ROWS = 0.025, 9, 6
VIEWS, FINE = 16, 2


def brightness(T_cam_board):
    """How bright each pixel sees the board ``[h, w]``: white squares and a white border, dark beside them."""
    v, u = np.mgrid[: TRUE.height * FINE, : TRUE.width * FINE]
    ideal = undistort((np.stack([u.ravel(), v.ravel()], 1) + 0.5) / FINE - 0.5, TRUE)
    rays = np.concatenate([(ideal - [TRUE.cx, TRUE.cy]) / [TRUE.fx, TRUE.fy], np.ones((len(ideal), 1))], 1)
    on_board = np.linalg.solve(T_cam_board[:3, [0, 1, 3]], rays.T).T
    # In squares, from the corner of the board.
    at = on_board[:, :2] / on_board[:, 2:] / SQUARE_M
    column, row = np.floor(at).astype(int).T
    on_squares = (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
    on_border = (at > -0.6).all(1) & (at[:, 0] < COLUMNS + 0.6) & (at[:, 1] < ROWS + 0.6) & ~on_squares
    white = on_border | (on_squares & ((column + row) % 2 == 0))
    return white.reshape(TRUE.height, FINE, TRUE.width, FINE).mean((1, 3))


def rays(pixels, camera):
    """Unit vectors ``[n, 3]`` of where pixels look."""
    ideal = (undistort(pixels, camera) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    vectors = np.concatenate([ideal, np.ones((len(ideal), 1))], 1)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def view(number, random):
    """A pose of the board before the camera, tilted, in another part of the image each time."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([*random.uniform(-0.6, 0.6, 2), random.uniform(-0.3, 0.3)]))[0]
    middle = np.array([(number % 3 - 1) * 0.05, (number // 3 % 3 - 1) * 0.035, random.uniform(0.24, 0.36)])
    T[:3, 3] = middle - T[:3, :3] @ (SQUARE_M * np.array([COLUMNS / 2, ROWS / 2, 0]))
    return T


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """The folder in which the page's script has calibrated, and what it said."""
    folder, random, parts = tmp_path_factory.mktemp("board"), np.random.default_rng(0), []
    for number in range(VIEWS):
        counts = random.poisson(4 * brightness(view(number, random)) + 0.1)
        y, x = (np.repeat(at, counts[counts > 0]) for at in np.nonzero(counts))
        mixed = random.permutation(len(x))
        parts.append((x[mixed], y[mixed], 200_000 * number + np.sort(random.integers(1, 200_000, len(x)))))
    x, y, t_us = (np.concatenate(values) for values in zip(*parts, strict=True))
    np.savez(folder / "board.npz", x=x.astype(np.uint16), y=y.astype(np.uint16), t=t_us, p=np.arange(len(t_us)) % 2)
    convert(Input(folder / "board.npz", TRUE.width, TRUE.height), folder / "board.raw")
    (code,) = re.findall(r"^```python file calibrate.py\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (folder / "calibrate.py").write_text(code, encoding="utf-8")
    done = subprocess.run([sys.executable, "calibrate.py"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_what_the_script_prints(calibrated):
    said = re.fullmatch(r"(\d+) boards, reprojection error (\d\.\d\d) px, corners cover (\d+)% of the image\n", calibrated[1])
    assert said and int(said[1]) >= 8 and float(said[2]) < 0.5 and int(said[3]) >= 80


def test_the_camera_is_found(calibrated):
    camera = read_calibration(calibrated[0] / "camera.yaml")
    assert (camera.width, camera.height, camera.distortion_model) == (TRUE.width, TRUE.height, "plumb_bob")
    assert np.allclose([camera.fx, camera.fy], [TRUE.fx, TRUE.fy], rtol=0.01)
    assert np.allclose([camera.cx, camera.cy], [TRUE.cx, TRUE.cy], atol=3)
    # What counts is the angle between what two pixels see: the principal point can be exchanged for a turn of the camera.
    v, u = np.mgrid[10 : TRUE.height : 20, 10 : TRUE.width : 20]
    true, calibrated_rays = (rays(np.stack([u.ravel(), v.ravel()], 1).astype(float), seen_by) for seen_by in (TRUE, camera))
    left, _, right = np.linalg.svd(calibrated_rays.T @ true)
    off_px = TRUE.fx * np.linalg.norm(calibrated_rays @ (left @ right) - true, axis=1)
    assert np.median(off_px) < 1 and off_px.max() < 4


def test_events_are_drawn_without_distortion(calibrated, monkeypatch):
    monkeypatch.chdir(calibrated[0])
    for name, more in (("as_seen.png", []), ("straight.png", ["--calibration", "camera.yaml"])):
        assert main(["info", "board.raw", "--picture", name, *more]) == 0
    as_seen, straight = (cv2.imread(str(calibrated[0] / name)) for name in ("as_seen.png", "straight.png"))
    assert as_seen.shape == straight.shape and (as_seen != straight).any()
