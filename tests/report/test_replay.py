"""A finished run shown again: what its folder and its recording say, at the times of its windows."""

import re
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest
import torch
from helpers import random_events
from kept_steps import KeptSteps
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.config.run import RunConfig
from torchtrack.errors import ConfigError, MissingFileError, UnknownFormatError
from torchtrack.report.finished import read_run
from torchtrack.report.plots import write_plots
from torchtrack.report.replay import batches_up_to, moments, show_run
from torchtrack.run.runner import run
from torchtrack.run.session import open_session
from torchtrack.run.sinks.rerun_log import observed_near


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """The folder of a run, its settings, and its steps."""
    folder, steps = tmp_path_factory.mktemp("runs"), KeptSteps()
    path = write_tiny_sequence(folder, "two", labels=("left", "right"), duration_us=40_000)
    config = RunConfig(source=path, output=folder / "out", preset="causal", overlay={"enabled": False})
    run(config, [steps])
    return folder / "out", config, steps.steps


def test_each_window_is_as_it_was(tracked):
    folder, config, steps = tracked
    finished = read_run(folder)
    replayed = list(moments(finished.tracks, open_session(config), config))
    assert [moment.t_us for moment in replayed] == [step.window.t_end_us for step in steps]
    for moment, step in zip(replayed, steps, strict=True):
        assert torch.equal(moment.events.t_us, step.window.events.t_us) and torch.equal(moment.events.x, step.window.events.x)
        for index, of_object in enumerate(moment.objects):
            torch.testing.assert_close(of_object.T_cam_obj, step.result.T_cam_obj[index].double(), atol=1e-9, rtol=0)
            assert of_object.status == int(step.result.status[index])
            assert of_object.quality == pytest.approx(float(step.result.quality[index]), abs=1e-3)
    # The contours are where the events are.
    last = replayed[-1]
    pixels = torch.stack([last.events.x, last.events.y], 1).double().numpy()
    residual_px = observed_near(pixels, last.objects[0].contour.pixels, last.objects[0].contour.normals)[2]
    assert len(residual_px) > 50 and np.median(np.abs(residual_px)) < 1.0


def test_events_are_cut_at_the_times_of_the_poses():
    events = random_events(1000, duration_us=1000)
    cut = list(batches_up_to([events[:10], events[10:700], events[700:]], [100, 101, 650, 900]))
    expected = [events.slice_time(*span) for span in ((0, 100), (100, 101), (101, 650), (650, 900))]
    assert [batch.t_us.tolist() for batch in cut] == [batch.t_us.tolist() for batch in expected]
    assert [len(batch) for batch in batches_up_to([], [5, 6])] == [0, 0]


def test_the_command_writes_all_that_the_viewer_shows(tracked, tmp_path, capsys):
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'torchtrack[viz]'")
    folder, _, _ = tracked
    assert main(["view", str(folder), "-o", str(tmp_path / "run.rrd")]) == ExitCode.DONE
    assert "run.rrd" in capsys.readouterr().out
    done = subprocess.run([sys.executable, "-m", "rerun", "rrd", "print", tmp_path / "run.rrd"], capture_output=True, text=True, check=True)
    text = done.stdout + done.stderr
    paths = ["camera", "camera/events"]
    for label in ("left", "right"):
        paths += [f"{place}/{label}" for place in ("objects", "truth", "paths", "status", "camera/contours", "camera/observations", "camera/truth")]
        paths += [f"plots/quality/{label}", f"plots/status/{label}", f"plots/error/{label}/rotation_deg", f"plots/std/{label}/position_cm"]
    assert [name for name in paths if not re.search(rf"/{name}\b", text)] == []


def test_a_recording_that_is_elsewhere(tracked, tmp_path, capsys):
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'torchtrack[viz]'")
    folder, config, _ = tracked
    shutil.copytree(folder, tmp_path / "out")
    text = (tmp_path / "out" / "config.yaml").read_text()
    (tmp_path / "out" / "config.yaml").write_text(text.replace(str(config.source), str(tmp_path / "gone.npz")))
    arguments = ["view", str(tmp_path / "out"), "-o", str(tmp_path / "run.rrd")]
    assert main(arguments) == ExitCode.FAILED
    message = capsys.readouterr().err
    assert "gone.npz' does not exist" in message and "--source FILE" in message and "--plots DIR" in message
    assert main([*arguments, "--source", str(config.source)]) == ExitCode.DONE
    with pytest.raises(MissingFileError, match="is no output folder of a run"):
        read_run(tmp_path)


def test_a_live_run_has_no_events_to_show(tracked, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'torchtrack[viz]'")
    folder, config, _ = tracked
    shutil.copytree(folder, tmp_path / "out")
    text = (tmp_path / "out" / "config.yaml").read_text()
    (tmp_path / "out" / "config.yaml").write_text(text.replace(str(config.source), "dv://localhost:7777"))
    with pytest.raises(ConfigError, match="tracked live from 'dv://localhost:7777'.*--source FILE"):
        show_run(read_run(tmp_path / "out"), str(tmp_path / "run.rrd"))


def test_a_table_without_an_object(tracked, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun-sdk: pip install 'torchtrack[viz]'")
    folder, _, _ = tracked
    shutil.copytree(folder, tmp_path / "out")
    rows = (tmp_path / "out" / "poses.csv").read_text().splitlines(keepends=True)
    (tmp_path / "out" / "poses.csv").write_text("".join(row for row in rows if ",right," not in row))
    with pytest.raises(UnknownFormatError, match="no poses of right"):
        show_run(read_run(tmp_path / "out"), str(tmp_path / "run.rrd"))


def test_plots_as_files_need_the_folder_alone(tracked, tmp_path, monkeypatch, capsys):
    folder, _, _ = tracked
    monkeypatch.setattr("torchtrack.cli.view.show_run", lambda *about: pytest.fail("no viewer is asked for"))
    assert main(["view", str(folder), "--plots", str(tmp_path / "plots")]) == ExitCode.DONE
    assert "The plots are in" in capsys.readouterr().out
    assert sorted(path.name for path in (tmp_path / "plots").iterdir()) == ["accuracy.png", "status.png", "trajectory.png"]
    for path in (tmp_path / "plots").iterdir():
        image = cv2.imread(str(path))
        assert image.shape[1] == 960 and (image < 250).any(-1).mean() > 0.01
    (tmp_path / "out").mkdir()
    for name in ("summary.json", "config.yaml"):
        shutil.copy(folder / name, tmp_path / "out")
    (tmp_path / "out" / "poses.csv").write_text((folder / "poses.csv").read_text().splitlines(keepends=True)[0])
    with pytest.raises(ConfigError, match="no poses to plot"):
        write_plots(read_run(tmp_path / "out"), tmp_path / "plots")


def test_the_viewer_itself_is_opened_without_a_file(tracked, monkeypatch):
    shown = []
    monkeypatch.setattr("torchtrack.cli.view.show_run", lambda run, target, source, progress: shown.append((run.name, target, source)))
    assert main(["view", str(tracked[0])]) == ExitCode.DONE
    assert shown == [("out", "live", None)]
