"""When it is time to look for objects, and which of them the state alone says are lost, or are looked for all around."""

import pytest
import torch
from lost_states import moved_away, uncertain, unseen
from states import changed
from tracked_boxes import started

from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.relocalization.schedule import is_time, may_look_far, schedule
from torchtrack.tracking.relocalization.triggers import Trigger, has

CONFIG = TrackerConfig()


def test_it_is_time_once_in_every_interval_whatever_the_windows():
    ends_us = torch.arange(0, 100_001, 5000)
    due = is_time(ends_us[:-1], ends_us[1:], 20_000)[0]
    assert due.nonzero().flatten().tolist() == [3, 7, 11, 15, 19]
    assert is_time(ends_us[:-1], ends_us[1:], 0).all()
    assert is_time(torch.tensor([1000]), torch.tensor([61_000]), 20_000).all()
    of_each = is_time(ends_us[:-1], ends_us[1:], 20_000, 0)
    assert torch.equal(of_each[0], due) and of_each[1].all()


def times_due(tracker, state, interval_us=10_000):
    """How often in 0.8 s it is time for an object that was not seen well all the while, by what for."""
    config = TrackerConfig(relocalization=RelocalizationConfig(interval_us=interval_us))
    each = []
    for end_us in range(0, 800_000, 5000):
        before = changed(state, t_us=state.t_us * 0 + end_us)
        due = schedule(before, tracker.objects, before.t_us + 5000, config)
        each.append(torch.cat([due.is_due, due.is_drift_due, due.is_near_due]))
    return torch.stack(each).sum(0).tolist()


@pytest.mark.parametrize(
    ("unseen_s", "expected"), [(0.0, [80, 16, 160]), (0.09, [80, 16, 160]), (0.11, [40, 16, 40]), (0.5, [10, 10, 10]), (9.0, [5, 5, 5])]
)
def test_what_was_not_seen_well_for_twice_as_long_is_looked_for_half_as_often(unseen_s, expected):
    tracker, state, *_ = started()
    assert times_due(tracker, unseen(state, unseen_s)) == expected


def test_what_is_to_be_looked_for_in_every_window_is_however_long_it_is_lost():
    tracker, state, *_ = started()
    assert times_due(tracker, unseen(state, 9.0), interval_us=0) == [160, 16, 160]


def is_lost(tracker, state, config=CONFIG):
    return has(schedule(state, tracker.objects, state.t_us, config).triggers, Trigger.LOST).tolist() == [True]


def is_looked_for(trigger, tracker, state, t_us, config=CONFIG):
    return has(schedule(state, tracker.objects, t_us, config).triggers, trigger).tolist() == [True]


def test_an_object_is_lost_once_nothing_is_known_of_it_and_it_was_not_seen_for_long():
    tracker, state, *_ = started()
    gone = unseen(state, covariance=uncertain(state))
    assert is_lost(tracker, gone)
    assert not is_lost(tracker, unseen(gone, 0.05))
    assert not is_lost(tracker, unseen(state))
    assert not is_lost(tracker, changed(gone, mean_score=torch.zeros(1)))
    assert not is_lost(tracker, gone, TrackerConfig(disabled=frozenset({Component.AROUND_LAST_SEEN})))
    # Without searches nothing would find it there.
    assert not is_lost(tracker, gone, TrackerConfig(relocalization=RelocalizationConfig(hypotheses=0)))


@pytest.mark.parametrize(("metres", "off"), [(0.0, False), (0.05, False), (0.3, True), (-0.2, True)])
def test_an_object_is_off_in_depth_far_behind_or_before_where_it_was_seen_well(metres, off):
    tracker, state, *_ = started()
    away, due = unseen(state, T_cam_obj=moved_away(tracker, state, metres)), state.t_us + 1_000_000
    assert is_looked_for(Trigger.DEPTH_CHANGED, tracker, away, due) == off
    assert not is_looked_for(Trigger.DEPTH_CHANGED, tracker, away, state.t_us)
    assert not is_looked_for(Trigger.DEPTH_CHANGED, tracker, unseen(away, 0.05), due)
    # What is lost is expected there as it is.
    assert not is_looked_for(Trigger.DEPTH_CHANGED, tracker, changed(away, covariance=uncertain(away)), due)


@pytest.mark.parametrize(("score", "is_below"), [(0.6, True), (0.7, False)])
def test_an_object_that_explains_much_less_than_when_it_was_seen_well_is_looked_for_there(score, is_below):
    tracker, state, *_ = started()
    low = unseen(state, score=torch.full((1,), score), reference_explained_ratio=torch.full((1,), 0.9))
    due = state.t_us + 1_000_000
    assert is_looked_for(Trigger.FAR_BELOW_REFERENCE, tracker, low, due) == is_below
    assert not is_looked_for(Trigger.FAR_BELOW_REFERENCE, tracker, low, state.t_us)
    assert not is_looked_for(Trigger.FAR_BELOW_REFERENCE, tracker, unseen(low, 0.05), due)
    assert not is_looked_for(Trigger.FAR_BELOW_REFERENCE, tracker, changed(low, covariance=uncertain(low)), due)
    for never in ({"relocalization": {"not_validated_below": 0}}, {"disabled": ["around_last_seen"]}, {"relocalization": {"hypotheses": 0}}):
        assert not is_looked_for(Trigger.FAR_BELOW_REFERENCE, tracker, low, due, TrackerConfig.model_validate(never))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"confirmations": 9.0}, False),
        ({"confirmations": 9.0, "drift_s": 0.051}, True),
        ({"confirmations": 9.0, "time_since_validated_s": 0.051}, True),
        ({"confirmations": 0.0}, True),
    ],
)
def test_what_drifts_or_waits_to_be_confirmed_may_be_looked_for_far_away_once_in_a_while(changes, expected):
    tracker, state, *_ = started()
    state = changed(state, **{name: torch.full_like(state.health.score, value) for name, value in changes.items()})
    for end_us, is_due in ((100_000, True), (105_000, False)):
        before = changed(state, t_us=state.t_us * 0 + end_us - 5000)
        scheduled = schedule(before, tracker.objects, before.t_us + 5000, CONFIG)
        assert bool(may_look_far(before, scheduled, CONFIG)) == (expected and is_due)
