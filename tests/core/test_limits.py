import pytest

from torchtrack.cli.main import main
from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.core.limits import Limits, check_limit, current_limits, limits
from torchtrack.errors import LimitError
from torchtrack.io import open_events, read_trajectory


def test_what_is_too_large_is_refused_with_the_file_the_limit_and_the_setting():
    check_limit("faces", Limits().faces, "cube.ply")
    with pytest.raises(LimitError, match=r"'cube.ply' asks for 2,000,001 faces, and the limit is 2,000,000.*limits.faces.*--limits.faces 2000001"):
        check_limit("faces", 2_000_001, "cube.ply")


def test_a_limit_is_raised_within_a_block_and_holds_again_after_it():
    with limits(Limits(faces=3_000_000)):
        check_limit("faces", 2_000_001, "cube.ply")
        with limits(Limits(faces=5)), pytest.raises(LimitError, match="the limit is 5:"):
            check_limit("faces", 6, "cube.ply")
        assert current_limits().faces == 3_000_000
    assert current_limits() == Limits()


def large_sensor(folder):
    path = folder / "large.csv"
    path.write_text("# width=65536 height=65536\n1000,1,2,1\n2000,3,4,0\n")
    return path


def test_a_declared_sensor_is_held_against_the_limit(tmp_path):
    path = large_sensor(tmp_path)
    with pytest.raises(LimitError, match=r"large.csv' asks for 4,294,967,296 sensor pixels"):
        open_events(path)
    with limits(Limits(sensor_pixels=1 << 32)):
        assert open_events(path).width == 65536


def test_the_command_line_raises_limits_of_any_command(tmp_path, capsys):
    path = large_sensor(tmp_path)
    assert main(["info", str(path)]) == 1
    assert "limits.sensor_pixels" in capsys.readouterr().err
    assert main(["info", str(path), "--limits.sensor-pixels", str(1 << 32)]) == 0
    assert "65536x65536" in capsys.readouterr().out
    assert main(["info", str(path), "--limits.sensor-pixel", "5"]) == 2
    assert "perhaps you meant 'sensor_pixels'" in capsys.readouterr().err


def test_a_config_file_says_limits_and_inherits_those_that_hold(tmp_path):
    path = tmp_path / "track.yaml"
    path.write_text("source: a.npz\nlimits: {poses: 7}\n")
    assert load(RunConfig, path, {"limits.faces": 9}).limits == Limits(poses=7, faces=9)
    with limits(Limits(poses=3)):
        assert RunConfig(source="a.npz").limits.poses == 3


def test_a_file_of_too_many_poses_is_refused_before_it_is_parsed(tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("t_us,tx,ty,tz,qx,qy,qz,qw\n" + "no pose\n" * 1200)
    with limits(Limits(poses=100)), pytest.raises(LimitError, match=r"poses.csv' asks for 201 poses, and the limit is 100"):
        read_trajectory(path)
