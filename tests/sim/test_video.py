"""Events of a given video."""

import math

import cv2
import numpy as np
import pytest
import torch
from pydantic import ValidationError

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.errors import EventDataError, MissingFileError, UnknownFormatError
from torchtrack.io import open_events
from torchtrack.sim.surface import srgb_to_linear
from torchtrack.sim.video import VideoConfig, between, events_of_video, video_frames, write_video_events

SIZE, RADIUS, STEP = (90, 60), 12, 5


def picture(number):
    """A light disc on dark ground, further right in every picture."""
    image = np.full((SIZE[1], SIZE[0], 3), 70, np.uint8)
    cv2.circle(image, (24 + STEP * number, 30), RADIUS, (220, 220, 220), -1, cv2.LINE_AA)
    return image


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "images").mkdir()
    for number in range(7):
        cv2.imwrite(str(tmp_path / "images" / f"{number:03d}.png"), picture(number))
    return tmp_path / "images"


def test_a_moving_disc_fires_where_its_edge_passes(folder):
    config = VideoConfig(video=folder, frames_per_second=100, noise="ideal")
    parts = list(events_of_video(config))
    assert [t_us for t_us, _, _ in parts] == [10_000 * number for number in range(1, 7)]
    assert {size for _, size, _ in parts} == {SIZE}
    x, t_us = (torch.cat([getattr(events, name) for _, _, events in parts]).double() for name in ("x", "t_us"))
    # What the leading edge swept over: between two half circles, which are 6 steps apart.
    light, dark = (float(srgb_to_linear(np.array(value / 255.0))) for value in (220, 70))
    per_pixel = math.floor((math.log(light + 0.005) - math.log(dark + 0.005)) / 0.2)
    assert len(x) == pytest.approx(2 * 6 * STEP * 2 * RADIUS * per_pixel, rel=0.1)
    rightmost = [float(x[(t_us > 10_000 * n) & (t_us <= 10_000 * (n + 1))].max()) for n in range(6)]
    assert rightmost == pytest.approx([24 + RADIUS + STEP * (n + 1) for n in range(6)], abs=1.5)


def test_between_frames_the_picture_moves(folder):
    config = VideoConfig(video=folder, frames_per_second=100)
    (_, first), (_, second), *_ = video_frames(config)
    pictures = dict(between(first, second, config))
    assert len(pictures) >= 2 * STEP
    halfway = min(pictures, key=lambda share: abs(share - 0.5))
    weight = pictures[halfway] - pictures[halfway].min()
    centre = float((weight * np.arange(SIZE[0])).sum() / weight.sum())
    ends = [float(((image - image.min()) * np.arange(SIZE[0])).sum() / (image - image.min()).sum()) for image in (first, second)]
    assert centre == pytest.approx((1 - halfway) * ends[0] + halfway * ends[1], abs=0.6)
    # Moved, not faded: as sharp as the frames.
    assert np.abs(np.diff(pictures[halfway], axis=1)).max() > 0.7 * np.abs(np.diff(first, axis=1)).max()
    faded = dict(between(first, second, config.model_copy(update={"interpolate": False})))
    assert list(faded) == [1.0]


def test_events_of_a_video_file_are_written_and_read_back(tmp_path, capsys):
    writer = cv2.VideoWriter(str(tmp_path / "disc.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 50.0, SIZE)
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no videos")
    for number in range(4):
        writer.write(picture(number))
    writer.release()
    out = tmp_path / "events.npz"
    assert main(["simulate", "--video", str(tmp_path / "disc.avi"), "-o", str(out), "--noise", "ideal"]) == ExitCode.DONE
    source = open_events(out)
    assert (source.width, source.height) == SIZE
    events = next(source.chunks())
    assert f"{len(events)} events" in capsys.readouterr().out
    assert 50_000 < int(events.t_us[-1]) <= 60_000


def test_times_can_come_from_a_file(folder, tmp_path):
    times = tmp_path / "times.txt"
    times.write_text("# seconds, name\n" + "".join(f"{1000.5 + 0.01 * n * n:.6f} {n:03d}.png\n" for n in range(7)))
    config = VideoConfig(video=folder, timestamps=times)
    assert [t_us for t_us, _ in video_frames(config)] == [round(10_000 * n * n) for n in range(7)]
    times.write_text("1.0\n2.0\n")
    with pytest.raises(EventDataError, match="one time"):
        list(video_frames(config))
    times.write_text("1.0\n1.0\n" * 4)
    with pytest.raises(EventDataError, match="increasing"):
        list(video_frames(config))
    times.write_text("soon\n")
    with pytest.raises(EventDataError, match="time in seconds"):
        list(video_frames(config))
    for wild in ("nan", "inf", "-inf", "1e300"):
        times.write_text(f"0.0\n{wild}\n2.0\n" + "".join(f"{n}\n" for n in range(3, 8)))
        with pytest.raises(EventDataError, match=r"times\.txt' has a time of .* s\. Give each frame's time in seconds"):
            list(video_frames(config))
    times.write_bytes(b"0.0\n\xff\n")
    with pytest.raises(EventDataError, match=r"times\.txt': every line must start with a time in seconds"):
        list(video_frames(config))
    with pytest.raises(MissingFileError, match="times"):
        list(video_frames(config.model_copy(update={"timestamps": tmp_path / "nowhere.txt"})))
    with pytest.raises(ValidationError, match="not both"):
        VideoConfig(video=folder, timestamps=times, frames_per_second=3)


def test_videos_that_cannot_be_read_are_errors(folder, tmp_path):
    with pytest.raises(UnknownFormatError, match="frames per second"):
        list(video_frames(VideoConfig(video=folder)))
    with pytest.raises(MissingFileError, match="no video or folder"):
        list(video_frames(VideoConfig(video=tmp_path / "nowhere.mp4", frames_per_second=10)))
    (tmp_path / "empty").mkdir()
    with pytest.raises(MissingFileError, match="holds no images"):
        list(video_frames(VideoConfig(video=tmp_path / "empty", frames_per_second=10)))
    (folder / "003.png").write_text("not an image")
    with pytest.raises(UnknownFormatError, match="cannot be read as an image"):
        list(video_frames(VideoConfig(video=folder, frames_per_second=10)))
    cv2.imwrite(str(folder / "003.png"), picture(3)[:-2])
    with pytest.raises(EventDataError, match="differ in size"):
        list(video_frames(VideoConfig(video=folder, frames_per_second=10)))
    with pytest.raises(EventDataError, match=r"\.npz"):
        write_video_events(VideoConfig(video=folder, frames_per_second=10), tmp_path / "events.txt")
    for file in sorted(folder.iterdir())[1:]:
        file.unlink()
    with pytest.raises(EventDataError, match="fewer than two"):
        write_video_events(VideoConfig(video=folder, frames_per_second=10), tmp_path / "events.npz")
