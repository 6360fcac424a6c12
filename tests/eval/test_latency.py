import pytest
import torch

from torchtrack.cli.exit_codes import ExitCode
from torchtrack.cli.main import main
from torchtrack.config.run import RunConfig
from torchtrack.errors import EventDataError
from torchtrack.eval.latency import estimate_latency
from torchtrack.run.session import open_session
from torchtrack.sim import CameraConfig, EventCameraConfig, MotionConfig, ObjectConfig, SceneConfig, simulate, write

LATENCY_US = 6000


@pytest.fixture(scope="module")
def late(tmp_path_factory):
    """A sequence whose time stamps are late."""
    pytest.importorskip("numba", reason="the rasteriser needs numba: pip install 'torchtrack[sim]'")
    motion = MotionConfig(position_m=(0.0, 0.0, 0.45), rotation_deg=(150, 25, 10), frequency_hz=2.0)
    scene = SceneConfig(
        name="late",
        objects=(ObjectConfig(label="bracket", shape="lbracket", motion=motion),),
        camera=CameraConfig(width=160, height=120, fx=150.0, fy=150.0),
        event_camera=EventCameraConfig(latency_us=LATENCY_US, shot_noise_rate_hz=0, leak_rate_hz=0),
        duration_s=0.4,
        seed=3,
    )
    return write(simulate(scene), tmp_path_factory.mktemp("late") / "late.npz")


@pytest.fixture(scope="module")
def estimate(late):
    return estimate_latency(open_session(RunConfig(source=late)))


def test_the_latency_of_the_sensor_is_found(estimate):
    assert estimate.latency_us == pytest.approx(LATENCY_US, abs=min(1500, 2 * estimate.deviation_us))
    assert estimate.after_px < 0.6 * estimate.before_px
    assert estimate.events > 1000


def test_a_latency_that_is_taken_off_is_gone(late, estimate):
    rest = estimate_latency(open_session(RunConfig(source=late, sensor_latency_us=LATENCY_US)))
    assert estimate.latency_us - rest.latency_us == pytest.approx(LATENCY_US, abs=150)


def test_a_latency_shifts_the_stream_and_nothing_else(late):
    plain, shifted = (open_session(RunConfig(source=late, sensor_latency_us=latency)) for latency in (0, LATENCY_US))
    first, second = next(plain.chunks()), next(shifted.events.chunks())
    assert (shifted.events.width, shifted.events.height) == (160, 120)
    assert torch.equal(second.t_us[: len(first)] + LATENCY_US, first.t_us)
    assert torch.equal(second.x[: len(first)], first.x)


def test_without_truth_or_motion_there_is_nothing_to_find(late, tmp_path):
    pytest.importorskip("numba")
    session = open_session(RunConfig(source=late))
    object.__setattr__(session, "ground_truth", (None,))
    with pytest.raises(EventDataError, match="no ground truth"):
        estimate_latency(session)
    scene = SceneConfig(
        name="still",
        objects=(ObjectConfig(label="cube", shape="cube"),),
        camera=CameraConfig(width=60, height=40, fx=60, fy=60),
        speed=0.0,
        duration_s=0.1,
    )
    with pytest.raises(EventDataError, match="near moving contours"):
        estimate_latency(open_session(RunConfig(source=write(simulate(scene), tmp_path / "still.npz"))))


def test_the_command_shows_a_row_per_sequence(late, estimate, capsys, monkeypatch):
    monkeypatch.setattr("torchtrack.cli.evaluate.estimate_latency", lambda session: estimate)
    assert main(["evaluate", str(late), "--estimate-latency"]) == ExitCode.DONE
    shown = capsys.readouterr().out
    assert "late" in shown
    assert f"{estimate.latency_us:.0f}" in shown
    assert "sensor_latency_us" in shown
