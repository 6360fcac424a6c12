"""What a user is told of the start of a run and of its end: whether events support the pose, and what was not tracked."""

import json

import cv2
import pytest
import trimesh
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main

# Beside the box, where no events are, and no search that would find it.
ELSEWHERE = """
source: {source}
output: {output}
preset: causal
overlay: {{enabled: false}}
camera: {{fx: 150, fy: 150, cx: 59.5, cy: 44.5, width: 120, height: 90}}
objects:
  - label: box
    mesh: {mesh}
    unit: m
    initial_pose: {{translation_m: [0.12, 0.08, 0.5], quaternion_xyzw: [0.3, 0.3, 0.0, 0.9055]}}
tracker: {{relocalization: {{hypotheses: 0}}}}
"""


@pytest.fixture(scope="module")
def sequence_path(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"), duration_us=120_000)


def track(path, out, *more):
    return main(["track", str(path), "-o", str(out), "--overlay.enabled", "false", "--preset", "causal", *more])


def test_a_pose_that_events_support_is_told_at_once(sequence_path, tmp_path, capsys):
    assert track(sequence_path, tmp_path / "out") == ExitCode.DONE
    printed = capsys.readouterr()
    assert "box: events support the initial pose" in printed.err and "warning" not in printed.err
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["objects"]["box"]["start_supported"] is True


def test_of_supported_poses_a_quiet_run_says_nothing(sequence_path, tmp_path, capsys):
    assert track(sequence_path, tmp_path / "out", "--quiet") == ExitCode.DONE
    assert "initial pose" not in capsys.readouterr().err


def test_a_pose_that_events_do_not_support_is_told_and_ends_with_an_exit_code_of_its_own(sequence_path, tmp_path, capsys):
    config, out = tmp_path / "elsewhere.yaml", tmp_path / "out"
    trimesh.creation.box((0.12, 0.1, 0.08)).export(tmp_path / "box.ply")
    config.write_text(ELSEWHERE.format(source=sequence_path, output=out, mesh=tmp_path / "box.ply"))
    assert main(["track", str(config), "--quiet"]) == ExitCode.NOT_TRACKED == 3
    printed = capsys.readouterr().err
    assert "warning: 'box' was tracked in 0.0 % of the windows" in printed
    assert "first_window.png" in printed or "tracker.window.duration_us" in printed
    assert json.loads((out / "summary.json").read_text())["objects"]["box"]["start_supported"] is not True


def test_the_first_window_is_drawn_whatever_else_is_written(sequence_path, tmp_path):
    assert track(sequence_path, tmp_path / "out", "--quiet") == ExitCode.DONE
    picture = cv2.imread(str(tmp_path / "out" / "first_window.png"))
    assert picture is not None and picture.std() > 0
    assert sorted(path.name for path in (tmp_path / "out").glob("*.png")) == ["first_window.png"]
