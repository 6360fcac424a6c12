"""Pictures of what was tracked: the right colours at the right places, and videos that are whole or not there."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import torch
import trimesh

from torchtrack.core.camera import Camera, distort
from torchtrack.errors import TorchtrackError
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.frontend.time_surface import empty_last_event
from torchtrack.tracking.state import StepResult
from torchtrack.tracking.validation.status import Status
from torchtrack.viz import OverlayObject, OverlayWriter, draw_overlay, overlay_objects, save_still
from torchtrack.viz.lettering import write

CAMERA = Camera(200.0, 200.0, 119.5, 89.5, 240, 180)
SCALE = 4


def nothing(status: Status = Status.TRACKING) -> OverlayObject:
    none = np.zeros((0, 2))
    return OverlayObject("box", status, 0.9, none, np.zeros((0, 2), np.int64), None, none, none, None)


def quiet(camera: Camera = CAMERA) -> torch.Tensor:
    return empty_last_event(1, camera.height, camera.width)[0]


def block(image: np.ndarray, u: float, v: float, scale: int = SCALE) -> np.ndarray:
    """The part of the picture that shows a sensor pixel."""
    u, v = round(u), round(v)
    return image[v * scale : (v + 1) * scale, u * scale : (u + 1) * scale]


def has_colour(part: np.ndarray, colour: str) -> bool:
    b, g, r = part.reshape(-1, 3).astype(int).T
    rules = {"red": (r > 200) & (g < 90) & (b < 90), "green": (g > 200) & (r < 120) & (b < 120), "yellow": (g > 150) & (r > 150) & (b < 90)}
    return bool(rules[colour].any())


@pytest.mark.parametrize(("width", "height", "scale"), [(240, 180, 4), (346, 260, 3), (640, 480, 2), (1280, 720, 1)])
def test_small_sensors_are_enlarged(width: int, height: int, scale: int):
    camera = Camera(200.0, 200.0, width / 2, height / 2, width, height)
    image = draw_overlay(quiet(camera), 0, camera, [])
    assert image.shape == (height * scale, width * scale, 3)
    assert image.dtype == np.uint8


def test_time_surface_decays():
    newest = quiet()
    newest[120, 100], newest[120, 110], newest[120, 120] = 2_000_000, 1_970_000, 2_000_500
    for source in (newest, newest.numpy()):
        image = draw_overlay(source, 2_000_000, CAMERA, [], decay_s=0.03)
        assert (block(image, 100, 120) == 190).all()
        assert (block(image, 110, 120) == round(190 / np.e)).all()
        # An event after the time shown is not older than none.
        assert (block(image, 120, 120) == 190).all()
        assert block(image, 130, 120).max() == 0


def test_contours_in_red_truth_in_green():
    contour, truth = np.array([[50.0, 100.0], [200.4, 150.3]]), np.array([[120.0, 60.0], [np.nan, np.nan]])
    image = draw_overlay(quiet(), 0, CAMERA, [replace(nothing(), contour=contour, truth=truth)])
    for u, v in contour:
        assert has_colour(block(image, u, v), "red")
    assert has_colour(block(image, 120, 60), "green")
    assert not has_colour(block(image, 120, 60), "red")
    assert image[80 * SCALE :, 60 * SCALE : 190 * SCALE].max() == 0


def test_corners_and_their_flow():
    thing = replace(nothing(), corners=np.array([[100.0, 100.0], [30.0, 150.0]]), flow=np.array([[1000.0, 0.0], [0.0, 0.0]]))
    image = draw_overlay(quiet(), 0, CAMERA, [thing])
    assert has_colour(image[100 * SCALE - 4 : 101 * SCALE + 4, 110 * SCALE : 135 * SCALE], "yellow")
    assert has_colour(image[149 * SCALE : 152 * SCALE, 29 * SCALE : 32 * SCALE], "yellow")
    assert not has_colour(image[145 * SCALE : 155 * SCALE, 33 * SCALE : 60 * SCALE], "yellow")


def test_a_note_is_written_below_what_is_said_of_the_objects():
    plain, noted = (draw_overlay(quiet(), 0, CAMERA, [nothing()], note=note) for note in (None, "yellow: corners"))
    rows = np.flatnonzero((plain != noted).any((1, 2)))
    assert has_colour(noted[rows.min() : rows.max() + 1], "yellow")
    written = np.flatnonzero(plain.any((1, 2)))
    assert rows.max() > written.max()


def test_contour_points_are_joined_by_lines():
    contour, truth = np.array([[50.0, 100.0], [90.0, 100.0]]), np.array([[50.0, 140.0], [90.0, 140.0]])
    thing = replace(nothing(), contour=contour, truth=truth, links=np.array([[0, 1]]))
    image = draw_overlay(quiet(), 0, CAMERA, [thing])
    for u in range(50, 91):
        assert has_colour(block(image, u, 100), "red") and has_colour(block(image, u, 140), "green")
    # An end behind the camera: nothing is drawn to there.
    image = draw_overlay(quiet(), 0, CAMERA, [replace(thing, truth=np.array([[50.0, 140.0], [np.nan, np.nan]]))])
    assert has_colour(block(image, 50, 140), "green") and not has_colour(block(image, 60, 140), "green")


@pytest.mark.parametrize("ground", [0, 255])
def test_letters_are_legible_on_any_ground(ground: int):
    """Each is lighter than what is around it by more than half of the scale; letters and their ground are in one place."""
    image = np.full((40, 200, 3), ground, np.uint8)
    write(image, "box: tracking", (8, 22), (80, 255, 80))
    letters = np.argwhere(image[..., 1] > 200) if ground == 0 else np.argwhere((image != ground).any(-1))
    top, left, bottom, right = *letters.min(0), *letters.max(0)
    if ground == 0:
        top, left, bottom, right = top - 3, left - 3, bottom + 3, right + 3
    grey = image[top : bottom + 1, left : right + 1, 1].astype(int)
    assert 0.05 < (grey > 200).mean() < 0.4 and np.median(grey) <= 70
    # Dark ground on all sides of the letters.
    assert np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]]).max() <= 70


def test_text_outside_of_the_picture_is_left_out():
    image = picture(50)
    for at in ((-500, 20), (5, -100), (5, 500), (500, 20)):
        write(image, "box", at, (255, 255, 255))
    assert (image == 50).all()


@pytest.mark.parametrize(("status", "colour"), [(Status.TRACKING, "green"), (Status.LOST, "red")])
def test_status_is_written(status: Status, colour: str):
    image = draw_overlay(quiet(), 1_234_500, CAMERA, [nothing(status)])
    first, second = image[:28, :300], image[30:52, :300]
    assert first.max() == 255
    assert has_colour(second, colour)
    assert image[60:].max() == 0


def test_points_far_outside_are_left_out():
    far = np.array([[-1e9, 5.0], [5.0, 1e12], [300.0, 50.0], [np.inf, 0.0]])
    thing = replace(nothing(), contour=far, truth=far, corners=far, flow=np.full((4, 2), 1e15), axes=far)
    blank = draw_overlay(quiet(), 0, CAMERA, [nothing()])
    assert np.array_equal(draw_overlay(quiet(), 0, CAMERA, [thing]), blank)


def test_lens_is_drawn():
    camera = replace(CAMERA, distortion_model="plumb_bob", distortion=(-0.35, 0.1, 0.0, 0.0))
    ideal = np.array([[15.0, 60.0]])
    sensor = distort(ideal, camera)[0]
    assert np.linalg.norm(sensor - ideal[0]) > 3
    image = draw_overlay(quiet(camera), 0, camera, [replace(nothing(), contour=ideal)])
    assert has_colour(block(image, *sensor), "red")
    assert not has_colour(block(image, *ideal[0]), "red")


def box_result(T_cam_obj: torch.Tensor) -> StepResult:
    """A result with two contour points and two corners per object, the second of each masked."""
    count = len(T_cam_obj)
    points = torch.tensor([[0.05, 0.05, -0.05], [0.0, 0.0, 0.0]]).expand(count, 2, 3)
    pixels = torch.tensor([[70.0, 80.0], [1.0, 1.0]]).expand(count, 2, 2)
    mask = torch.tensor([True, False]).expand(count, 2)
    contours = Contours(
        points, torch.zeros(count, 2, 3), torch.zeros(count, 2, dtype=torch.int64), mask, points, pixels, pixels, torch.ones(count, 2)
    )
    flow, has_flow = torch.full((count, 2, 2), 7.0), torch.zeros(count, 2, dtype=torch.bool)
    corners = Corners(pixels.long(), pixels, torch.zeros(count, 2), mask, flow, has_flow, polarity=mask.float())
    status = torch.tensor([int(Status.TRACKING), int(Status.OUT_OF_VIEW)])[:count]
    share = torch.full((count,), 0.75)
    covariance = torch.eye(6, dtype=torch.float64).expand(count, 6, 6)
    return StepResult(torch.tensor([1000]), T_cam_obj, covariance, status, share, contours, corners, status)


def poses(*depths: float) -> torch.Tensor:
    T = torch.eye(4, dtype=torch.float64).repeat(len(depths), 1, 1)
    T[:, 2, 3] = torch.tensor(depths)
    return T


def test_objects_of_a_result():
    model = ObjectModel.from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)), name="box")
    T = poses(0.5, -0.5)
    first, second = overlay_objects(box_result(T), [model, model], CAMERA, names=["near", "behind"], true_poses=[T[0], None])
    assert (first.name, first.status, first.quality) == ("near", Status.TRACKING, 0.75)
    np.testing.assert_allclose(first.contour, [[70, 80]])
    # 5 cm aside, 45 cm away, 200 px focal length.
    assert first.truth is not None
    np.testing.assert_allclose(first.truth, [[119.5 + 200 / 9, 89.5 + 200 / 9]])
    np.testing.assert_allclose(first.corners, [[70, 80]])
    np.testing.assert_allclose(first.flow, [[0, 0]])
    length = 0.3 * model.diameter_m
    np.testing.assert_allclose(first.axes[:3], [[119.5, 89.5], [119.5 + 400 * length, 89.5], [119.5, 89.5 + 400 * length]], rtol=1e-6)
    assert (second.name, second.status) == ("behind", Status.OUT_OF_VIEW)
    assert second.truth is None
    assert second.axes is None
    image = draw_overlay(quiet(), 1000, CAMERA, [first, second])
    assert has_colour(block(image, 70, 80), "red")
    assert has_colour(block(image, 119.5 + 20, 89.5), "red")


def test_objects_of_one_stream():
    model = ObjectModel.from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)), name="box")
    result = box_result(poses(0.5, 0.5))
    assert [thing.status for thing in overlay_objects(result, [model, model], CAMERA, stream_index=[0, 1], stream=1)] == [Status.OUT_OF_VIEW]


def picture(value: int, height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def read_video(path: Path) -> list[float]:
    """Mean brightness of every frame."""
    video, means = cv2.VideoCapture(str(path)), []
    while (frame := video.read())[0]:
        means.append(float(frame[1].mean()))
    video.release()
    return means


def test_video_keeps_the_time_of_the_events(tmp_path: Path):
    """Pictures every 10 ms, and one gap; at a quarter of real time and 50 frames a second, a frame is due every 5 ms."""
    with OverlayWriter(tmp_path / "overlay.mp4", frames_per_second=50.0, slow_motion=4.0, stills=0) as writer:
        for t_us, value in ((0, 0), (10_000, 60), (11_000, 255), (20_000, 120), (50_000, 200)):
            assert writer.is_due(t_us) == (t_us != 11_000)
            writer.add(t_us, picture(value))
        assert not (tmp_path / "overlay.mp4").exists()
    expected = [0, 60, 60, 120, 120, 200, 200, 200, 200, 200, 200]
    np.testing.assert_allclose(read_video(tmp_path / "overlay.mp4"), expected, atol=6)
    assert [path.name for path in tmp_path.iterdir()] == ["overlay.mp4"]


def test_long_pauses_are_shortened(tmp_path: Path):
    with OverlayWriter(tmp_path / "overlay.mp4", frames_per_second=10.0, slow_motion=1.0, stills=0) as writer:
        writer.add(0, picture(0))
        writer.add(3_600_000_000, picture(100))
        assert not writer.is_due(3_600_000_000)
        writer.add(3_600_100_000, picture(200))
    assert len(read_video(tmp_path / "overlay.mp4")) == 1 + 21 + 1


def test_odd_sizes(tmp_path: Path):
    with OverlayWriter(tmp_path / "overlay.mp4", stills=1) as writer:
        writer.add(0, picture(100, 47, 63))
    assert len(read_video(tmp_path / "overlay.mp4")) == 1
    assert cv2.imread(str(tmp_path / "overlay_0.000s.png")).shape == (47, 63, 3)


@pytest.mark.parametrize("frames", [1, 3, 4, 37, 200])
def test_stills_are_spread_evenly(tmp_path: Path, frames: int):
    with OverlayWriter(tmp_path / "overlay.mp4", frames_per_second=100.0, slow_motion=1.0, stills=4) as writer:
        for number in range(frames):
            writer.add(number * 10_000, picture(number))
    stills = sorted(tmp_path.glob("overlay_*.png"))
    assert len(stills) == min(frames, 4)
    shown = [int(cv2.imread(str(path)).mean()) for path in stills]
    assert [f"overlay_{number * 0.01:.3f}s.png" for number in shown] == [path.name for path in stills]
    if frames > 4:
        np.testing.assert_allclose(np.array(shown) / frames, [0.125, 0.375, 0.625, 0.875], atol=0.1)


def test_error_leaves_nothing_behind(tmp_path: Path):
    with pytest.raises(ValueError, match="stop"), OverlayWriter(tmp_path / "overlay.mp4") as writer:
        writer.add(0, picture(0))
        raise ValueError("stop")
    assert not list(tmp_path.iterdir())


def test_without_a_picture_nothing_is_written(tmp_path: Path):
    with OverlayWriter(tmp_path / "overlay.mp4"):
        pass
    assert not list(tmp_path.iterdir())


def test_video_of_another_name(tmp_path: Path):
    with pytest.raises(TorchtrackError, match=r"cannot write the video '.*overlay\.avi': its name must end in \.mp4"):
        OverlayWriter(tmp_path / "overlay.avi").add(0, picture(0))
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit of file sizes")
def test_a_full_disk_is_an_error_and_leaves_no_video(tmp_path: Path):
    """A process may write files of so many bytes and no more: as on a disk that is full."""
    code = """
import resource, sys
import numpy as np
from torchtrack.viz import OverlayWriter
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
with OverlayWriter(sys.argv[1], stills=0) as writer:
    for number in range(40):
        writer.add(number * 10_000, np.roll(noise, 97 * number, 1))
"""
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "overlay.mp4"], capture_output=True, text=True, check=False)
    assert "OutputError: cannot write to" in done.stderr and "overlay.mp4'" in done.stderr
    assert not list(tmp_path.iterdir())


def events_like(number: int) -> np.ndarray:
    """A picture of 640x480 pixels, enlarged: noise in a fiftieth of them that is new in each picture, and edges that move on."""
    rng = np.random.default_rng(number)
    image = (rng.random((480, 640)) < 0.02) * rng.integers(30, 190, (480, 640))
    image[:, (np.arange(0, 640, 60) + number) % 640] = 190
    return np.repeat(np.repeat(np.repeat(image[..., None], 3, 2), 2, 0), 2, 1).astype(np.uint8)


def test_a_second_of_events_has_less_than_four_megabytes(tmp_path: Path):
    """A quarter of it, at the frame rate and the slowness of a run by default."""
    with OverlayWriter(tmp_path / "overlay.mp4", stills=0) as writer:
        for number in range(30):
            writer.add(round(number * 1e6 / 120), events_like(number))
    assert (tmp_path / "overlay.mp4").stat().st_size < 1_000_000
    with av.open(tmp_path / "overlay.mp4") as video:
        stream = video.streams.video[0]
        assert stream.codec_context.codec.canonical_name == "vp9" and stream.codec_context.pix_fmt == "yuv420p"


def test_pictures_of_different_sizes(tmp_path: Path):
    with pytest.raises(TorchtrackError, match=r"size of the first, \(48, 64\), got \(50, 64\)"), OverlayWriter(tmp_path / "overlay.mp4") as writer:
        writer.add(0, picture(0))
        writer.add(1_000_000, picture(0, 50))
    assert not list(tmp_path.iterdir())


def test_still_on_its_own(tmp_path: Path):
    save_still(tmp_path / "folder" / "still.png", picture(77))
    assert (cv2.imread(str(tmp_path / "folder" / "still.png")) == 77).all()
