"""Trajectories: interpolation, TUM files, and what they refuse; seconds and microseconds without a slip."""

import math
from decimal import Decimal
from fractions import Fraction

import numpy as np
import pytest
import torch
from helpers import random_pose, random_twist
from hypothesis import given, settings
from hypothesis import strategies as st

from torchtrack.core.lie import quaternion_from_rotation, se3_exp
from torchtrack.errors import MissingFileError, PoseError
from torchtrack.io import Trajectory, read_tum, write_tum
from torchtrack.io.seconds import format_seconds, parse_seconds

# The same examples in every run, however busy the machine is.
REPEATABLE = settings(deadline=None, derandomize=True)

TIMES = torch.tensor([1_000_000, 1_000_010, 1_005_000, 2_000_000])


def trajectory(times=TIMES, seed: int = 0) -> Trajectory:
    return Trajectory(times, random_pose(len(times), seed=seed))


# ---- seconds


@pytest.mark.parametrize(
    ("text", "t_us"),
    [
        ("2.097134001", 2097134),
        ("2.1957200009999998", 2195720),
        ("0.0000005", 1),
        ("0.00000049999999999999999999", 0),
        ("-0.0000005", 0),
        ("-0.0000006", -1),
        ("5", 5_000_000),
        (".5", 500_000),
        ("3e-06", 3),
        ("1605537493.718345", 1605537493718345),
        ("1605537493.7183454999999999999999", 1605537493718345),
        ("9223372036854.775807", 2**63 - 1),
    ],
)
def test_seconds_are_rounded_to_the_nearest_microsecond(text, t_us):
    assert parse_seconds(text) == t_us


@pytest.mark.parametrize("text", ["", "abc", "1.2.3", "nan", "inf", "1e300", "9223372036854.775808"])
def test_what_is_no_time_in_seconds(text):
    with pytest.raises(ValueError, match=r"is not|do not fit"):
        parse_seconds(text)


@REPEATABLE
@given(st.integers(-(2**62), 2**62))
def test_microseconds_survive_seconds(t_us):
    assert parse_seconds(format_seconds(t_us)) == t_us


@REPEATABLE
@given(st.decimals(min_value=-(10**9), max_value=10**9, allow_nan=False, places=None))
def test_seconds_are_rounded_as_exact_fractions_are(seconds: Decimal):
    assert parse_seconds(str(seconds)) == math.floor(Fraction(seconds) * 1_000_000 + Fraction(1, 2))


# ---- interpolation


def test_at_its_own_times_it_gives_its_own_poses():
    path = trajectory()
    torch.testing.assert_close(path.at(path.t_us), path.T_cam_obj, rtol=0, atol=1e-14)


def test_between_two_poses_it_moves_with_constant_twist():
    T_start, xi = random_pose(), random_twist()
    path = Trajectory(torch.tensor([10**15, 10**15 + 1000]), torch.stack([T_start, se3_exp(xi) @ T_start]))
    for step in (1, 250, 999):
        torch.testing.assert_close(path.at(torch.tensor([10**15 + step]))[0], se3_exp(xi * step / 1000) @ T_start, rtol=0, atol=1e-12)


def test_beyond_its_ends_it_rests():
    path = trajectory()
    torch.testing.assert_close(path.at(torch.tensor([-5, 999_999, 2_000_001, 2**60])), path.T_cam_obj[[0, 0, -1, -1]], rtol=0, atol=1e-14)


def test_one_pose_holds_for_ever():
    path = trajectory(torch.tensor([7]))
    assert torch.equal(path.at(torch.tensor([0, 7, 100])), path.T_cam_obj.expand(3, 4, 4))


def test_no_times_give_no_poses():
    assert trajectory().at(torch.zeros(0, dtype=torch.int64)).shape == (0, 4, 4)


def test_single_precision_poses_become_double():
    path = Trajectory(torch.tensor([1, 2], dtype=torch.int32), random_pose(2, dtype=torch.float32))
    assert path.t_us.dtype == torch.int64
    assert path.T_cam_obj.dtype == torch.float64


# ---- what is refused


def scaled(T):
    return T * torch.tensor([2.0, 1, 1, 1])


@pytest.mark.parametrize(
    ("t_us", "T", "message"),
    [
        (torch.tensor([0.0, 1.0]), random_pose(2), "integer microseconds"),
        (torch.tensor([0, 1, 2]), random_pose(2), r"got \[3\] and \[2, 4, 4\]"),
        (torch.tensor([[0, 1]]), random_pose(1), r"times \[p\]"),
        (torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4, 4), "at least one pose"),
        (torch.tensor([0, 5, 5]), random_pose(3), "pose 2 is at 5 µs after 5 µs"),
        (torch.tensor([0, 5, 4]), random_pose(3), "must increase strictly"),
        (torch.tensor([0, 1]), scaled(random_pose(2)), "not a rotation"),
        (torch.tensor([0, 1]), random_pose(2) * math.nan, "NaN"),
    ],
)
def test_trajectories_that_are_refused(t_us, T, message):
    with pytest.raises(PoseError, match=message):
        Trajectory(t_us, T)


# ---- TUM files


def test_tum_round_trip(tmp_path):
    path = trajectory(torch.tensor([-1, 0, 1605537493718345, 1605537493718346]))
    write_tum(tmp_path / "poses.tum", path)
    again = read_tum(tmp_path / "poses.tum")
    assert torch.equal(again.t_us, path.t_us)
    torch.testing.assert_close(again.T_cam_obj, path.T_cam_obj, rtol=0, atol=1e-10)


def test_tum_lines_are_what_evo_reads(tmp_path):
    T = torch.eye(4, dtype=torch.float64)
    T[:3, 3] = torch.tensor([0.1, -0.2, 0.5], dtype=torch.float64)
    write_tum(tmp_path / "poses.tum", Trajectory(torch.tensor([2_000_005]), T[None]))
    comment, line = (tmp_path / "poses.tum").read_text().splitlines()
    assert comment.startswith("#")
    assert line == "2.000005 0.1 -0.2 0.5 0 0 0 1"


def test_tum_comments_and_blank_lines(tmp_path):
    file = tmp_path / "poses.tum"
    file.write_text("# header\n\n0.5 1 2 3 0 0 0 1 # a remark\r\n   \n1 1 2 3 0 0 0 -1\n")
    path = read_tum(file)
    assert path.t_us.tolist() == [500_000, 1_000_000]
    assert torch.equal(path.T_cam_obj[0], path.T_cam_obj[1])


def test_real_ground_truth(data_dir):
    path = read_tum(data_dir / "recordings" / "slider_depth" / "groundtruth.txt")
    assert len(path) == 339
    assert path.t_us[:2].tolist() == [22292, 31785]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0.5 1 2 3 0 0 1", r"line 2: expected 't tx ty tz qx qy qz qw' \(8 numbers\), got '0.5 1 2 3 0 0 1'"),
        ("0.5 1 2 x 0 0 0 1", "line 2: .*'x'"),
        ("half 1 2 3 0 0 0 1", "line 2: .*'half'"),
        ("0.5 1 2 3 0 0 0 0", "line 2: the quaternion qx qy qz qw has norm 0"),
        ("0.5 1 2 3 0 0 0 nan", "line 2: the quaternion"),
        ("0.5 nan 2 3 0 0 0 1", "NaN"),
        ("0.1 1 2 3 0 0 0 1", "must increase strictly"),
        ("0.1000004 1 2 3 0 0 0 1", "must increase strictly"),
    ],
)
def test_tum_files_that_are_refused(tmp_path, line, message):
    file = tmp_path / "poses.tum"
    file.write_text(f"0.1 1 2 3 0 0 0 1\n{line}\n")
    with pytest.raises(PoseError, match=message) as caught:
        read_tum(file)
    assert "poses.tum" in str(caught.value)


def test_tum_file_without_poses(tmp_path):
    (tmp_path / "poses.tum").write_text("# nothing\n")
    with pytest.raises(PoseError, match="holds no pose"):
        read_tum(tmp_path / "poses.tum")


def test_missing_tum_file(tmp_path):
    with pytest.raises(MissingFileError, match=r"poses\.tum"):
        read_tum(tmp_path / "poses.tum")


def test_nothing_half_written(tmp_path, monkeypatch):
    file = tmp_path / "poses.tum"
    file.write_text("what was there")

    def full_disk(self, *_, **__):
        self.write_bytes(b"0.1 1 2")
        raise OSError("disk full")

    monkeypatch.setattr("pathlib.Path.write_text", full_disk)
    with pytest.raises(OSError, match="disk full"):
        write_tum(file, trajectory())
    assert [entry.name for entry in tmp_path.iterdir()] == ["poses.tum"]
    assert file.read_text() == "what was there"


def test_quaternions_of_tum_do_not_jump(tmp_path):
    """Through rotations of 180°, where the conversion of each alone changes its sign."""
    turns = torch.linspace(0, 4 * torch.pi, 81, dtype=torch.float64)[:, None] * torch.tensor([0.48, -0.6, 0.64, 0, 0, 0], dtype=torch.float64)
    T = se3_exp(turns)
    write_tum(tmp_path / "poses.tum", Trajectory(1000 * torch.arange(81), T))
    quaternions = torch.from_numpy(np.loadtxt(tmp_path / "poses.tum")[:, 4:])
    alone = quaternion_from_rotation(T[:, :3, :3])
    assert float((quaternions[1:] * quaternions[:-1]).sum(-1).min()) > 0.9 > float((alone[1:] * alone[:-1]).sum(-1).min())
    torch.testing.assert_close(read_tum(tmp_path / "poses.tum").T_cam_obj, T, atol=1e-9, rtol=0)
