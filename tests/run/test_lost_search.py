"""What was lost for long is searched for everywhere, a part in each window: it is found at another pose, and nothing else changes."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_bracket import error_deg
from solid_models import l_prism
from tiny_sequence import CAMERA, box_events, true_poses

from torchtrack.config.presets import preset
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import so3_exp
from torchtrack.core.windows import EventWindow, windows_by_time
from torchtrack.errors import PoseError
from torchtrack.io import Trajectory
from torchtrack.object_model import ObjectModel
from torchtrack.run import searches_everywhere
from torchtrack.run.lost_search import LostSearch, with_object
from torchtrack.run.stepping import steps
from torchtrack.tracking.state import take_part
from torchtrack.tracking.tracker import Tracker
from torchtrack.tracking.validation.status import Status

GONE_US, BACK_US, END_US = 100_000, 400_000, 900_000
AFTER_US = 200_000


def config(**changes):
    """Settings of a search that looks around the last pose with few rotations: it is not what is tested."""
    causal = preset("causal")
    few = {"rotations": 60, "hypotheses": 4, "everywhere_after_us": AFTER_US} | changes
    return causal.model_copy(update={"relocalization": causal.relocalization.model_copy(update=few)})


def turned(trajectory, angle_deg, from_us):
    """The same way, with the object turned by an angle, some time later."""
    T = trajectory.T_cam_obj.clone()
    T[:, :3, :3] = T[:, :3, :3] @ so3_exp(torch.deg2rad(torch.tensor([angle_deg, 0.0, 0.0], dtype=torch.float64)))
    return Trajectory(trajectory.t_us + from_us, T)


@pytest.fixture(scope="module")
def scene():
    """Events of a bracket that goes away and comes back turned by 130°, with some noise all the while; where it is at the end."""
    before, after = true_poses(GONE_US, step_us=250), turned(true_poses(END_US - BACK_US, step_us=250), 130.0, BACK_US)
    rng = np.random.default_rng(0)
    noise = {"x": rng.integers(0, CAMERA.width, 900), "y": rng.integers(0, CAMERA.height, 900), "t_us": np.arange(900) * 1000}
    seen = [box_events(l_prism(), path) for path in (before, after)]
    x, y, t_us = (np.concatenate([*(getattr(batch, name) for batch in seen), values]) for name, values in noise.items())
    order = np.argsort(t_us, kind="stable")
    x, y, t_us = (torch.from_numpy(values[order].astype(np.int64)) for values in (x, y, t_us))
    events = EventBatch(x.short(), y.short(), t_us, torch.arange(len(t_us)) % 2 == 0, torch.zeros(len(t_us), dtype=torch.int32))
    return events, before.T_cam_obj[0], after


def tracker(settings, count=1):
    return Tracker([ObjectModel.from_mesh(l_prism(), name="bracket")] * count, CAMERA, settings)


def windows(events):
    return windows_by_time([events], 5000, 0)


def followed(scene, settings):
    events, T_first, _ = scene
    alone = tracker(settings)
    search = LostSearch(alone)
    return [*steps(windows(events), alone, alone.init(T_first[None], 0), search)], search


def test_an_object_that_comes_back_turned_is_found_again(scene):
    *_, truth = scene
    taken, search = followed(scene, config())
    last = taken[-1]
    assert error_deg(last.state.T_cam_obj[0], truth.T_cam_obj[-1]) < 5
    assert torch.allclose(last.state.T_cam_obj[0, :3, 3], truth.T_cam_obj[-1, :3, 3], atol=0.02)
    assert int(last.result.status[0]) == int(Status.TRACKING)
    # A search is many parts, of which a window takes one.
    assert 20 < search.windows <= (END_US - BACK_US) // 5000


def test_without_it_the_object_stays_lost(scene):
    *_, truth = scene
    taken, search = followed(scene, config(everywhere_after_us=0))
    assert search.windows == 0 and error_deg(taken[-1].state.T_cam_obj[0], truth.T_cam_obj[-1]) > 20


# ---- in a thread of its own

LATE_US = 10_000


def test_in_a_thread_it_ends_when_it_was_said_to(scene):
    """Later than in parts; every time with the same poses, whatever it took."""
    *_, truth = scene
    taken, search = followed(scene, config(answer_after_us=LATE_US))
    again, _ = followed(scene, config(answer_after_us=LATE_US))
    last = taken[-1]
    assert error_deg(last.state.T_cam_obj[0], truth.T_cam_obj[-1]) < 5
    assert int(last.result.status[0]) == int(Status.TRACKING)
    # With the window that it begins after.
    assert search.windows == 20 * LATE_US // 5000 + 1
    assert all(torch.equal(first.state.T_cam_obj, other.state.T_cam_obj) for first, other in zip(taken, again, strict=True))


def test_a_gap_ends_what_a_thread_does(lost, monkeypatch):
    going_on, over = threading.Event(), threading.Event()

    def endless(start, box):
        try:
            while True:
                going_on.set()
                yield
        finally:
            over.set()

    monkeypatch.setattr(searches_everywhere, "poses_in_box", endless)
    search = searched(lost, some(lost), 30, answer_after_us=1_000_000)
    assert going_on.wait(10) and not over.is_set()
    _, state, _ = lost
    empty = EventWindow(some(lost)[:0], 200_000, 205_000, after_gap=True)
    assert search.after(empty, state) is state
    assert over.wait(10)


def test_without_such_an_object_the_thread_ends_with_nothing(lost, monkeypatch):
    monkeypatch.setattr(searches_everywhere, "poses_in_box", never_anything)
    assert searched(lost, some(lost), answer_after_us=5_000).windows >= 20


# ---- when a search begins


@pytest.fixture(scope="module")
def lost(scene):
    """A tracker of two brackets, the second of which is lost for long: its state, and events of where it is again."""
    events, T_first, _ = scene
    two = tracker(config(), count=2)
    far = T_first.clone()
    far[0, 3] -= 0.15
    state, _ = two.step(two.init(torch.stack([far, T_first]), 0), events.slice_time(0, 5000), 5000)
    health = replace(
        state.health,
        mean_score=torch.tensor([0.8, 0.8]),
        reference_explained_ratio=torch.tensor([0.9, 0.9]),
        time_since_validated_s=torch.tensor([0.0, 2.0]),
    )
    return two, replace(state, health=health), events


def searched(lost, seen, count=200, **changes):
    """A search after some windows, each of the same events, and whether it was ever under way."""
    two, state, _ = lost
    two.config = config(**changes)
    search = LostSearch(two)
    for number in range(count):
        start_us = 5000 * number
        shifted = replace(seen, t_us=start_us + 1 + seen.t_us - seen.t_us[0])
        assert search.after(EventWindow(shifted, start_us, start_us + 5000), state) is state
    return search


def never_anything(start, box):
    raise PoseError("no such object")
    yield


def some(lost, shift_px=0):
    events = lost[2].slice_time(BACK_US + 50_000, BACK_US + 54_000)
    return replace(events, x=(events.x + shift_px).clamp(0, CAMERA.width - 1))


def test_a_search_that_failed_is_not_repeated_at_once(lost, monkeypatch):
    monkeypatch.setattr(searches_everywhere, "poses_in_box", never_anything)
    assert 2 <= searched(lost, some(lost)).windows <= 4


@pytest.mark.parametrize("changes", [{"everywhere_after_us": 0}, {"hypotheses": 0}, {"everywhere_after_us": 3_000_000}])
def test_no_search_where_none_is_asked_for(lost, monkeypatch, changes):
    monkeypatch.setattr(searches_everywhere, "poses_in_box", never_anything)
    assert searched(lost, some(lost), 30, **changes).windows == 0


def test_no_search_for_what_is_still_coming_into_the_image_nor_without_events(lost, monkeypatch):
    monkeypatch.setattr(searches_everywhere, "poses_in_box", never_anything)
    assert searched(lost, some(lost), 30).windows > 0
    assert searched(lost, some(lost, 60), 30).windows == 0
    assert searched(lost, some(lost)[:20], 30).windows == 0


def test_no_search_among_the_events_of_another_object(lost, monkeypatch):
    monkeypatch.setattr(searches_everywhere, "poses_in_box", never_anything)
    two, state, events = lost
    on_the_events = replace(state.motion, T_cam_obj=state.T_cam_obj[[1, 1]])
    assert searched((two, replace(state, motion=on_the_events), events), some(lost), 30).windows == 0


def test_the_others_stay_as_they_are(lost):
    _, state, _ = lost
    own = replace(state, motion=replace(state.motion, T_cam_obj=2 * state.T_cam_obj))
    row = take_part(own, slice(1, 2), slice(0, 1))
    changed = with_object(state, 1, row)
    for part in ("motion", "health"):
        for name, value in vars(getattr(state, part)).items():
            assert torch.equal(getattr(getattr(changed, part), name)[0], value[0])
    assert torch.equal(changed.T_cam_obj[1], own.T_cam_obj[1]) and float(changed.health.time_since_validated_s[1]) == 0
