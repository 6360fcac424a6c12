"""A run in the Rerun viewer: everything is in the file, at the time of the window."""

import re
import subprocess
import sys

import cv2
import numpy as np
import pytest
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.core.events import EventBatch
from torchtrack.errors import ConfigError, MissingExtraError, OutputError
from torchtrack.io import extras
from torchtrack.run.sinks.rerun_log import check_target, event_png, observed_near


def test_a_file_has_all_that_the_viewer_shows(tmp_path):
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'torchtrack[viz]'")
    path = write_tiny_sequence(tmp_path, "two", labels=("left", "right"), duration_us=20_000)
    arguments = ["track", str(path), "-o", str(tmp_path / "out"), "--overlay.enabled", "false", "--rerun", str(tmp_path / "run.rrd"), "--quiet"]
    assert main(arguments) == ExitCode.DONE
    done = subprocess.run([sys.executable, "-m", "rerun", "rrd", "print", tmp_path / "run.rrd"], capture_output=True, text=True, check=True)
    text = done.stdout + done.stderr
    paths = ["camera", "camera/events", "plots/time/step_ms", "plots/stages/rounds_ms", "plots/stages/prediction_ms"]
    for label in ("left", "right"):
        paths += [f"{place}/{label}" for place in ("objects", "truth", "paths", "status", "camera/contours", "camera/observations", "camera/truth")]
        paths += [
            f"plots/quality/{label}",
            f"plots/error/{label}/rotation_deg",
            f"plots/std/{label}/position_cm",
            f"plots/residual/{label}/median_px",
        ]
    assert [name for name in paths if not re.search(rf"/{name}\b", text)] == []


def test_events_near_a_contour():
    pixels = np.stack([np.arange(10.0), np.full(10, 5.0)], 1)
    normals = np.tile([0.0, 1.0], (10, 1))
    near, feet, residual_px = observed_near(np.array([[3.2, 6.5], [4.0, 4.0], [4.0, 20.0]]), pixels, normals)
    np.testing.assert_allclose(near, [[3.2, 6.5], [4.0, 4.0]])
    np.testing.assert_allclose(feet, [[3.2, 5.0], [4.0, 5.0]])
    np.testing.assert_allclose(residual_px, [1.5, -1.0])
    assert [len(values) for values in observed_near(np.zeros((0, 2)), pixels, normals)] == [0, 0, 0]


def test_the_image_of_events():
    events = EventBatch.from_numpy(np.array([1, 2, 2]), np.array([0, 3, 3]), np.array([10, 20, 30]), np.array([1, 1, 0]))
    image = cv2.imdecode(np.frombuffer(event_png(events, 4, 5), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image.shape == (5, 4) and image[0, 1] == 230 and image[3, 2] == 110 and (image > 0).sum() == 2


def test_targets_that_cannot_be(tmp_path, monkeypatch):
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'torchtrack[viz]'")
    with pytest.raises(ConfigError, match=r"'run\.txt' is neither 'live'"):
        check_target("run.txt")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="is a file, where a folder should be"):
        check_target(str(tmp_path / "file" / "run.rrd"))


def test_without_the_viewer(monkeypatch):
    def missing(module):
        raise ImportError(module)

    monkeypatch.setattr(extras.importlib, "import_module", missing)
    with pytest.raises(MissingExtraError, match=r"torchtrack\[viz\]"):
        check_target("live")


def test_of_several_sources(tmp_path, capsys):
    assert main(["track", "a.npz", "b.npz", "-o", str(tmp_path), "--rerun", "live"]) == ExitCode.WRONG_SETTINGS
    assert "rerun: only for one source" in capsys.readouterr().err
