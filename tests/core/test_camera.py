"""Projection and distortion against OpenCV, and calibrations that make no sense."""

import cv2
import numpy as np
import pytest
import torch
from helpers import generator
from torch.autograd import gradcheck

from torchtrack.core.camera import MIN_DEPTH_M, Camera, distort, distortion_table, project, stack_tables, undistort, undistortion_table
from torchtrack.core.limits import Limits, limits
from torchtrack.errors import CalibrationError, LimitError, TorchtrackWarning

PINHOLE = Camera(612.3, 610.9, 318.2, 241.7, 640, 480)
LENSES = {
    "none": PINHOLE,
    "plumb_bob_4": Camera(400.0, 402.0, 318.0, 241.0, 640, 480, "plumb_bob", (-0.25, 0.08, 0.001, -0.0008)),
    "plumb_bob_5": Camera(199.092, 198.829, 132.192, 110.713, 240, 180, "plumb_bob", (-0.368436, 0.150947, -0.000296, -0.000759, 0.0)),
    "plumb_bob_5_k3": Camera(335.4, 335.4, 129.9, 99.2, 240, 180, "plumb_bob", (-0.1386, 0.0934, -0.0003, 0.0002, -0.02)),
    "plumb_bob_8": Camera(500.0, 500.0, 320.0, 240.0, 640, 480, "plumb_bob", (0.1, -0.05, 0.0005, -0.0004, 0.01, 0.2, -0.03, 0.005)),
    "fisheye": Camera(300.0, 301.0, 322.0, 238.0, 640, 480, "fisheye", (-0.02, 0.004, -0.002, 0.0003)),
}


def points_in_front(*batch: int, count: int = 20, dtype=torch.float64) -> torch.Tensor:
    points = torch.randn((*batch, count, 3), generator=generator(), dtype=dtype) * 0.2
    points[..., 2] = points[..., 2].abs() + 0.3
    return points


def pixels_of(camera: Camera) -> np.ndarray:
    """A grid over the sensor, its corners among it."""
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 25), np.linspace(0, camera.height - 1, 19))
    return np.stack([u.ravel(), v.ravel()], 1)


# ---- projection


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_projection_agrees_with_opencv(batch, dtype):
    points = points_in_front(*batch, dtype=dtype)
    pixels = project(points, PINHOLE.intrinsics(dtype).expand(*batch, 4))
    expected, _ = cv2.projectPoints(points.double().reshape(-1, 1, 3).numpy(), np.zeros(3), np.zeros(3), PINHOLE.matrix, None)
    assert pixels.shape == (*batch, 20, 2)
    np.testing.assert_allclose(pixels.double().reshape(-1, 2), expected[:, 0], atol=1e-3 if dtype == torch.float32 else 1e-10)


def test_the_principal_point_is_where_the_axis_meets_the_sensor():
    pixel = project(torch.tensor([[0.0, 0.0, 1.0]]), PINHOLE.intrinsics())
    assert torch.equal(pixel, PINHOLE.intrinsics()[None, 2:])


@pytest.mark.parametrize("depth", [0.0, -1e-9, -1.0, MIN_DEPTH_M])
def test_points_behind_the_camera_are_finite_with_finite_gradients(depth, dtype):
    points = torch.tensor([[0.1, -0.2, depth]], dtype=dtype, requires_grad=True)
    pixels = project(points, PINHOLE.intrinsics(dtype))
    pixels.sum().backward()
    assert bool(torch.isfinite(pixels).all())
    assert bool(torch.isfinite(points.grad).all())


def test_projection_is_differentiable_in_points_and_calibration():
    points = points_in_front(count=4).requires_grad_()
    intrinsics = PINHOLE.intrinsics(torch.float64).requires_grad_()
    assert gradcheck(project, (points, intrinsics), atol=1e-3)


# ---- distortion


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_undistortion_undoes_distortion(camera):
    sensor = pixels_of(camera)
    ideal = undistort(sensor, camera)
    np.testing.assert_allclose(distort(ideal, camera), sensor, atol=1e-4)
    np.testing.assert_allclose(undistort(distort(ideal, camera), camera), ideal, atol=1e-4)


@pytest.mark.parametrize("name", [name for name in LENSES if name.startswith("plumb_bob")])
def test_plumb_bob_agrees_with_opencv(name):
    camera, points = LENSES[name], points_in_front()
    expected, _ = cv2.projectPoints(points.numpy()[:, None], np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    ideal = project(points, camera.intrinsics(torch.float64)).numpy()
    np.testing.assert_allclose(distort(ideal, camera), expected[:, 0], atol=1e-8)


def test_fisheye_follows_its_formula():
    camera, points = LENSES["fisheye"], points_in_front().numpy()
    radius = np.hypot(points[:, 0], points[:, 1])
    theta = np.arctan2(radius, points[:, 2])
    k1, k2, k3, k4 = camera.distortion
    theta_d = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    expected = theta_d[:, None] * points[:, :2] / radius[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    ideal = project(torch.from_numpy(points), camera.intrinsics(torch.float64)).numpy()
    np.testing.assert_allclose(distort(ideal, camera), expected, atol=1e-8)


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_the_table_holds_the_ideal_pixel_of_every_sensor_pixel(camera):
    table = undistortion_table(camera)
    assert table.shape == (camera.height, camera.width, 2)
    assert table.dtype == torch.float32
    for u, v in [(0, 0), (camera.width - 1, 0), (17, 101), (camera.width - 1, camera.height - 1)]:
        np.testing.assert_allclose(table[v, u], undistort(np.array([[u, v]]), camera)[0], atol=1e-3)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(300.0, 300.0, 320.0, 240.0, 640, 480, "plumb_bob", (-0.5, 0.0, 0.0, 0.0)),
        Camera(200.0, 200.0, 320.0, 240.0, 640, 480, "plumb_bob", (-1.0, 0.3, 0.0, 0.0)),
        Camera(150.0, 150.0, 320.0, 240.0, 640, 480, "fisheye", (0.0, 0.0, 0.0, 0.0)),
    ],
    ids=["folds", "folds_more", "more_than_180_degrees"],
)
def test_a_distortion_that_cannot_be_undone_is_refused(camera):
    with pytest.raises(CalibrationError, match=r"cannot be undone at \d+ of 307200 pixels, first at"):
        undistortion_table(camera)


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_the_table_of_sensor_pixels_undoes_the_other(camera):
    border = 3
    table = distortion_table(camera, border)
    assert table.shape == (camera.height + 2 * border, camera.width + 2 * border, 2)
    for u, v in [(-3, -3), (0, 0), (camera.width + 2, 50), (100, camera.height - 1)]:
        np.testing.assert_allclose(undistort(table[v + border, u + border][None].numpy(), camera)[0], [u, v], atol=1e-3)


def test_no_distortion_changes_nothing():
    table = undistortion_table(PINHOLE)
    assert table[100, 200].tolist() == [200.0, 100.0]


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_no_pixels_are_no_trouble(camera):
    assert distort(np.zeros((0, 2)), camera).shape == (0, 2)
    assert undistort(np.zeros((0, 2)), camera).shape == (0, 2)


# ---- the camera itself


def test_matrix_round_trip():
    assert Camera.from_matrix(PINHOLE.matrix, 640, 480) == PINHOLE


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": float("nan")}, "finite"),
        ({"distortion_model": "plumb_bob", "distortion": (float("inf"), 0.0, 0.0, 0.0)}, "finite"),
        ({"fx": 0.0}, "focal lengths must be positive"),
        ({"fy": -600.0}, "focal lengths must be positive"),
        ({"width": 0}, "sensor size"),
        ({"height": -1}, "sensor size"),
        ({"distortion_model": "tangential"}, "use one of none, plumb_bob, fisheye"),
        ({"distortion_model": "plumb_bob", "distortion": (0.1, 0.2)}, "takes 4 or 5 or 8 coefficients, got 2"),
        ({"distortion_model": "fisheye", "distortion": (0.1,) * 5}, "takes 4 coefficients, got 5"),
        ({"distortion": (0.1,) * 4}, "takes 0 coefficients, got 4"),
    ],
)
def test_calibrations_that_make_no_sense(change, message):
    values = {"fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480, **change}
    with pytest.raises(CalibrationError, match=message):
        Camera(**values)


def test_a_camera_matrix_must_be_3x3():
    with pytest.raises(CalibrationError, match="3x3"):
        Camera.from_matrix(np.eye(4), 640, 480)


def test_tables_of_cameras_of_different_sizes_stack_without_change() -> None:
    small, large = (Camera(100.0, 100.0, w / 2, h / 2, w, h) for w, h in ((8, 6), (10, 12)))
    tables = [undistortion_table(camera) for camera in (small, large)]
    stacked = stack_tables(tables)
    assert stacked.shape == (2, 12, 10, 2)
    assert torch.equal(stacked[0, :6, :8], tables[0])
    assert torch.equal(stacked[1], tables[1])


# ---- numbers that no camera has, and numbers that few have

USUAL = {"fx": 600.0, "fy": 600.0, "cx": 320.0, "cy": 240.0, "width": 640, "height": 480}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0.93, "fy": 1.25, "cx": 0.5, "cy": 0.5}, "as short as fx=0.93.*normalised: multiply fx and cx by the width"),
        ({"fx": 4.2, "fy": 4.2}, "as short as .*in mm"),
        ({"fx": 60.0}, "as short as"),
        ({"fx": 600_000.0, "fy": 600_000.0}, "as long as"),
        ({"fx": 2000.0}, "as different as fx=2000, fy=600"),
        ({"cx": 2000.0}, "far outside the image: cx is 2000 for 640 pixels"),
        ({"cy": -500.0}, "far outside the image: cy is -500 for 480 pixels"),
        ({"distortion_model": "plumb_bob", "distortion": np.zeros((2, 2))}, r"shape \[n\], \[1, n\] or \[n, 1\], got \[2, 2\]"),
        ({"distortion_model": "plumb_bob", "distortion": "k1"}, "must be a list of numbers"),
        ({"distortion_model": "plumb_bob", "distortion": 0.1}, "must have shape"),
    ],
)
def test_numbers_that_no_camera_has(change, message):
    with pytest.raises(CalibrationError, match=message):
        Camera(**{**USUAL, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 800.0}, "fx=800 and fy=600 differ by more than 20 %"),
        ({"cx": 160.0, "cy": 120.0}, r"would be the middle of 321 x 241: is it for another resolution"),
        ({"cx": 640.0, "cy": 360.0}, "for another resolution"),
        ({"cx": 239.5, "cy": 319.5}, "width and height look exchanged"),
        ({"distortion_model": "plumb_bob", "distortion": (-0.1, 0.01, -0.2, 0.1)}, "p1=-0.2 and p2=0.1"),
    ],
)
def test_numbers_that_few_cameras_have_are_told(change, message):
    with pytest.warns(TorchtrackWarning, match=message):
        Camera(**{**USUAL, **change})


def test_of_a_region_of_an_image_the_size_says_nothing():
    region = Camera(600.0, 600.0, -900.0, 700.0, 8, 8, derived=True)
    assert region == Camera(600.0, 600.0, -900.0, 700.0, 8, 8, derived=True)
    with pytest.raises(CalibrationError, match="as long as|far outside"):
        Camera(600.0, 600.0, -900.0, 700.0, 8, 8)


@pytest.mark.parametrize("shape", [(5,), (1, 5), (5, 1)])
@pytest.mark.parametrize("kind", [np.array, torch.tensor, lambda values: torch.tensor(values, requires_grad=True), list])
def test_distortion_of_any_shape_and_kind(shape, kind):
    values = np.reshape([-0.1, 0.01, 0.001, -0.002, 0.0], shape).tolist()
    for camera in (Camera(**USUAL, distortion_model="plumb_bob", distortion=kind(values)), None):
        camera = camera or Camera.from_matrix(PINHOLE.matrix, 640, 480, "plumb_bob", kind(values))
        assert camera.distortion == pytest.approx((-0.1, 0.01, 0.001, -0.002, 0.0))
        assert hash(camera) == hash(camera)


def matrix(**entries: float) -> np.ndarray:
    K = PINHOLE.matrix
    for name, value in entries.items():
        K[int(name[1]), int(name[2])] = value
    return K


@pytest.mark.parametrize(
    ("K", "message"),
    [
        (matrix(k22=2.0), r"must be \[fx, 0, cx\]"),
        (PINHOLE.matrix.T, "It is transposed"),
        (matrix(k10=1.0), r"must be \[fx, 0, cx\]"),
        (matrix(k01=50.0), "a skew of 50, which moves pixels by up to 19"),
        (matrix(k00=np.nan), "finite"),
        (matrix(k00=-600.0), "focal lengths must be positive"),
        ([["a"]], "must hold numbers"),
    ],
)
def test_matrices_of_no_camera(K, message):
    with pytest.raises(CalibrationError, match=message):
        Camera.from_matrix(K, 640, 480)


def test_a_small_skew_is_left_out_and_told():
    with pytest.warns(TorchtrackWarning, match="a skew of 0.5 .up to 0.2 px., which is left out"):
        assert Camera.from_matrix(matrix(k01=0.5), 640, 480) == PINHOLE


def test_tables_larger_than_the_limit_are_refused_before_they_are_made():
    camera = Camera(8000.0, 8000.0, 4096.0, 4096.0, 8192, 8192)
    for table in (undistortion_table, lambda camera: distortion_table(camera, 3)):
        with pytest.raises(LimitError, match=r"limits\.sensor_pixels"):
            table(camera)
    with limits(Limits(sensor_pixels=100)), pytest.raises(LimitError, match=r"the camera of 640x480 pixels"):
        undistortion_table(PINHOLE)


@pytest.mark.parametrize("camera", LENSES.values(), ids=LENSES)
def test_tables_do_not_depend_on_the_bands_that_they_are_made_in(camera, monkeypatch):
    whole = undistortion_table(camera), distortion_table(camera, 3)
    monkeypatch.setattr("torchtrack.core.camera._BAND_PIXELS", 5000)
    assert torch.equal(undistortion_table(camera), whole[0])
    assert torch.equal(distortion_table(camera, 3), whole[1])
