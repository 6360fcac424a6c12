"""Calibrations and poses as other tools write them."""

import json
import warnings
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from helpers import generator

from torchtrack.core.camera import Camera
from torchtrack.core.lie import quaternion_from_rotation, se3_exp
from torchtrack.core.limits import Limits, limits
from torchtrack.errors import CalibrationError, LimitError, MissingFileError, PoseError, TorchtrackWarning
from torchtrack.io import Trajectory, read_calibration, read_trajectory, write_tum

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
cam1: {camera_model: pinhole, distortion_model: none, intrinsics: [300, 300, 172.5, 129.5], resolution: [346, 260]}
"""
METAVISION = json.dumps(
    {"type": "pinhole", "width": 640, "height": 480, "K": [500, 0, 320.5, 0, 510, 240.25, 0, 0, 1], "D": [-0.1, 0.01, 0.001, -0.002, 0]}
)


@contextmanager
def warnings_ignored():
    """What is told beside an error does not matter."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", TorchtrackWarning)
        yield


def saved(folder, text: str, name: str = "calibration.yaml"):
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize("text", [OPENCV, ROS, METAVISION], ids=["opencv", "ros", "metavision"])
def test_calibrations_of_other_tools(tmp_path, text):
    assert read_calibration(saved(tmp_path, text)) == EXPECTED


def test_kalibr_takes_the_first_camera_and_tells(tmp_path):
    with pytest.warns(TorchtrackWarning, match=r"2 cameras: 'cam0' \(/dvs/image, 640x480\), 'cam1' \(346x260\). 'cam0' is taken; camera.name"):
        camera = read_calibration(saved(tmp_path, KALIBR))
    assert camera.distortion == EXPECTED.distortion[:4]
    assert (camera.fx, camera.cy, camera.width, camera.height) == (500.0, 240.25, 640, 480)


@pytest.mark.parametrize(("name", "fx"), [("cam0", 500.0), ("/dvs/image", 500.0), ("cam1", 300.0)])
def test_the_camera_of_several_that_is_named(tmp_path, name, fx):
    assert read_calibration(saved(tmp_path, KALIBR), name=name).fx == fx


def test_of_several_cameras_the_one_of_the_given_size_is_taken_and_told(tmp_path):
    with pytest.warns(TorchtrackWarning, match="'cam1' is taken"):
        assert read_calibration(saved(tmp_path, KALIBR), 346, 260).fx == 300.0
    with warnings_ignored(), pytest.raises(CalibrationError, match="cam0: width is 640 here, but 240 was given"):
        read_calibration(saved(tmp_path, KALIBR), 240, 180)


@pytest.mark.parametrize(("text", "message"), [(KALIBR, r"'cam7' is no camera .* there are 'cam0' \(.*'cam1'"), (METAVISION, "the file holds one")])
def test_a_name_that_no_camera_has(tmp_path, text, message):
    with pytest.raises(CalibrationError, match=message):
        read_calibration(saved(tmp_path, text), name="cam7")


def test_kalibr_fisheye(tmp_path):
    assert read_calibration(saved(tmp_path, KALIBR.replace("radtan", "equidistant")), name="cam0").distortion_model == "fisheye"


def test_kalibr_without_a_size_takes_the_given_one(tmp_path):
    text = KALIBR.replace("  resolution: [640, 480]\n", "")
    assert read_calibration(saved(tmp_path, text), 640, 480, name="cam0").width == 640
    with pytest.raises(CalibrationError, match="cam0: this file does not say the sensor size"):
        read_calibration(saved(tmp_path, text), name="cam0")


# ---- which lens model


@pytest.mark.parametrize("flag", ["fisheye_model: 1", "fisheye: true", "is_fisheye: yes", "lens_model: fisheye", "camera_type: KannalaBrandt8"])
def test_a_key_that_says_fisheye(tmp_path, flag):
    text = f"{flag}\n" + ROS.replace("distortion_model: plumb_bob\n", "").replace(", -0.002, 0]", ", 0]").replace("cols: 5", "cols: 4")
    camera = read_calibration(saved(tmp_path, text))
    assert (camera.distortion_model, camera.distortion) == ("fisheye", (-0.1, 0.01, 0.001, 0.0))


def test_opencv_says_that_a_lens_is_no_fisheye(tmp_path):
    text = OPENCV.replace("image_width", "fisheye_model: 0\nimage_width").replace(", -0.002, 0. ]", ", -0.002 ]")
    assert read_calibration(saved(tmp_path, text)) == Camera(500.0, 510.0, 320.5, 240.25, 640, 480, "plumb_bob", EXPECTED.distortion[:4])


def test_four_coefficients_of_no_model_are_told(tmp_path):
    path = saved(tmp_path, METAVISION.replace("-0.002, 0]", "-0.002]"))
    with pytest.warns(TorchtrackWarning, match=f"{path}: no key says the lens model.*taken as k1 k2 p1 p2"):
        assert read_calibration(path).distortion_model == "plumb_bob"
    assert read_calibration(path, distortion_model="plumb_bob").distortion_model == "plumb_bob"
    assert read_calibration(path, distortion_model="fisheye").distortion_model == "fisheye"


def test_a_fisheye_lens_of_zeros_still_bends(tmp_path):
    text = ROS.replace("plumb_bob", "equidistant").replace("[-0.1, 0.01, 0.001, -0.002, 0]", "[0, 0, 0, 0]")
    assert read_calibration(saved(tmp_path, text)) == Camera(500.0, 510.0, 320.5, 240.25, 640, 480, "fisheye", (0.0, 0.0, 0.0, 0.0))


def test_a_type_of_another_thing_is_told(tmp_path):
    with pytest.warns(TorchtrackWarning, match="type is 'EVK4', which is no lens model"):
        assert read_calibration(saved(tmp_path, METAVISION.replace("pinhole", "EVK4"))) == EXPECTED


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("fisheye_model: 1\n" + ROS, "not clear: fisheye_model says fisheye, distortion_model says plumb_bob"),
        ("fisheye_model: 0\n" + ROS.replace("plumb_bob", "equidistant"), "not clear: fisheye_model says no fisheye"),
        ("fisheye_model: maybe\n" + ROS, "neither on .1. nor off"),
        ("omnidirectional: 1\n" + ROS, "omnidirectional"),
        ("xi: 0.9\n" + ROS, "MEI"),
        ("camera_model: mei\n" + ROS, "camera model 'mei' is not known"),
        ("type: omni\n" + ROS, "lens model 'omni' is not known"),
        (ROS.replace("plumb_bob", "none"), "'none', but there are distortion coefficients"),
        (ROS.replace("plumb_bob", "equidistant").replace("-0.002, 0]", "-0.002, 0.1]"), "has 5 coefficients here, but up to 4"),
        (ROS.replace("[-0.1, 0.01, 0.001, -0.002, 0]", "[-0.1, 0.01, 0.001]"), "takes 4 or 5 or 8 coefficients, got 3"),
        ("<?xml version='1.0'?><opencv_storage/>", "this is XML"),
        ("bag: 1\ncat: 2", "expected 'fx fy cx cy.*its keys are bag, cat"),
    ],
)
def test_lens_models_that_are_refused(tmp_path, text, reason):
    with pytest.raises(CalibrationError, match=reason):
        read_calibration(saved(tmp_path, text))


# ---- sizes by name


@pytest.mark.parametrize(
    "size",
    [
        '"image_size": {"height": 480, "width": 640}',
        '"image_size": [640, 480]',
        '"resolution": {"h": 480, "w": 640}',
        '"image_size": {"data": [640, 480]}',
    ],
)
def test_a_size_is_read_by_its_names(tmp_path, size):
    assert read_calibration(saved(tmp_path, METAVISION.replace('"width": 640, "height": 480', size))) == EXPECTED


@pytest.mark.parametrize(
    ("size", "reason"),
    [
        ('"image_size": {"a": 640, "b": 480}', "must be .width, height., or a mapping with width and height"),
        ('"image_size": [640]', "must be"),
        ('"image_size": "640x480"', "must be"),
        ('"width": 320, "image_size": [640, 480]', "width is 640 here, but 320 was given"),
        ('"width": true, "height": 480', "whole numbers"),
    ],
)
def test_sizes_that_are_refused(tmp_path, size, reason):
    with pytest.raises(CalibrationError, match=reason):
        read_calibration(saved(tmp_path, METAVISION.replace('"width": 640, "height": 480', size)))


# ---- ROS 2


def ros2(
    d: str = "[-0.1, 0.01, 0.001, -0.002, 0.0]", more: str = "binning_x: 0\nroi: {x_offset: 0, width: 0, do_rectify: false}\n", stamp: int = 1
) -> str:
    k = "".join(f"- {value}\n" for value in (500.0, 0.0, 320.5, 0.0, 510.0, 240.25, 0.0, 0.0, 1.0))
    head = f"header:\n  stamp: {{sec: {stamp}, nanosec: 2}}\n  frame_id: cam\nheight: 480\nwidth: 640\ndistortion_model: plumb_bob\n"
    return f"{head}d: {d}\nk:\n{k}r: [1, 0, 0, 0, 1, 0, 0, 0, 1]\np: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]\n{more}"


@pytest.mark.parametrize("text", [ros2(), ros2() + "---\n", ros2() + "---\n" + ros2(stamp=2) + "---\n"], ids=["one", "closed", "several"])
def test_camera_info_of_ros_2(tmp_path, text):
    assert read_calibration(saved(tmp_path, text)) == EXPECTED


def test_camera_infos_that_differ(tmp_path):
    with pytest.raises(CalibrationError, match="2 documents .parted by ---., and their cameras differ"):
        read_calibration(saved(tmp_path, ros2() + "---\n" + ros2("[0, 0, 0, 0, 0]")))


@pytest.mark.parametrize(
    ("more", "warning"),
    [("binning_x: 2\nbinning_y: 2\n", "binning is said"), ("roi: {x_offset: 8, width: 100}\n", "a region of interest .roi. is said")],
)
def test_parts_of_a_sensor_are_told(tmp_path, more, warning):
    with pytest.warns(TorchtrackWarning, match=warning):
        assert read_calibration(saved(tmp_path, ros2(more=more))) == EXPECTED


# ---- more tools


def test_dsec(tmp_path):
    cam = "camera_model: pinhole, distortion_coeffs: [-0.1, 0.01, 0.001, -0.002], distortion_model: radtan, resolution: [640, 480]"
    matrix = "camera_matrix: [500.0, 510.0, 320.5, 240.25]"
    text = f"intrinsics:\n  camRect0: {{{matrix}, resolution: [640, 480]}}\n  cam0: {{{matrix}, {cam}}}\nextrinsics: {{T_10: 1}}\n"
    with pytest.warns(TorchtrackWarning, match="'cam0' is taken"):
        assert read_calibration(saved(tmp_path, text)).distortion == EXPECTED.distortion[:4]
    assert read_calibration(saved(tmp_path, text), name="camRect0").distortion_model == "none"


def basalt(kind: str, extra: dict[str, float]) -> str:
    intrinsics = {"fx": 500.0, "fy": 510.0, "cx": 320.5, "cy": 240.25, **extra}
    return json.dumps({"value0": {"intrinsics": [{"camera_type": kind, "intrinsics": intrinsics}], "resolution": [[640, 480]]}})


def test_basalt(tmp_path):
    fisheye = read_calibration(saved(tmp_path, basalt("kb4", {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4})))
    assert (fisheye.distortion_model, fisheye.distortion) == ("fisheye", (0.1, 0.2, 0.3, 0.4))
    named = dict(zip(("k1", "k2", "p1", "p2", "k3"), EXPECTED.distortion, strict=True))
    assert read_calibration(saved(tmp_path, basalt("pinhole-radtan8", named))) == EXPECTED
    assert read_calibration(saved(tmp_path, basalt("pinhole", {}))).distortion_model == "none"
    with pytest.raises(CalibrationError, match="camera model 'ds' is not known"):
        read_calibration(saved(tmp_path, basalt("ds", {"xi": -0.2, "alpha": 0.5})))


def test_camodocal(tmp_path):
    of_lens = {
        "KANNALA_BRANDT": "projection_parameters: {k2: 0.1, k3: 0.2, k4: 0.3, k5: 0.4, mu: 500, mv: 510, u0: 320.5, v0: 240.25}",
        "PINHOLE": "distortion_parameters: {k1: -0.1, k2: 0.01, p1: 0.001, p2: -0.002}\n"
        "projection_parameters: {fx: 500, fy: 510, cx: 320.5, cy: 240.25}",
    }
    cameras = [
        read_calibration(saved(tmp_path, f"model_type: {kind}\nimage_width: 640\nimage_height: 480\n{text}\n")) for kind, text in of_lens.items()
    ]
    assert cameras[0] == Camera(500.0, 510.0, 320.5, 240.25, 640, 480, "fisheye", (0.1, 0.2, 0.3, 0.4))
    assert cameras[1] == Camera(500.0, 510.0, 320.5, 240.25, 640, 480, "plumb_bob", EXPECTED.distortion[:4])


def test_both_cameras_of_opencvs_stereo_sample(tmp_path):
    text = "M1: [500, 0, 320.5, 0, 510, 240.25, 0, 0, 1]\nD1: [-0.1, 0.01, 0.001, -0.002, 0]\nM2: [400, 0, 320, 0, 400, 240, 0, 0, 1]\n"
    assert read_calibration(saved(tmp_path, text), 640, 480, name="M1") == EXPECTED
    assert read_calibration(saved(tmp_path, text), 640, 480, name="M2").fx == 400.0


def test_json_may_be_indented_by_tabs(tmp_path):
    assert read_calibration(saved(tmp_path, json.dumps(json.loads(METAVISION), indent="\t"))) == EXPECTED


def test_utf_16(tmp_path):
    (tmp_path / "calibration.yaml").write_text(ROS, encoding="utf-16")
    assert read_calibration(tmp_path / "calibration.yaml") == EXPECTED


@pytest.mark.parametrize(
    "text",
    [
        ROS.replace("500", "2001-99-99", 1),
        ROS.replace("500", ".nan", 1),
        ROS.replace("500", "[500]", 1),
        ROS.replace("500", "9" * 5000, 1),
        METAVISION.replace("500", "9" * 400, 1),
        METAVISION.replace("500", "NaN", 1),
        METAVISION.replace("500", "null", 1),
        METAVISION.replace("640", "1e400"),
        "[" * 100_000,
        '{"a":' * 100_000,
        "? [1, 2]\n: 3\n" + ROS,
        "1: 2\n3: 4\n",
        "a: &a [1, 1, 1]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}' if n else '*a'] * 9)}]\n" for n in range(9)),
        "- 1\n- 2\n",
        '"\\ud800": 1\n' + ROS,
        ROS + "camera_matrix: 1\n",
        "\0",
        "cam0: {intrinsics: 5}\n",
        "intrinsics: {cam0: {}}\n",
        "value0: {intrinsics: [1]}\n",
        "value0: {intrinsics: [{intrinsics: {fx: 1}}], resolution: 5}\n",
        "M1: 1\n",
        "projection_parameters: {fx: 1}\n",
    ],
    ids=range(23),
)
def test_damaged_calibrations_are_clear_errors(tmp_path, text):
    path = saved(tmp_path, text)
    with warnings_ignored(), pytest.raises(CalibrationError) as caught:
        read_calibration(path)
    assert str(path) in str(caught.value)


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
        (KALIBR.replace("[500.0, ", "["), "9 numbers, got 3; or be fx, fy, cx, cy"),
    ],
)
def test_calibrations_that_are_wrong(tmp_path, text, reason):
    with pytest.raises(CalibrationError, match=reason):
        read_calibration(saved(tmp_path, text), name="cam0" if text.strip().startswith("cam0") else None)


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
    with pytest.warns(TorchtrackWarning, match=r"2 of obj_id: 9, 5\. '9' is taken"):
        assert float(read_trajectory(path, frame_us=1).T_cam_obj[0, 2, 3]) == pytest.approx(0.001)
    with pytest.raises(PoseError, match="no obj_id '7'. Those there are: 9, 5"):
        read_trajectory(path, name="7", frame_us=1)
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


# ---- times and units of poses


def csv_of(trajectory: Trajectory, time: str, scale: float, heading: str = "tx,ty,tz,qx,qy,qz,qw", metres: float = 1.0) -> str:
    lines = [
        ",".join([f"{t * scale:.9f}".rstrip("0").rstrip("."), *(repr(metres * value) for value in position), *map(repr, quaternion)])
        for t, position, quaternion in rows(trajectory)
    ]
    return "\n".join([f"{time},{heading}", *lines])


@pytest.fixture
def long_trajectory() -> Trajectory:
    twists = torch.arange(40, dtype=torch.float64)[:, None] * torch.full((6,), 0.01, dtype=torch.float64)
    return Trajectory(torch.arange(40) * 10_000, se3_exp(twists))


@pytest.mark.parametrize(
    ("time", "scale"), [("t", 1e-6), ("timestamp", 1e-6), ("t_ms", 1e-3), ("time_us", 1.0), ("#timestamp [ns]", 1e3), ("t_ns", 1e3)]
)
def test_the_unit_of_times_is_the_one_that_the_column_names(tmp_path, long_trajectory, time, scale):
    assert_close(read_trajectory(saved(tmp_path, csv_of(long_trajectory, time, scale), "poses.csv")), long_trajectory)


@pytest.mark.parametrize(("unit", "scale"), [("ms", 1e-3), ("us", 1.0), ("ns", 1e3)])
def test_times_that_cannot_be_seconds(tmp_path, long_trajectory, unit, scale):
    path = saved(tmp_path, csv_of(long_trajectory, "timestamp", scale), "poses.csv")
    with pytest.raises(PoseError, match=r"poses.csv.*cannot be seconds.*initial_pose.time_unit"):
        read_trajectory(path)
    assert_close(read_trajectory(path, time_unit=unit), long_trajectory)


def test_tum_in_nanoseconds(tmp_path, long_trajectory):
    lines = csv_of(long_trajectory, "t", 1e3).replace(",", " ").splitlines()[1:]
    path = saved(tmp_path, "\n".join(lines), "poses.txt")
    with pytest.raises(PoseError, match="cannot be seconds"):
        read_trajectory(path)
    assert_close(read_trajectory(path, time_unit="ns"), long_trajectory)


def test_euroc(tmp_path, long_trajectory):
    heading = ", p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_x [], q_RS_y [], q_RS_z [], q_RS_w []".lstrip(", ")
    assert_close(read_trajectory(saved(tmp_path, csv_of(long_trajectory, "#timestamp [ns]", 1e3, heading), "poses.csv")), long_trajectory)


def test_positions_in_a_unit_that_is_named(tmp_path, trajectory):
    text = csv_of(trajectory, "t_us", 1.0, "x [mm],y [mm],z [mm],qx,qy,qz,qw", 1e3)
    assert_close(read_trajectory(saved(tmp_path, text, "poses.csv")), trajectory)
    with pytest.raises(PoseError, match="the unit 'feet' is not known"):
        read_trajectory(saved(tmp_path, text.replace("mm", "feet"), "poses.csv"))


def test_a_column_that_is_named_twice(tmp_path, trajectory):
    with pytest.raises(PoseError, match="names tx more than once"):
        read_trajectory(saved(tmp_path, csv_of(trajectory, "t_us", 1.0, "tx,tx,ty,tz,qx,qy,qz,qw"), "poses.csv"))


def test_one_of_several_rigid_bodies_is_told(tmp_path, trajectory):
    lines = optitrack(trajectory).splitlines()
    twice = [lines[0], *(",".join([*(row := line.split(","))[:2], *row[2:9], *row[2:9]]) for line in lines[1:])]
    twice[3] = twice[3][::-1].replace("gum", "puc", 7)[::-1]
    path = saved(tmp_path, "\n".join(twice), "take.csv")
    with pytest.warns(TorchtrackWarning, match="2 of rigid body: mug, cup. 'mug' is taken; name"):
        assert_close(read_trajectory(path), trajectory)
    assert_close(read_trajectory(path, name="cup"), trajectory)


def test_too_many_poses_are_refused(tmp_path, trajectory):
    write_tum(tmp_path / "poses.txt", trajectory)
    with limits(Limits(poses=4)), pytest.raises(LimitError, match=r"limits\.poses"):
        read_trajectory(tmp_path / "poses.txt")
    with limits(Limits(pose_file_bytes=4)), pytest.raises(LimitError, match=r"limits\.pose_file_bytes"):
        read_trajectory(tmp_path / "poses.txt")


@pytest.mark.parametrize(
    "text",
    [
        ",,,,\n",
        ",\n",
        "a" * 200_000 + ",b\n",
        "t_us,x,y,z,qx,qy,qz,qw\n99999999999999999999,0,0,1,0,0,0,1",
        "t_us,x,y,z,qx,qy,qz,qw\n1,nan,0,1,0,0,0,1",
        "t_us,x,y,z,qx,qy,qz,qw\n1,0,0,1,0,0,0,nan",
        "t,x,y,z,qx,qy,qz,qw\n1e999,0,0,1,0,0,0,1",
        "1e999 0 0 1 0 0 0 1",
        "nan 0 0 1 0 0 0 1",
        "1 inf 0 1 0 0 0 1",
        '{"a":' * 100_000,
        '{"0": [{"obj_id": 1, "cam_R_m2c": [1], "cam_t_m2c": [0, 0, 1]}]}',
        '{"99999999999999999999": [{"obj_id": 1, "cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0, 0, 1]}]}',
        '{"0": [null]}',
        '{"0": 5}',
        "{}",
        "Format Version,1,Length Units\nFrame\n",
    ],
    ids=range(17),
)
def test_damaged_poses_are_clear_errors(tmp_path, text):
    path = saved(tmp_path, text, "poses.csv")
    with pytest.raises(PoseError) as caught:
        read_trajectory(path, frame_us=10)
    assert str(path) in str(caught.value)


def test_keyframes_at_whole_seconds(tmp_path, long_trajectory):
    lines = csv_of(long_trajectory, "t", 1e-4).replace(",", " ").splitlines()[1:]
    with_decimals = [line.replace(" ", ".0 ", 1) for line in lines]
    assert read_trajectory(saved(tmp_path, "\n".join(with_decimals), "poses.txt")).t_us[1] == 1_000_000
    path = saved(tmp_path, "\n".join(lines), "poses.txt")
    with pytest.warns(TorchtrackWarning, match="whole numbers, and taken for seconds"):
        assert read_trajectory(path).t_us[1] == 1_000_000
    assert read_trajectory(path, time_unit="s").t_us[1] == 1_000_000
