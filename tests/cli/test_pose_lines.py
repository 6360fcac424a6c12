"""``track --poses``: lines of JSON while tracking, and nothing else on standard output."""

import errno
import io
import json
import re

import pytest
import torch
from places import REPOSITORY
from tiny_sequence import write_tiny_sequence

from torchtrack.cli.main import main
from torchtrack.core.lie import rotation_from_quaternion
from torchtrack.io import read_tum
from torchtrack.tracking.validation.status import Status


@pytest.fixture(scope="module")
def sequence_path(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"), labels=("left", "right"), duration_us=20_000)


def track(*arguments) -> int:
    return main(["track", *map(str, arguments), "--overlay.enabled", "false"])


def test_standard_output_has_lines_of_json_alone(sequence_path, tmp_path, capsys):
    assert track(sequence_path, "-o", tmp_path / "out", "--poses", "-") == 0
    captured = capsys.readouterr()
    rows = [json.loads(line) for line in captured.out.splitlines()]
    trajectory = read_tum(tmp_path / "out" / "trajectory_right.tum")
    assert [row["label"] for row in rows] == ["left", "right"] * len(trajectory)
    right = rows[1::2]
    assert [row["t_us"] for row in right] == trajectory.t_us.tolist()
    torch.testing.assert_close(torch.tensor([row["translation_m"] for row in right], dtype=torch.float64), trajectory.T_cam_obj[:, :3, 3])
    rotations = rotation_from_quaternion(torch.tensor([row["quaternion_xyzw"] for row in right], dtype=torch.float64))
    torch.testing.assert_close(rotations, trajectory.T_cam_obj[:, :3, :3], atol=1e-9, rtol=0)
    assert {row["status"] for row in rows} <= {status.name for status in Status}
    covariance = torch.tensor([row["covariance"] for row in rows])
    assert covariance.shape[1:] == (6, 6) and bool((covariance.diagonal(dim1=1, dim2=2) > 0).all())
    assert "Results are in" in captured.err
    (shown,) = re.findall(r"^```json\n(.*?)^```", (REPOSITORY / "docs" / "live.md").read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert list(json.loads(shown)) == list(rows[0])


def test_lines_may_go_into_a_file_beside_the_summary(sequence_path, tmp_path, capsys):
    assert track(sequence_path, "-o", tmp_path / "out", "--poses", tmp_path / "poses.jsonl", "--quiet") == 0
    lines = (tmp_path / "poses.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(lines) == 8 and all(json.loads(line)["t_us"] for line in lines)
    assert "Results are in" in capsys.readouterr().out


def test_a_file_that_cannot_be_written_and_several_sources_are_refused(sequence_path, tmp_path, capsys):
    assert track(sequence_path, "-o", tmp_path / "out", "--poses", tmp_path, "--quiet") == 1
    assert f"cannot write to '{tmp_path}'" in capsys.readouterr().err
    assert track(sequence_path, sequence_path, "-o", tmp_path / "out", "--poses", "-", "--quiet") == 2
    assert "poses: only for one source" in capsys.readouterr().err


class NobodyReads(io.StringIO):
    """A pipe whose reader has gone."""

    def write(self, text: str) -> int:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


def test_a_reader_that_goes_away_ends_the_run_in_order(sequence_path, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdout", NobodyReads())
    assert track(sequence_path, "-o", tmp_path / "out", "--poses", "-") == 1
    assert "cannot write to 'standard output': Broken pipe" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["ended"] == "failed"
