"""Many sessions in one tracker: each as if it were alone, whatever becomes of the others."""

import csv
import json
from functools import partial

import numpy as np
import pytest
import torch
from tiny_sequence import write_tiny_sequence

from torchtrack.config.run import RunConfig
from torchtrack.errors import ConfigError, EventDataError
from torchtrack.run.executor import TaskFailure
from torchtrack.run.runner import run, run_many
from torchtrack.run.session import open_session
from torchtrack.run.sinks.summary import RunSummary
from torchtrack.run.stepping import cut_windows
from torchtrack.run.streams import follow


@pytest.fixture(scope="module")
def paths(tmp_path_factory):
    """Sequences of one, two and one object, and of different lengths."""
    folder = tmp_path_factory.mktemp("sequences")
    labels = {"short": ("box",), "pair": ("left", "right"), "long": ("box",)}
    return [write_tiny_sequence(folder, name, labels[name], duration) for name, duration in (("short", 20_000), ("pair", 30_000), ("long", 40_000))]


def quick(path, output, **settings):
    """A run without an overlay, into a folder of the sequence's name."""
    return RunConfig(**{"source": path, "output": output / path.stem, "overlay": {"enabled": False}, **settings})


def poses(folder):
    """The poses of a run: which window and object they are of, and their numbers."""
    rows = list(csv.DictReader((folder / "poses.csv").read_text().splitlines()))
    names = [(row["t_us"], row["label"], row["status"]) for row in rows]
    return names, np.array([[float(row[name]) for name in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")] for row in rows])


def assert_same_runs(together, alone):
    """Poses of two folders are the same but for rounding, which may decide whether an observation lies within a gate."""
    (names, values), (expected_names, expected) = poses(together), poses(alone)
    assert names == expected_names
    np.testing.assert_allclose(values, expected, rtol=0, atol=5e-4)


METHODS = [{}, {"tracker": {"window": {"mode": "count", "count": 300}}}, {"preset": "line"}, {"preset": "nns"}]


@pytest.mark.parametrize("settings", METHODS, ids=["default", "count", "line", "nns"])
def test_streams_are_tracked_as_each_alone_until_each_ends(paths, tmp_path, settings):
    starts_us = (None, 7_000, 3_300)
    for path, start_us in zip(paths, starts_us, strict=True):
        run(quick(path, tmp_path / "alone", start_us=start_us, **settings))
    configs = [quick(path, tmp_path / "together", start_us=start_us, **settings) for path, start_us in zip(paths, starts_us, strict=True)]
    summaries = dict(run_many(configs, streams=3))
    assert [summaries[number].source for number in range(3)] == ["short", "pair", "long"]
    for path in paths:
        assert_same_runs(tmp_path / "together" / path.stem, tmp_path / "alone" / path.stem)
        stored = json.loads((tmp_path / "together" / path.stem / "summary.json").read_text())
        assert stored["windows"] == summaries[paths.index(path)].windows > 2


def test_images_of_different_sizes_and_settings_are_batches_of_their_own(paths, tmp_path):
    differing = [{}, {"events": {"region": (10, 5, 105, 80)}}, {"tracker": {"window": {"duration_us": 4000}}}]
    for path, settings in zip(paths, differing, strict=True):
        run(quick(path, tmp_path / "alone", **settings))
    summaries = dict(run_many([quick(path, tmp_path / "together", **settings) for path, settings in zip(paths, differing, strict=True)], streams=3))
    assert all(isinstance(summary, RunSummary) for summary in summaries.values())
    for path in paths:
        assert_same_runs(tmp_path / "together" / path.stem, tmp_path / "alone" / path.stem)


def test_a_source_that_cannot_be_tracked_does_not_stop_the_others(paths, tmp_path):
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    far = {"label": "box", "initial_pose": {"translation_m": [0.0, 0.0, -1.0]}}
    behind = quick(paths[0], tmp_path / "out", objects=[far])
    configs = [quick(tmp_path / "bad.npz", tmp_path / "out"), behind, quick(paths[2], tmp_path / "out")]
    outcomes = dict(run_many(configs, streams=3))
    assert isinstance(outcomes[0], TaskFailure) and "bad.npz" in outcomes[0].reason
    assert isinstance(outcomes[1], TaskFailure) and "behind the camera" in outcomes[1].reason
    assert outcomes[2].objects["box"].errors.max_rotation_deg < 2
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["long"]


class Counting:
    """Follows a sequence and counts its steps; its events, or itself, may break."""

    def __init__(self, path, broken_after=None, full_after=None):
        self.session = open_session(RunConfig(source=path))
        self.broken_after, self.full_after = broken_after, full_after
        self.steps, self.closed = [], False

    def windows(self, config):
        for number, window in enumerate(cut_windows(self.session.chunks(), self.session.start_us, config)):
            if number == self.broken_after:
                raise EventDataError("time goes back")
            yield window

    def add(self, step):
        if len(self.steps) == self.full_after:
            raise EventDataError("the disk of the test is full")
        self.steps.append(step)

    def finish(self):
        return len(self.steps)

    def close(self, error=None):
        self.closed = True


@pytest.mark.parametrize(("fault", "message"), [({"broken_after": 2}, "time goes back"), ({"full_after": 2}, "disk of the test is full")])
def test_a_stream_that_fails_on_its_way_leaves_and_the_others_go_on(paths, fault, message):
    followers = [Counting(paths[0], **fault), Counting(paths[2])]
    failed, windows = follow([partial(lambda opened: opened, follower) for follower in followers], RunConfig(source=paths[0], preset="causal"))
    assert message in str(failed)
    assert (len(followers[0].steps), windows) == (2, 8)
    assert all(follower.closed for follower in followers)
    alone = Counting(paths[2])
    follow([lambda: alone], RunConfig(source=paths[2], preset="causal"))
    torch.testing.assert_close(followers[1].steps[-1].result.T_cam_obj, alone.steps[-1].result.T_cam_obj, rtol=0, atol=5e-4)


def test_a_step_holds_its_own_stream_alone(paths):
    followers = [Counting(path) for path in paths]
    follow([partial(lambda opened: opened, follower) for follower in followers], RunConfig(source=paths[0]))
    for follower in followers:
        step = follower.steps[0]
        objects = len(follower.session.models)
        assert step.result.T_cam_obj.shape == (objects, 4, 4)
        assert step.result.contours.pixels.shape[0] == step.result.corners.flow.shape[0] == objects
        assert step.state.maps.last_event_us.shape[0] == len(step.state.t_us) == 1
        assert int(step.result.t_us[0]) == step.window.t_end_us
        assert step.seconds > 0


def test_whoever_is_stopped_finishes_with_what_there_is(paths):
    followers = [Counting(path) for path in paths]
    opening = [partial(lambda opened: opened, follower) for follower in followers]
    assert follow(opening, RunConfig(source=paths[0], preset="causal"), lambda: len(followers[2].steps) == 2) == [2, 2, 2]


def test_processes_give_the_same_as_one(paths, tmp_path):
    summaries = [dict(run_many([quick(path, tmp_path / name) for path in paths[:2]], jobs=jobs)) for name, jobs in (("alone", 1), ("shared", 2))]
    assert all(isinstance(summary, RunSummary) for of_run in summaries for summary in of_run.values())
    for path in paths[:2]:
        table, expected = ((tmp_path / name / path.stem / "poses.csv").read_text() for name in ("shared", "alone"))
        assert table == expected


@pytest.mark.parametrize(
    ("sources", "options", "message"),
    [
        (("a/tiny.npz", "b/tiny.npz"), {}, "several sources would go to"),
        (("stdin://", "a.npz"), {}, "'stdin://' is live"),
        (("a.npz", "b.npz"), {"streams": 0}, "streams: at least one is needed, got 0"),
        (("a.npz", "b.npz"), {"jobs": 0}, "jobs: at least one process is needed, got 0"),
    ],
)
def test_runs_that_do_not_go_together_are_errors(sources, options, message, tmp_path):
    configs = [RunConfig(source=source, output=tmp_path / source.rpartition("/")[-1]) for source in sources]
    with pytest.raises(ConfigError, match=message):
        next(run_many(configs, **options))


def test_shared_sequences_are_tracked_as_each_alone(data_dir, tmp_path):
    sources = [data_dir / "sequences" / f"{name}.npz" for name in ("ape_normal", "lbracket_normal")]
    ends_us = (40_000, 30_000)
    configs = [quick(path, tmp_path / "together", end_us=end_us) for path, end_us in zip(sources, ends_us, strict=True)]
    assert len(dict(run_many(configs, streams=2))) == 2
    for path, end_us in zip(sources, ends_us, strict=True):
        run(quick(path, tmp_path / "alone", end_us=end_us))
        assert_same_runs(tmp_path / "together" / path.stem, tmp_path / "alone" / path.stem)
