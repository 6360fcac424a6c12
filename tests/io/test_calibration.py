"""Calibration files: DAVIS text and YAML, and what is wrong with those that are refused."""

import pytest

from torchtrack.core.camera import Camera
from torchtrack.errors import CalibrationError, MissingFileError
from torchtrack.io import read_calibration

YAML = """
fx: 199.5
fy: 198
cx: 132.25
cy: 110.5
width: 240
height: 180
"""


def save(tmp_path, text: str):
    path = tmp_path / "calib"
    path.write_text(text)
    return path


def test_recordings(data_dir):
    camera = read_calibration(data_dir / "recordings" / "shapes_rotation" / "calib.txt", 240, 180)
    assert camera == Camera(
        199.092366542,
        198.82882047,
        132.192071378,
        110.712660011,
        240,
        180,
        "plumb_bob",
        (-0.368436311798, 0.150947243557, -0.000296130534385, -0.000759431726241, 0.0),
    )
    assert read_calibration(data_dir / "recordings" / "slider_depth" / "calib.txt", 240, 180).fx == 335.419462958


@pytest.mark.parametrize(
    ("coefficients", "model"),
    [("", "none"), ("0 0 0 0 0", "none"), ("-0.3 0.1 0 0", "plumb_bob"), ("-0.3 0.1 0 0 0.01", "plumb_bob"), ("0.1 0 0 0 0 0.2 0 0", "plumb_bob")],
)
def test_davis_text(tmp_path, coefficients, model):
    camera = read_calibration(save(tmp_path, f"# fx fy cx cy ...\n200 201 120 90\n{coefficients}\n"), 240, 180)
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height) == (200, 201, 120, 90, 240, 180)
    assert camera.distortion_model == model
    assert camera.distortion == (tuple(map(float, coefficients.split())) if model != "none" else ())


@pytest.mark.parametrize(
    ("more", "model", "distortion"),
    [
        ("", "none", ()),
        ("distortion_model: fisheye\ndistortion: [0.1, 0, 0, 0]", "fisheye", (0.1, 0.0, 0.0, 0.0)),
        ("distortion_model: plumb_bob\ndistortion:\n- 0.1\n- 0.2\n- 0\n- 0\n", "plumb_bob", (0.1, 0.2, 0.0, 0.0)),
    ],
)
def test_yaml(tmp_path, more, model, distortion):
    assert read_calibration(save(tmp_path, YAML + more)) == Camera(199.5, 198.0, 132.25, 110.5, 240, 180, model, distortion)


def test_a_sensor_size_that_agrees_is_no_trouble(tmp_path):
    assert read_calibration(save(tmp_path, YAML), 240, 180).width == 240


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("200 201 120", "got 3 numbers"),
        ("200 201 120 90 1 2", "got 6 numbers"),
        ("0 201 120 90", "focal lengths must be positive"),
        ("200 201 nan 90", "finite"),
        ("", "expected 'fx fy cx cy k1 k2 p1 p2 k3', or YAML"),
        ("hello", "or YAML with fx, fy, cx, cy, width, height"),
        ("fx: [", "neither numbers nor YAML"),
        (YAML.replace("fx: 199.5", ""), "fx: Field required"),
        (YAML.replace("fx: 199.5", "fx: wide").replace("fy: 198", ""), "fx: .*; fy: Field required"),
        (YAML + "k1: 0.1", "k1: Extra inputs"),
        (YAML.replace("fx: 199.5", "fx: -1"), "focal lengths must be positive"),
        (YAML.replace("width: 240", "width: wide"), "width: "),
        (YAML + "distortion_model: barrel", "distortion_model: "),
        (YAML + "distortion: [0.1]", "takes 0 coefficients, got 1"),
        (YAML.replace("240", "640"), "width is 640 here, but 240 was given"),
    ],
)
def test_calibrations_that_are_refused(tmp_path, text, message):
    path = save(tmp_path, text)
    with pytest.raises(CalibrationError, match=message) as caught:
        read_calibration(path, 240, 180)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("size", [{}, {"width": 240}, {"height": 180}])
def test_davis_text_needs_the_sensor_size(tmp_path, size):
    with pytest.raises(CalibrationError, match=r"does not say the sensor size\. Give width and height"):
        read_calibration(save(tmp_path, "200 201 120 90 0 0 0 0 0"), **size)


def test_missing_file(tmp_path):
    with pytest.raises(MissingFileError, match=r"calibration file .* does not exist"):
        read_calibration(tmp_path / "calib.txt")
