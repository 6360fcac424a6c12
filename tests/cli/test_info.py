"""The command ``info`` with a picture: what it draws, and what it says where it cannot."""

import cv2
import numpy as np
import pytest
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.main import main


@pytest.fixture
def recording(tmp_path, monkeypatch):
    """A file of events and two calibrations, one of them of another sensor."""
    monkeypatch.chdir(tmp_path)
    events = np.load(write_tiny_sequence(tmp_path))
    np.savez("events.npz", **{name: events[name] for name in ("x", "y", "t", "p")})
    lens = "distortion_model: plumb_bob, distortion: [1.0, 0.0, 0.0, 0.0]"
    (tmp_path / "camera.yaml").write_text(f"{{fx: 80, fy: 80, cx: 59.5, cy: 44.5, width: 120, height: 90, {lens}}}")
    (tmp_path / "other.yaml").write_text("{fx: 300, fy: 300, cx: 160, cy: 120, width: 320, height: 240}")
    return tmp_path


def info(*more):
    return main(["info", "events.npz", "--width", "120", "--height", "90", *more])


def test_events_are_drawn_at_the_start_and_at_a_time(recording, capsys):
    assert info("--picture", "start.png") == 0
    assert "events are shown in start.png" in capsys.readouterr().out
    assert info("--picture", "later.png", "--at-us", "40000") == 0
    assert info("--picture", "straight.png", "--calibration", "camera.yaml") == 0
    start, later, straight = (cv2.imread(f"{name}.png") for name in ("start", "later", "straight"))
    assert start.shape == later.shape == straight.shape == (90 * 8, 120 * 8, 3)
    assert (start != later).any() and (start != straight).any()


@pytest.mark.parametrize(
    ("more", "code", "message"),
    [
        (("--at-us", "5"), 2, "name its file with --picture"),
        (("--calibration", "camera.yaml"), 2, "name its file with --picture"),
        (("--picture", "events.jpg"), 1, "'events.jpg': pictures are .png files"),
        (("--picture", "a.png", "--at-us", "900000"), 1, "no events within 15 ms after 900,000 µs; there are events from 500 to"),
        (("--picture", "a.png", "--calibration", "other.yaml"), 1, "width is 320 here, but 120 was given"),
        (("--picture", "a.png", "--calibration", "nowhere.yaml"), 1, "nowhere.yaml"),
    ],
)
def test_what_is_wrong_is_said(recording, capsys, more, code, message):
    assert info(*more) == code
    assert message in " ".join(capsys.readouterr().err.split())
    assert not list(recording.glob("*.png"))
