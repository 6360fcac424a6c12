"""Searches beside the windows: what is lost is found later, its neighbours notice nothing, and the poses hang on nothing but the settings."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from states import changed
from tracked_boxes import WIDE_CAMERA, WINDOW_US, assert_same, follow, moving_box, poses_of, scene_of_one_stream, scene_of_streams, windows

from torchtrack import Tracker
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.events import EventBatch
from torchtrack.core.host_sync import HostReads
from torchtrack.core.later import Ahead, Later
from torchtrack.core.lie import retract_about
from torchtrack.run.stepping import passed_over
from torchtrack.tracking import step
from torchtrack.tracking.deferred_search import answered, with_search
from torchtrack.tracking.expectation import expect, near_objects
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.relocalization.triggers import AROUND_LAST_SEEN, AROUND_PREDICTION, Trigger, next_kind
from torchtrack.tracking.state import Answer, Search, joined, take_part
from torchtrack.tracking.validation.status import Status
from torchtrack.tracking.validation.verdict import Limits

LATE_WINDOWS, COUNT, FROM = 3, 26, 5
LATER = TrackerConfig(relocalization=RelocalizationConfig(answer_after_us=LATE_WINDOWS * WINDOW_US))
UNSEARCHED = TrackerConfig(relocalization=RelocalizationConfig(hypotheses=0))
# Edges are farther off than the tight gate reaches.
DISPLACED = torch.tensor([[0.117, -0.078, 0.156, 0.0104, -0.0078, 0.0]], dtype=torch.float64)


@torch.no_grad()
def one_lost(config=LATER, scene=scene_of_one_stream, lost=(0,)):
    """A tracker of two boxes in full motion, its state with some of them put elsewhere, and the windows from there on."""
    starts, index, cameras, cut = scene(COUNT)
    tracker = Tracker([box_model()] * 2, cameras, config, index)
    state, _ = follow(tracker, tracker.init(torch.stack(starts), torch.zeros(len(cameras), dtype=torch.int64)), cut[:FROM])
    T_cam_obj = state.T_cam_obj.clone()
    for number in lost:
        T_cam_obj[number] = retract_about(T_cam_obj[[number]], DISPLACED, tracker.centre_obj[[number]].double())[0]
    # There were searches at the start.
    return tracker, changed(replace(state, search=None), T_cam_obj=T_cam_obj), cut[FROM:]


@torch.no_grad()
def run(tracker, state, cut):
    """The state after each window, and the results."""
    states, results = [], []
    for events, end_us in cut:
        state, result = tracker.step(state, events, end_us)
        states.append(state)
        results.append(result)
    return states, results


def true_pose(number, end_us):
    starts, *_ = scene_of_one_stream(1)
    return moving_box(starts[number], COUNT, WIDE_CAMERA, seed=number)[0].at(torch.as_tensor(end_us).reshape(-1)[:1])[0]


def degrees_off(result, number=0):
    return float(pose_errors(result.T_cam_obj[number], true_pose(number, result.t_us))[0])


# ---- what is found


def test_what_is_lost_is_found_again_later_and_without_a_search_it_is_not():
    states, results = run(*one_lost())
    _, without = run(*one_lost(UNSEARCHED))
    first = next(number for number, result in enumerate(results) if degrees_off(result) < 2)
    assert first >= LATE_WINDOWS and states[first - 1].search.answer is not None
    for before in range(first):
        assert torch.equal(results[before].T_cam_obj, without[before].T_cam_obj)
    assert degrees_off(without[first]) > 3
    assert degrees_off(results[-1]) < 1.2 and int(results[-1].status[0]) == Status.TRACKING


def test_its_neighbour_has_the_same_digits_whether_it_is_lost_or_not():
    _, lost = run(*one_lost())
    _, held = run(*one_lost(lost=()))
    _, waited = run(*one_lost(TrackerConfig(), lost=()))
    assert degrees_off(lost[LATE_WINDOWS]) > 3
    assert torch.equal(poses_of(lost, 1), poses_of(held, 1))
    assert torch.equal(poses_of(held, 1), poses_of(waited, 1))
    assert [int(result.status[1]) for result in lost] == [int(result.status[1]) for result in held]


def test_in_any_stream():
    tracker, state, cut = one_lost(scene=scene_of_streams, lost=(1,))
    trajectory = moving_box(pose((0.4, -0.7, 0.3)), COUNT, WIDE_CAMERA, stream=1)[0]
    _, results = run(tracker, state, cut)
    _, without = run(*one_lost(UNSEARCHED, scene_of_streams, lost=(1,)))
    off, unsearched = (pose_errors(poses_of(each, 1), trajectory.at(torch.stack([r.t_us[1] for r in each])))[0] for each in (results, without))
    first = int((off < 2).nonzero()[0])
    assert first >= LATE_WINDOWS and float(unsearched[first]) > 3
    assert torch.equal(poses_of(results, 0), poses_of(without, 0))


def test_what_is_asked_for_meanwhile_is_searched_for_next():
    """With one look for a stream in a window, two that are lost take two searches, one after the other."""
    config = TrackerConfig(relocalization=RelocalizationConfig(answer_after_us=LATE_WINDOWS * WINDOW_US, objects=1))
    states, results = run(*one_lost(config, lost=(0, 1)))
    since = {int(state.search.since_us[0]) for state in states if state.search is not None and state.search.answer is not None}
    assert len(since) >= 2 and min(b - a for a, b in zip(sorted(since), sorted(since)[1:], strict=False)) > LATE_WINDOWS * WINDOW_US
    assert max(degrees_off(results[-1], number) for number in range(2)) < 1.2


@torch.no_grad()
@pytest.mark.parametrize(
    ("is_under_way", "trigger", "is_everywhere"),
    [(False, Trigger.DEPTH_CHANGED, True), (False, Trigger.UNCERTAIN, False), (True, Trigger.DEPTH_CHANGED, False)],
)
def test_events_from_all_over_are_gathered_where_a_search_can_start_that_needs_them(is_under_way, trigger, is_everywhere):
    (state, _), answer, _ = window_and_answer()
    tracker, t_us = Tracker([box_model()], SMALL_CAMERA), state.t_us + WINDOW_US
    events = EventBatch.from_numpy(np.array([1]), np.array([1]), t_us.numpy(), np.ones(1, dtype=bool))
    expected = expect(tracker, state, events, t_us, HostReads())
    last = Search(state.t_us, torch.tensor([int(trigger)]), Later(lambda: answer) if is_under_way else None)
    near = near_objects(tracker, state, expected, NearbyEvents(events), last)
    assert bool(near.near_tiles.all()) == is_everywhere


# ---- what poses hang on


class _Never(Ahead):
    """Computes nothing before it is asked for."""

    def compute(self, later):
        pass


class _AtOnce(Ahead):
    """Computes all at once."""

    def compute(self, later):
        later.value()


@pytest.mark.parametrize("ahead", [_Never, _AtOnce])
def test_when_a_search_is_done_changes_no_digit(ahead):
    tracker, state, cut = one_lost()
    states, results = run(tracker, state, cut)
    tracker._ahead = ahead()
    other_states, others = run(tracker, state, cut)
    assert_same(results[-1], others[-1])
    assert torch.equal(poses_of(results), poses_of(others))
    assert [state.search is None for state in states] == [state.search is None for state in other_states]


def test_the_same_state_may_be_gone_on_from_twice():
    tracker, state, cut = one_lost()
    states, results = run(tracker, state, cut)
    under_way = next(number for number, state in enumerate(states) if state.search is not None)
    _, again = run(tracker, states[under_way], cut[under_way + 1 :])
    assert torch.equal(poses_of(again), poses_of(results[under_way + 1 :]))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))], ids=["deepcopy", "pickle"])
def test_a_copy_goes_on_with_the_search(copied):
    tracker, state, cut = one_lost()
    states, results = run(tracker, state, cut)
    under_way = next(number for number, state in enumerate(states) if state.search is not None)
    other_tracker, other_state = copied((tracker, states[under_way]))
    _, others = run(other_tracker, other_state, cut[under_way + 1 :])
    assert torch.equal(poses_of(others), poses_of(results[under_way + 1 :]))


def test_where_gradients_are_recorded_searches_are_waited_for():
    tracker, state, cut = one_lost()
    at_once = Tracker([box_model()] * 2, WIDE_CAMERA)
    with torch.enable_grad():
        after, result = tracker.step(state, *cut[0])
        assert after.search is None
        expected = at_once.step(state, *cut[0])[1]
    assert torch.equal(result.T_cam_obj, expected.T_cam_obj)


def test_no_part_of_a_state_has_the_search_nor_what_is_made_of_parts():
    states, _ = run(*one_lost())
    state = next(state for state in states if state.search is not None)
    part = take_part(state, slice(0, 1), slice(0, 1))
    assert part.search is None and joined([state, state]).search is None and state.without_maps().search is None


def test_a_gap_ends_it():
    tracker, state, cut = one_lost()
    states, _ = run(tracker, state, cut)
    state = next(state for state in states if state.search is not None)
    assert passed_over(tracker, state, state.t_us + 100_000).search is None


def test_what_goes_wrong_in_a_search_is_raised_by_the_window_that_it_is_due_in(monkeypatch):
    tracker, state, cut = one_lost()

    def broken(*args):
        raise ArithmeticError("of the search")

    monkeypatch.setattr(step, "relocalize", broken)
    taken = []
    with pytest.raises(ArithmeticError, match="of the search"), torch.no_grad():
        for events, end_us in cut:
            state, _ = tracker.step(state, events, end_us)
            taken.append(state.search is None)
    assert taken[-LATE_WINDOWS:] == [False] * LATE_WINDOWS


# ---- answers


@torch.no_grad()
def window_and_answer(**values):
    """State and result of a window of a box, and an answer that found nothing."""
    tracker = Tracker([box_model()], SMALL_CAMERA)
    _, events = moving_box(pose(), 6)
    state, results = follow(tracker, tracker.init(pose()[None], 0), windows(events, 6))
    state = changed(state, **values)
    answer = Answer(looked=torch.tensor([True]), is_unconfirmed=torch.tensor([True]), relocalized={})
    return (state, results[-1]), answer, Limits.from_config(tracker.config)


def test_a_look_that_found_nothing_is_counted():
    taken, answer, limits = window_and_answer(time_since_validated_s=torch.tensor([0.1]), looks=torch.tensor([3]))
    assert int(answered(taken, answer, limits)[0].health.looks) == 4


@pytest.mark.parametrize("is_unconfirmed", [True, False])
def test_a_look_for_rivals_that_found_none_confirms(is_unconfirmed):
    limits = Limits.from_config(TrackerConfig())
    taken, answer, _ = window_and_answer(confirmations=torch.tensor([float(limits.speaking_windows)]))
    answer = replace(answer, is_unconfirmed=torch.tensor([is_unconfirmed]))
    expected = limits.confirmed_by if is_unconfirmed else limits.speaking_windows
    assert float(answered(taken, answer, limits)[0].health.confirmations) == expected


@pytest.mark.parametrize(
    ("score", "status", "own_status", "is_taken"),
    [
        (0.9, Status.TRACKING, Status.TRACKING, True),
        (0.1, Status.TRACKING, Status.TRACKING, False),
        (0.1, Status.LOST, Status.TRACKING, True),
        (0.9, Status.TRACKING, Status.LOST, False),
    ],
)
def test_what_was_found_has_to_be_better_by_then(score, status, own_status, is_taken):
    (state, result), answer, limits = window_and_answer(score=torch.tensor([0.5]))
    better = changed(state, T_cam_obj=pose(translation=(0.0, 0.0, 0.7))[None], score=torch.tensor([score]))
    own = better, replace(result, T_cam_obj=better.T_cam_obj, status=torch.tensor([int(own_status)]))
    answer = replace(answer, relocalized={0: own})
    taken = answered((state, replace(result, status=torch.tensor([int(status)]))), answer, limits)
    T_cam_obj = better.T_cam_obj if is_taken else state.T_cam_obj
    assert torch.equal(taken[0].T_cam_obj, T_cam_obj)
    assert torch.equal(taken[1].T_cam_obj, T_cam_obj if is_taken else result.T_cam_obj)
    assert taken[0].maps is not better.maps or not is_taken


def test_kinds_of_search_have_their_turns():
    ahead, kinds = _Never(), []
    (state, result), _, _ = window_and_answer()
    triggers = torch.tensor([int(Trigger.UNCERTAIN | Trigger.FAR_BELOW_REFERENCE)])
    search = Search(state.t_us, triggers)
    for _ in range(3):
        kind = next_kind(search.triggers | triggers, search.kind)
        asked = Search(state.t_us, search.triggers | triggers, Later(lambda: None), kind)
        search = with_search((replace(state, search=asked), result), search, LATER, ahead)[0].search
        kinds.append(search.kind)
        assert int(search.triggers) == int(triggers) & ~kind
        search = replace(search, answer=None)
    assert kinds == [int(AROUND_PREDICTION), int(AROUND_LAST_SEEN), int(AROUND_PREDICTION)]


def test_a_state_can_be_shown_while_a_search_goes_on():
    taken, answer, _ = window_and_answer()
    assert "TrackerState(" in repr(replace(taken[0], search=Search(taken[0].t_us, torch.zeros(1, dtype=torch.int64), Later(lambda: answer))))
