"""Calibrations and poses as other tools write them."""

import json

import numpy as np
import pytest
import torch
from helpers import generator

from torchtrack.camera import Camera
from torchtrack.errors import CalibrationError, MissingFileError, PoseError
from torchtrack.io import Trajectory, read_calibration, read_trajectory, write_tum
from torchtrack.lie import quaternion_from_rotation, se3_exp

EXPECTED = Camera(500.0, 510.0, 320.5, 240.25, 640, 480, "plumb_bob", (-0.1, 0.01, 0.001, -0.002, 0.0))

OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 500., 0., 320.5, 0., 510., 240.25, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.1, 0.01, 0.001, -0.002, 0. ]
"""
ROS = """
image_width: 640
image_height: 480
camera_name: event_camera
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320.5, 0, 510, 240.25, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0.001, -0.002, 0]}
projection_matrix: {rows: 3, cols: 4, data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]}
"""
KALIBR = """
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.01, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [500.0, 510.0, 320.5, 240.25]
  resolution: [640, 480]
  rostopic: /dvs/image
cam1: {camera_model: pinhole, intrinsics: [1, 1, 1, 1], resolution: [10, 10]}
"""
METAVISION = json.dumps(
    {"type": "pinhole", "width": 640, "height": 480, "K": [500, 0, 320.5, 0, 510, 240.25, 0, 0, 1], "D": [-0.1, 0.01, 0.001, -0.002, 0]}
)


def saved(folder, text: str, name: str = "calibration.yaml"):
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize("text", [OPENCV, ROS, METAVISION], ids=["opencv", "ros", "metavision"])
def test_calibrations_of_other_tools(tmp_path, text):
    assert read_calibration(saved(tmp_path, text)) == EXPECTED


def test_kalibr_takes_the_first_camera(tmp_path):
    camera = read_calibration(saved(tmp_path, KALIBR))
    assert camera.distortion == EXPECTED.distortion[:4]
    assert (camera.fx, camera.cy, camera.width, camera.height) == (500.0, 240.25, 640, 480)


def test_kalibr_fisheye(tmp_path):
    assert read_calibration(saved(tmp_path, KALIBR.replace("radtan", "equidistant"))).distortion_model == "fisheye"


def test_zeros_that_are_too_many_are_left_out(tmp_path):
    wide = METAVISION.replace("-0.002, 0]", "-0.002, 0, 0, 0, 0, 0, 0, 0, 0, 0]")
    assert read_calibration(saved(tmp_path, wide)).distortion[:4] == EXPECTED.distortion[:4]
    assert read_calibration(saved(tmp_path, METAVISION.replace("[-0.1, 0.01, 0.001, -0.002, 0]", "[0, 0, 0, 0, 0]"))).distortion_model == "none"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (METAVISION.replace('"width": 640, ', ""), "does not say the sensor size"),
        (METAVISION.replace("640", "640.5"), "whole numbers"),
        (METAVISION.replace("[500, 0,", "[0,"), "9 numbers, got 8"),
        (METAVISION.replace('"K": [500', '"K": ["a"'), "must be numbers"),
        (METAVISION.replace("-0.002, 0]", "-0.002, 0, 1, 2, 3, 4, 5, 6, 7]"), "has 12 coefficients"),
        (KALIBR.replace("radtan", "fov"), "'fov' is not known"),
        (KALIBR.replace("camera_model: pinhole\n", "camera_model: omni\n"), "camera model 'omni'"),
        (KALIBR.replace("[500.0, ", "["), "fx, fy, cx, cy, got 3"),
    ],
)
def test_calibrations_that_are_wrong(tmp_path, text, reason):
    with pytest.raises(CalibrationError, match=reason):
        read_calibration(saved(tmp_path, text))


def test_a_size_that_disagrees(tmp_path):
    assert read_calibration(saved(tmp_path, METAVISION.replace('"width": 640, ', "")), 640, 480) == EXPECTED
    with pytest.raises(CalibrationError, match="width is 640 here, but 320 was given"):
        read_calibration(saved(tmp_path, METAVISION), 320, 480)


# ---- poses


@pytest.fixture
def trajectory() -> Trajectory:
    twists = 0.5 * torch.randn(5, 6, generator=generator(0), dtype=torch.float64)
    return Trajectory(torch.arange(5) * 10_000, se3_exp(twists))


def assert_close(read: Trajectory, expected: Trajectory, atol: float = 1e-9) -> None:
    assert torch.equal(read.t_us, expected.t_us)
    torch.testing.assert_close(read.T_cam_obj, expected.T_cam_obj, atol=atol, rtol=0)


def rows(trajectory: Trajectory) -> list[tuple[int, list[float], list[float]]]:
    quaternions = quaternion_from_rotation(trajectory.T_cam_obj[:, :3, :3]).tolist()
    return list(zip(trajectory.t_us.tolist(), trajectory.T_cam_obj[:, :3, 3].tolist(), quaternions, strict=True))


def test_tum(tmp_path, trajectory):
    write_tum(tmp_path / "poses.txt", trajectory)
    assert_close(read_trajectory(tmp_path / "poses.txt"), trajectory)


@pytest.mark.parametrize("header", ["t_us,tx,ty,tz,qx,qy,qz,qw", "timestamp, x, y, z, q_x, q_y, q_z, q_w"])
def test_csv(tmp_path, trajectory, header):
    time = (lambda t: str(t)) if "t_us" in header else (lambda t: f"{t / 1e6:.6f}")
    lines = [header, *(",".join([time(t), *map(repr, position), *map(repr, quaternion)]) for t, position, quaternion in rows(trajectory))]
    assert_close(read_trajectory(saved(tmp_path, "\n".join(lines), "poses.csv")), trajectory)


def bop(trajectory: Trajectory) -> str:
    images = {}
    for number, T in enumerate(trajectory.T_cam_obj.numpy()):
        pose = {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (1000 * T[:3, 3]).tolist()}
        images[str(number)] = [{**pose, "cam_t_m2c": [0, 0, 1], "obj_id": 9}, {**pose, "obj_id": 5}]
    return json.dumps(images)


def test_bop(tmp_path, trajectory):
    path = saved(tmp_path, bop(trajectory), "scene_gt.json")
    assert_close(read_trajectory(path, name="5", frame_us=10_000), trajectory)
    assert float(read_trajectory(path, frame_us=1).T_cam_obj[0, 2, 3]) == pytest.approx(0.001)
    with pytest.raises(PoseError, match="Give frame_us"):
        read_trajectory(path)


def optitrack(trajectory: Trajectory, unit: str = "Millimeters") -> str:
    scale = {"Meters": 1, "Millimeters": 1000}[unit]
    lines = [
        f"Format Version,1.23,Take Name,Take 1,Rotation Type,Quaternion,Length Units,{unit},Coordinate Space,Global",
        "",
        ",Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Marker",
        ",Name,mug,mug,mug,mug,mug,mug,mug,mug,mug:1",
        ",ID,1,1,1,1,1,1,1,1,2",
        ",,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position",
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X",
    ]
    for number, (t, position, quaternion) in enumerate(rows(trajectory)):
        lines.append(",".join([str(number), f"{t / 1e6:.6f}", *map(repr, quaternion), *(repr(scale * value) for value in position), "0.1", "7"]))
    return "\n".join([*lines, "99,0.99,,,,,,,,,"])


@pytest.mark.parametrize("unit", ["Meters", "Millimeters"])
def test_optitrack(tmp_path, trajectory, unit):
    path = saved(tmp_path, optitrack(trajectory, unit), "take.csv")
    assert_close(read_trajectory(path), trajectory)
    assert_close(read_trajectory(path, name="mug"), trajectory)
    with pytest.raises(PoseError, match="no rigid body 'cup'.*Those there are: mug"):
        read_trajectory(path, name="cup")


def test_poses_in_a_world_are_brought_to_the_camera(tmp_path, trajectory):
    T_cam_world = se3_exp(torch.full((6,), 0.1, dtype=torch.float64))
    path = saved(tmp_path, optitrack(trajectory), "take.csv")
    assert_close(read_trajectory(path, T_cam_world=T_cam_world), Trajectory(trajectory.t_us, T_cam_world @ trajectory.T_cam_obj))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("t,x,y,z\n1,2,3,4", "must name .*; it names t, tx, ty, tz"),
        ("t_us,x,y,z,qx,qy,qz,qw\n1,2,3,4,0,0,0,one", "line 2 cannot be read"),
        ("t_us,x,y,z,qx,qy,qz,qw\n1,2,3", "line 2 cannot be read"),
        ("t_us,x,y,z,qx,qy,qz,qw\n1,0,0,1,1,1,1,1", "norm 2, expected 1"),
        ("t_us,x,y,z,qx,qy,qz,qw\n", "at least one pose"),
        ('{"0": [{"obj": 1}]}', "not the scene_gt.json of BOP"),
        ("{", "not the scene_gt.json of BOP"),
        ("Format Version,1.23\n", "no line 'Frame"),
    ],
)
def test_poses_that_are_wrong(tmp_path, text, reason):
    with pytest.raises(PoseError, match=reason):
        read_trajectory(saved(tmp_path, text, "poses.csv"), frame_us=1)


def test_optitrack_that_is_wrong(tmp_path, trajectory):
    text = optitrack(trajectory)
    for old, new, reason in (
        ("Quaternion", "XYZ", "of type XYZ"),
        ("Millimeters", "Furlongs", "'furlongs' is not known"),
        ("Rigid Body", "Bone", "no rigid body"),
        ("0.010000", "0.0x", "frame 1 cannot be read"),
    ):
        with pytest.raises(PoseError, match=reason):
            read_trajectory(saved(tmp_path, text.replace(old, new), "take.csv"))
    with pytest.raises(MissingFileError):
        read_trajectory(tmp_path / "nowhere.csv")


def test_half_a_numpy_array_is_no_pose(tmp_path):
    with pytest.raises(PoseError):
        read_trajectory(saved(tmp_path, str(np.eye(4)), "poses.txt"))
