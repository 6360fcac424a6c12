import csv
import errno
import io
import json
import os
import signal

import cv2
import numpy as np
import pytest
import torch
from places import REPOSITORY
from tiny_sequence import CAMERA, write_tiny_sequence

import torchtrack
from torchtrack.config.load import load
from torchtrack.config.run import RunConfig
from torchtrack.config.tracker import WindowConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import rotation_angle_deg
from torchtrack.core.windows import clipped
from torchtrack.errors import CalibrationError, ConfigError, EventDataError, MissingFileError, OutputError, PoseError, UnknownFormatError
from torchtrack.io import line_file, read_sequence, read_tum
from torchtrack.run.runner import run, run_many, track
from torchtrack.run.session import Session, open_session
from torchtrack.run.sinks.overlay import note
from torchtrack.run.streams import build_tracker

# What a run of a box writes, without an overlay.
FILES = ["config.yaml", "first_window.png", "poses.csv", "summary.json", "trajectory_box.tum"]


@pytest.fixture(scope="module")
def sequence_path(tmp_path_factory):
    return write_tiny_sequence(tmp_path_factory.mktemp("sequence"), duration_us=40_000)


def quick(sequence_path, output, **settings):
    """A run without an overlay."""
    return RunConfig(**{"source": sequence_path, "output": output, "overlay": {"enabled": False}, **settings})


def events_of(t_us):
    zeros = np.zeros(len(t_us), np.int64)
    return EventBatch.from_numpy(zeros, zeros, np.array(t_us), zeros)


def test_outputs_are_complete(sequence_path, tmp_path):
    summary = run(quick(sequence_path, tmp_path / "out"))
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES
    rows = list(csv.DictReader((tmp_path / "out" / "poses.csv").read_text().splitlines()))
    trajectory = read_tum(tmp_path / "out" / "trajectory_box.tum")
    assert len(rows) == len(trajectory) == summary.windows == 8
    assert [int(row["t_us"]) for row in rows] == trajectory.t_us.tolist() == [499 + 5000 * n for n in range(1, 9)]
    stored = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert stored["events"] == len(np.load(sequence_path)["t"]) == summary.events
    assert stored["versions"]["torchtrack"] == torchtrack.__version__
    assert sum(stored["objects"]["box"]["status"].values()) == 8
    assert {"step_median_ms", "step_p95_ms", "real_time_factor", "event_rate_per_s", "device"} <= set(stored)
    # The last window ends after the last true pose, so it has no error.
    assert stored["objects"]["box"]["errors"]["windows"] == 7
    assert rows[-1]["rotation_error_deg"] == ""
    assert float(rows[0]["rotation_error_deg"]) < 1


def test_the_resolved_config_repeats_the_run(sequence_path, tmp_path):
    config = quick(sequence_path, tmp_path / "first", tracker={"window": {"duration_us": 8000}})
    run(config)
    again = load(RunConfig, tmp_path / "first" / "config.yaml")
    assert again == config
    run(again.model_copy(update={"output": tmp_path / "second"}))
    assert (tmp_path / "first" / "trajectory_box.tum").read_bytes() == (tmp_path / "second" / "trajectory_box.tum").read_bytes()


def test_angular_velocity_is_recovered(tmp_path):
    longer = write_tiny_sequence(tmp_path, "longer", duration_us=120_000)
    velocity = run(quick(longer, tmp_path / "out")).objects["box"].angular_velocity_rad_s
    assert velocity == pytest.approx((0.3, -0.2, 0.5), abs=0.2)


def test_start_and_end_bound_the_run(sequence_path, tmp_path):
    summary = run(quick(sequence_path, tmp_path / "out", start_us=10_000, end_us=25_000))
    t_us = np.load(sequence_path)["t"]
    assert summary.events == ((t_us > 10_000) & (t_us <= 25_000)).sum()
    assert summary.windows == 3
    # While the velocity is still being learned: a degree is a third of a pixel in so small an image.
    assert summary.objects["box"].errors.max_rotation_deg < 1.5


class Broken:
    """A sink that raises an error at one of its steps."""

    def __init__(self, error, at=4):
        self._error, self._left, self.closed = error, at, False

    def add(self, step):
        self._left -= 1
        if self._left == 0:
            raise self._error

    def close(self):
        self.closed = True


def summary_in(folder):
    return json.loads((folder / "summary.json").read_text())


@pytest.mark.parametrize("preset", ["default", "causal"])
@pytest.mark.parametrize("error", [EventDataError("bad events"), RuntimeError("unplugged"), OSError(28, "No space left on device")])
def test_a_sink_that_fails_ends_the_run_and_what_was_tracked_stays(sequence_path, tmp_path, preset, error):
    sink = Broken(error)
    with pytest.raises(type(error)) as raised:
        run(quick(sequence_path, tmp_path / "out", preset=preset), [sink])
    assert raised.value is error and sink.closed
    trajectory, summary = read_tum(tmp_path / "out" / "trajectory_box.tum"), summary_in(tmp_path / "out")
    # What was held back to be smoothed is written too.
    assert len(trajectory) == summary["windows"] == (8 if preset == "default" else 4)
    assert (summary["ended"], summary["interrupted"]) == ("failed", False)
    assert str(error.args[-1]) in summary["message"]
    assert summary["objects"]["box"]["errors"]["mean_rotation_deg"] < 1.5
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == FILES


def failing_after(windows, error):
    """A session's windows that end with an error."""

    def raising(self):
        for chunk in chunks(self):
            yield chunk[: len(chunk) * windows // 8]
            raise error

    chunks = Session.chunks
    return raising


@pytest.mark.parametrize("error", [EventDataError("cut off"), OSError(5, "Input/output error"), RuntimeError("unplugged")])
def test_a_source_that_fails_leaves_what_was_tracked(sequence_path, tmp_path, monkeypatch, error):
    monkeypatch.setattr(Session, "chunks", failing_after(5, error))
    with pytest.raises(type(error)) as raised:
        run(quick(sequence_path, tmp_path / "out"))
    assert raised.value is error
    summary = summary_in(tmp_path / "out")
    assert summary["ended"] == "failed" and summary["windows"] == len(read_tum(tmp_path / "out" / "trajectory_box.tum")) >= 3


def test_one_of_many_that_fails_leaves_what_was_tracked_and_the_others_go_on(folder, tmp_path, monkeypatch):
    raising, chunks = failing_after(4, EventDataError("cut off")), Session.chunks
    monkeypatch.setattr(Session, "chunks", lambda self: raising(self) if self.name == "one" else chunks(self))
    configs = [quick(folder / f"{name}.npz", tmp_path / name) for name in ("one", "two")]
    outcomes = dict(run_many(configs, streams=2))
    assert outcomes[0].reason == "cut off" and outcomes[1].ended == "completed"
    assert [summary_in(tmp_path / name)["ended"] for name in ("one", "two")] == ["failed", "completed"]
    assert len(read_tum(tmp_path / "one" / "trajectory_box.tum")) == summary_in(tmp_path / "one")["windows"] > 0


def test_poses_are_on_disk_as_they_come(sequence_path, tmp_path):
    seen = []

    class Reader:
        def add(self, step):
            lines = (tmp_path / "out" / "poses.csv").read_text().splitlines()
            seen.append((len(lines) - 1, len(read_tum(tmp_path / "out" / "trajectory_box.tum")), summary_in(tmp_path / "out")["ended"]))

        def close(self):
            pass

    run(quick(sequence_path, tmp_path / "out", preset="causal"), [Reader()])
    assert seen == [(number, number, "running") for number in range(1, 9)]
    assert summary_in(tmp_path / "out")["ended"] == "completed"


def test_an_earlier_result_is_set_aside_until_the_new_one_is_complete(sequence_path, tmp_path):
    out = tmp_path / "out"
    run(quick(sequence_path, out))
    (out / "notes.txt").write_text("mine")
    before = (out / "poses.csv").read_bytes()
    for _ in range(2):
        # The newest complete one is kept, however often a new one fails.
        with pytest.raises(RuntimeError):
            run(quick(sequence_path, out, preset="causal"), [Broken(RuntimeError("again"), at=2)])
        assert (out / "poses.csv.previous").read_bytes() == before
        assert json.loads((out / "summary.json.previous").read_text())["ended"] == "completed"
        assert summary_in(out)["ended"] == "failed"
    run(quick(sequence_path, out))
    assert (out / "poses.csv").read_bytes() == before
    assert sorted(path.name for path in out.iterdir()) == [
        "config.yaml",
        "first_window.png",
        "notes.txt",
        "poses.csv",
        "summary.json",
        "trajectory_box.tum",
    ]


def test_of_results_that_are_not_complete_the_newest_is_set_aside(sequence_path, tmp_path):
    for at in (2, 4, 3):
        with pytest.raises(RuntimeError):
            run(quick(sequence_path, tmp_path / "out", preset="causal"), [Broken(RuntimeError("again"), at=at)])
    assert [len((tmp_path / "out" / f"poses.csv{suffix}").read_text().splitlines()) for suffix in (".previous", "")] == [5, 4]


def test_a_config_that_is_no_runs_is_not_replaced(sequence_path, tmp_path):
    (tmp_path / "config.yaml").write_text("mine")
    with pytest.raises(OutputError, match=r"its config\.yaml is not of a run"):
        run(quick(sequence_path, tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"] and (tmp_path / "config.yaml").read_text() == "mine"


def test_two_runs_into_one_folder_the_second_is_refused(sequence_path, tmp_path):
    class Second:
        error = None

        def add(self, step):
            try:
                run(quick(sequence_path, tmp_path / "out"))
            except OutputError as error:
                self.error = error

        def close(self):
            pass

    second = Second()
    assert run(quick(sequence_path, tmp_path / "out", end_us=6000), [second]).ended == "completed"
    assert f"another run writes there (process {os.getpid()})" in str(second.error)


def test_an_output_that_cannot_be_is_told_before_anything_is_tracked(sequence_path, tmp_path):
    (tmp_path / "file").write_text("mine")
    for output, expected in (
        (tmp_path / "file", "file': it is a file"),
        (tmp_path / "file" / "below" / "out", "file' is a file, where a folder should be"),
        (sequence_path / "out", "tiny.npz' is a file, where a folder should be"),
    ):
        with pytest.raises(OutputError, match=expected):
            run(quick(sequence_path, output))
    assert [path.name for path in tmp_path.iterdir()] == ["file"] and (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("preset", ["default", "causal"])
def test_a_full_disk_leaves_whole_lines_and_a_summary(sequence_path, tmp_path, monkeypatch, preset):
    out, written = tmp_path / "out", 0
    write = io.FileIO.write

    def filling(file, data):
        nonlocal written
        if not str(file.name).endswith("poses.csv"):
            return write(file, data)
        if written + len(data) > 700:
            if written == 700:
                raise OSError(errno.ENOSPC, "No space left on device")
            data = data[: 700 - written]
        written += len(data)
        return write(file, data)

    # What a raw file does on a disk that is full: a part, then nothing.
    monkeypatch.setattr(line_file, "_write", filling)
    with pytest.raises(OutputError, match=r"poses\.csv': No space left on device"):
        run(quick(sequence_path, out, preset=preset))
    text = (out / "poses.csv").read_bytes()
    assert text.endswith(b"\n") and 300 < len(text) <= 700
    assert summary_in(out)["ended"] == "failed" and "No space left" in summary_in(out)["message"]


def interrupted(sequence_path, out, windows=3, **settings):
    """A run that ends early, after some windows."""
    with pytest.raises(RuntimeError):
        run(quick(sequence_path, out, preset="causal", **settings), [Broken(RuntimeError("power"), at=windows)])


def test_a_run_is_taken_up_where_it_ended(sequence_path, tmp_path):
    whole = run(quick(sequence_path, tmp_path / "whole", preset="causal"))
    interrupted(sequence_path, tmp_path / "out")
    before = (tmp_path / "out" / "poses.csv").read_bytes()
    # Killed while it wrote: a line that is not whole, and a window that only one file has.
    (tmp_path / "out" / "poses.csv").write_bytes(before + b"20499,box,0.1")
    with (tmp_path / "out" / "trajectory_box.tum").open("a") as file:
        file.write("0.020499 0 0 0 0 0 0 1\n")
    summary = run(quick(sequence_path, tmp_path / "out", preset="causal"), resume=True)
    assert (tmp_path / "out" / "poses.csv").read_bytes().startswith(before)
    trajectory, expected = (read_tum(tmp_path / name / "trajectory_box.tum") for name in ("out", "whole"))
    assert trajectory.t_us.tolist() == expected.t_us.tolist()
    assert rotation_angle_deg(trajectory.T_cam_obj[:, :3, :3], expected.T_cam_obj[:, :3, :3]).max() < 1.5
    assert (summary.ended, summary.resumed_us, summary.windows) == ("completed", 15_499, 8)
    assert summary.duration_s == whole.duration_s
    assert summary.events < whole.events
    of_object = summary.objects["box"]
    assert of_object.status == {"UNCERTAIN": 4, "TRACKING": 4} and of_object.errors.windows == 7
    rows = list(csv.DictReader((tmp_path / "out" / "poses.csv").read_text().splitlines()))
    errors = [float(row["rotation_error_deg"]) for row in rows if row["rotation_error_deg"]]
    assert of_object.errors.mean_rotation_deg == pytest.approx(np.mean(errors), rel=1e-4)
    assert of_object.mean_quality == pytest.approx(np.mean([float(row["quality"]) for row in rows]), rel=1e-3)


def test_a_run_that_has_no_pose_yet_is_taken_up_at_its_start(sequence_path, tmp_path):
    interrupted(sequence_path, tmp_path / "out", windows=1)
    (tmp_path / "out" / "poses.csv").write_bytes(b"t_us,la")
    (tmp_path / "out" / "trajectory_box.tum").write_bytes(b"")
    summary = run(quick(sequence_path, tmp_path / "out", preset="causal"), resume=True)
    assert (summary.windows, summary.resumed_us) == (8, None)
    assert len(read_tum(tmp_path / "out" / "trajectory_box.tum")) == 8
    assert len(list(csv.DictReader((tmp_path / "out" / "poses.csv").read_text().splitlines()))) == 8


def test_what_cannot_be_taken_up_is_told(sequence_path, tmp_path):
    with pytest.raises(MissingFileError, match="holds no run to take up"):
        run(quick(sequence_path, tmp_path / "out"), resume=True)
    assert list(tmp_path.iterdir()) == []
    interrupted(sequence_path, tmp_path / "out")
    with pytest.raises(ConfigError, match=r"other settings: tracker\.window\.duration_us was 5000, is 4000"):
        run(quick(sequence_path, tmp_path / "out", preset="causal", tracker={"window": {"duration_us": 4000}}), resume=True)
    table = tmp_path / "out" / "poses.csv"
    good = table.read_text()
    for bad, expected in ((good.replace(",box,", ",cup,"), "row 2 .* not of the object 'box'"), (good.replace("t_us", "t"), "is no table of poses")):
        table.write_text(bad)
        with pytest.raises(UnknownFormatError, match=expected):
            run(quick(sequence_path, tmp_path / "out", preset="causal"), resume=True)
    table.write_text(good)
    run(quick(sequence_path, tmp_path / "out", preset="causal"), resume=True)
    with pytest.raises(ConfigError, match="is complete"):
        run(quick(sequence_path, tmp_path / "out", preset="causal"), resume=True)


def test_of_many_those_that_are_complete_are_left_out(folder, tmp_path):
    configs = [quick(folder / f"{name}.npz", tmp_path / name, preset="causal") for name in ("one", "two")]
    run(configs[0])
    interrupted(folder / "two.npz", tmp_path / "two")
    before = (tmp_path / "one" / "summary.json").read_bytes()
    outcomes = dict(run_many(configs, resume=True))
    assert list(outcomes) == [1] and outcomes[1].ended == "completed" and outcomes[1].resumed_us is not None
    assert outcomes[1].windows == len(read_tum(tmp_path / "two" / "trajectory_left.tum")) == len(read_tum(tmp_path / "two" / "trajectory_right.tum"))
    assert (tmp_path / "one" / "summary.json").read_bytes() == before


def test_a_new_run_replaces_all_files_of_an_earlier_one(sequence_path, tmp_path):
    run(quick(sequence_path, tmp_path / "out"))
    (tmp_path / "out" / "trajectory_gone.tum").write_text("old")
    (tmp_path / "out" / "notes.txt").write_text("mine")
    run(quick(sequence_path, tmp_path / "out"))
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert "trajectory_gone.tum" not in names
    assert "notes.txt" in names


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interrupt_ends_the_run_with_complete_outputs(sequence_path, tmp_path, number):
    class InterruptAtThird:
        count = 0

        def add(self, step):
            self.count += 1
            if self.count == 3:
                os.kill(os.getpid(), number)

        def close(self):
            pass

    handler = signal.getsignal(number)
    summary = run(quick(sequence_path, tmp_path / "out", preset="causal"), [InterruptAtThird()])
    assert summary.interrupted
    assert signal.getsignal(number) is handler
    assert len(read_tum(tmp_path / "out" / "trajectory_box.tum")) == summary.windows == 3
    summary = summary_in(tmp_path / "out")
    assert (summary["ended"], summary["interrupted"], summary["message"]) == ("interrupted", True, f"ended by {number.name}")


def test_a_signal_that_is_ignored_stays_ignored(sequence_path, tmp_path):
    class Hangup(Broken):
        def add(self, step):
            os.kill(os.getpid(), signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert run(quick(sequence_path, tmp_path / "out"), [Hangup(None)]).ended == "completed"
    finally:
        signal.signal(signal.SIGHUP, before)


def test_threads_are_as_before_after_a_run(sequence_path, tmp_path):
    before = torch.get_num_threads()
    summary = run(quick(sequence_path, tmp_path / "out", threads=2, end_us=6000))
    assert summary.threads == 2
    assert torch.get_num_threads() == before


@pytest.mark.parametrize("mode", ["time", "count"])
def test_track_yields_one_result_per_window(sequence_path, mode):
    config = RunConfig(source=sequence_path)
    session = open_session(config)
    tracker = build_tracker([session], config)
    state = tracker.init(session.T_cam_obj, session.start_us)
    results = list(track(session.events, tracker, state, WindowConfig(mode=mode, duration_us=10_000, count=400)))
    assert len(results) == (4 if mode == "time" else -(-len(np.load(sequence_path)["t"]) // 400))
    truth = session.ground_truth[0].at(results[-2].t_us)
    assert rotation_angle_deg(results[-2].T_cam_obj[:, :3, :3], truth[:, :3, :3]).item() < 1


def test_track_says_when_there_is_nothing_to_track(sequence_path):
    config = RunConfig(source=sequence_path)
    session = open_session(config)
    tracker = build_tracker([session], config)
    state = tracker.init(session.T_cam_obj, 10**9)
    with pytest.raises(EventDataError, match="no events after 1000000000"):
        next(track(session.events, tracker, state))


def test_clipping_reads_no_further_than_needed():
    def chunks():
        yield events_of([1, 2, 3])
        yield events_of([])
        yield events_of([4, 5, 6])
        raise RuntimeError("read too far")

    assert [chunk.t_us.tolist() for chunk in clipped(chunks(), 2, 5)] == [[3], [4, 5]]


def pose_settings(sequence_path):
    T = read_sequence(sequence_path).objects[0].ground_truth.T_cam_obj[0]
    return {"matrix": T.tolist()}


def text_source(sequence_path, folder):
    """The sequence's events as text, which brings neither camera nor objects."""
    arrays = np.load(sequence_path)
    lines = [f"{1e-6 * t:.6f} {x} {y} {p}" for t, x, y, p in zip(arrays["t"], arrays["x"], arrays["y"], arrays["p"], strict=True)]
    path = folder / "events.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def camera_settings():
    return {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}


def test_plain_events_with_camera_mesh_and_pose_give_the_same_poses(sequence_path, tmp_path):
    run(quick(sequence_path, tmp_path / "sequence", start_us=500))
    obj = {"label": "box", "mesh": sequence_path.with_name("tiny_box.ply"), "initial_pose": pose_settings(sequence_path)}
    source = text_source(sequence_path, tmp_path)
    summary = run(quick(source, tmp_path / "text", start_us=0, camera=camera_settings(), objects=[obj]))
    assert summary.objects["box"].errors is None
    status = summary.objects["box"].status
    # The first windows have to confirm the pose.
    assert status == {"UNCERTAIN": 2, "TRACKING": summary.windows - 2}


def test_plain_events_need_camera_objects_and_pose(sequence_path, tmp_path):
    source, mesh = text_source(sequence_path, tmp_path), sequence_path.with_name("tiny_box.ply")
    with pytest.raises(ConfigError, match="camera: .*holds events alone"):
        open_session(RunConfig(source=source))
    with pytest.raises(ConfigError, match="brings no objects"):
        open_session(RunConfig(source=source, camera=camera_settings()))
    with pytest.raises(ConfigError, match="'box' has no model"):
        open_session(RunConfig(source=source, camera=camera_settings(), objects=[{"label": "box"}]))
    with pytest.raises(ConfigError, match="'box' needs an initial_pose"):
        open_session(RunConfig(source=source, camera=camera_settings(), objects=[{"label": "box", "mesh": mesh}]))


def test_an_object_that_the_sequence_does_not_know(sequence_path):
    with pytest.raises(ConfigError, match="'cup' has no model.*its objects are box"):
        open_session(RunConfig(source=sequence_path, objects=[{"label": "cup"}]))


@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        ({"matrix": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]}, "not a rotation"),
        ({"translation_m": [0, 0, -0.5]}, "behind the camera"),
    ],
)
def test_poses_that_cannot_be(sequence_path, tmp_path, pose, expected):
    with pytest.raises(PoseError, match=expected):
        run(quick(sequence_path, tmp_path / "out", objects=[{"label": "box", "initial_pose": pose}]))
    assert list(tmp_path.iterdir()) == []


def test_initial_pose_from_a_trajectory_or_a_quaternion(sequence_path, tmp_path):
    run(quick(sequence_path, tmp_path / "out"))
    trajectory = read_tum(tmp_path / "out" / "trajectory_box.tum")
    pose = {"trajectory": tmp_path / "out" / "trajectory_box.tum"}
    session = open_session(RunConfig(source=sequence_path, start_us=int(trajectory.t_us[2]), objects=[{"label": "box", "initial_pose": pose}]))
    assert torch.allclose(session.T_cam_obj[0], trajectory.T_cam_obj[2])
    pose = {"translation_m": [0, 0, 0.5], "quaternion_xyzw": [0, 0, 1, 0]}
    session = open_session(RunConfig(source=sequence_path, objects=[{"label": "box", "initial_pose": pose}]))
    assert torch.allclose(session.T_cam_obj[0, :3, :3], torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)))


def test_a_stream_without_events_says_so(sequence_path, tmp_path):
    with pytest.raises(EventDataError, match=r"no events after 900000 µs to track with"):
        run(quick(sequence_path, tmp_path / "out", start_us=900_000))
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_archive(tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"PK\x03\x04 and nothing else")
    with pytest.raises(EventDataError, match=r"bad\.npz"):
        open_session(RunConfig(source=tmp_path / "bad.npz"))


def test_the_end_is_expected_by_the_truth_or_the_settings_or_what_was_read(sequence_path, tmp_path):
    assert open_session(RunConfig(source=sequence_path)).expected_end_us == 40_000
    assert open_session(RunConfig(source=sequence_path, end_us=10_499)).expected_end_us == 10_499
    obj = {"label": "box", "mesh": sequence_path.with_name("tiny_box.ply"), "initial_pose": pose_settings(sequence_path)}
    config = RunConfig(source=text_source(sequence_path, tmp_path), camera=camera_settings(), objects=[obj])
    session = open_session(config)
    ends_us = [(session.expected_end_us, int(chunk.t_us[-1])) for chunk in session.chunks()]
    assert ends_us[-1][0] == pytest.approx(ends_us[-1][1], rel=0.1)


def test_missing_source_and_missing_device(sequence_path, tmp_path):
    with pytest.raises(MissingFileError, match="nowhere"):
        run(quick(tmp_path / "nowhere.npz", tmp_path / "out"))
    if not torch.cuda.is_available():
        with pytest.raises(ConfigError, match="no CUDA device"):
            run(quick(sequence_path, tmp_path / "out", device="cuda"))


def test_a_calibration_that_makes_no_sense(sequence_path, tmp_path):
    path = tmp_path / "calib.txt"
    path.write_text("0 0 0 0\n")
    with pytest.raises(CalibrationError, match="focal lengths"):
        open_session(RunConfig(source=sequence_path, camera={"calibration": path, "width": 120, "height": 90}))


def test_overlay_and_alignment_are_written_when_asked_for(sequence_path, tmp_path):
    summary = run(RunConfig(source=sequence_path, output=tmp_path / "out", overlay={"stills": 2}, alignment=True))
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert "overlay.mp4" in names
    assert sum(name.startswith("overlay_") and name.endswith(".png") for name in names) == 2
    measured = summary.objects["box"].more["alignment"]
    assert measured["tracked"]["median_px"] < 1
    assert measured["tracked"]["share_near"] > 0.9


@pytest.mark.parametrize("preset", ["default", "line", "nns", "guided"])
def test_an_overlay_shows_events_and_corners_whatever_the_tracker_makes_use_of(sequence_path, tmp_path, preset):
    run(RunConfig(source=sequence_path, output=tmp_path / "out", preset=preset, overlay={"stills": 1}))
    (still,) = (tmp_path / "out").glob("overlay_*.png")
    blue, green, red = cv2.imread(str(still)).reshape(-1, 3).astype(int).T
    grey, yellow = (red == green) & (green == blue) & (red > 60) & (red < 200), (green > 150) & (red > 150) & (blue < 90)
    assert grey.sum() > 100
    assert yellow.sum() > 20


@pytest.mark.parametrize(
    ("name", "expected"), [("default", "not used in tracking"), ("nns", "corners"), ("guided", "their flow"), ("paper", "their flow")]
)
def test_an_overlay_says_whether_what_it_shows_was_used(name, expected):
    assert note(torchtrack.preset(name)).endswith(expected)


def test_planar_shapes_of_a_real_recording(data_dir, tmp_path):
    config = load(RunConfig, REPOSITORY / "configs" / "track" / "shapes_rotation.yaml", recording_in(data_dir, tmp_path))
    summary = run(config)
    facts = json.loads((tmp_path / "out" / "summary.json").read_text())["objects"]["shapes"]
    tracked, initial = facts["more"]["alignment"]["tracked"]["median_px"], facts["more"]["alignment"]["initial"]["median_px"]
    assert tracked < 1.5 < 3 < initial
    assert summary.objects["shapes"].status == {"UNCERTAIN": 2, "TRACKING": 18}
    # The camera turns, so the shapes turn the other way.
    recovered, of_camera = np.array(facts["angular_velocity_rad_s"]), np.array(facts["more"]["reference_angular_velocity"])
    assert np.abs(recovered + of_camera).max() < 0.4


def recording_in(data_dir, folder):
    """Overrides that take the recording from where the data is."""
    recording = data_dir / "recordings" / "shapes_rotation"
    return {
        "source": str(recording / "events.txt"),
        "camera.calibration": str(recording / "calib.txt"),
        "reference_angular_velocity": str(recording / "motion.txt"),
        "output": str(folder / "out"),
        "overlay.enabled": False,
    }


@pytest.mark.parametrize("text", ["1 2", "1 2 x"])
def test_a_reference_that_is_no_three_numbers(sequence_path, tmp_path, text):
    (tmp_path / "motion.txt").write_text(text)
    with pytest.raises(UnknownFormatError, match=r"motion\.txt.* must hold 3 numbers"):
        run(quick(sequence_path, tmp_path / "out", end_us=6000, reference_angular_velocity=tmp_path / "motion.txt"))
    with pytest.raises(MissingFileError, match="nowhere"):
        run(quick(sequence_path, tmp_path / "out", end_us=6000, reference_angular_velocity=tmp_path / "nowhere.txt"))
