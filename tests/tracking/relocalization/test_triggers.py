"""When other poses are tried, how far away they may be, and that poses which slipped unnoticed are relocalized."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from lost_objects import SEEN_WELL, drifting_soon, evidence
from states import changed
from tracked_boxes import assert_same, follow, in_motion, moving_box, poses_of, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import CornerConfig, TrackerConfig
from torchtrack.core.events import concatenate
from torchtrack.core.lie import retract_about
from torchtrack.tracking.relocalization.triggers import AROUND_PREDICTION, SEARCHED, Trigger, next_kind, triggered
from torchtrack.tracking.validation import verdict
from torchtrack.tracking.validation.scored_fit import reference_where_known
from torchtrack.tracking.validation.status import Status

# The box fires few events: with corners beside them, enough is observed of one that slipped to say more than that it is too little.
# Polarities of these events are drawn by lot: there is nothing to remember of them.
# What slips turns on: with turns that die away it would be drawn back.
UNREMEMBERED = frozenset({Component.POLARITY_PRIOR, Component.TURNS_FADE})
SEARCHING = TrackerConfig(corners=CornerConfig(max_corners=32), disabled=UNREMEMBERED)
NEVER_DRIFTING = SEARCHING.model_copy(update={"disabled": UNREMEMBERED | {Component.DRIFT, Component.UNCONFIRMED}})
# Looks farther away are for what was not seen well for long, or for nothing.
SLOWLY, NEVER_SLOWLY = (
    SEARCHING.model_copy(
        update={
            "relocalization": RelocalizationConfig(slow_drift_below=share, not_validated_below=0),
            "disabled": UNREMEMBERED | {Component.UNCONFIRMED},
        }
    )
    for share in (0.85, 0.0)
)
# Twenty degrees, onto other edges: farther than a pose that is sure of itself is looked for.
SLIPPED = torch.tensor([[0.35, 0.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)


def flags_of(given, *disabled, **settings):
    """The triggers of each object."""
    config = TrackerConfig(relocalization=RelocalizationConfig(**settings), disabled=disabled)
    return [Trigger(number) for number in triggered(given, config).triggers.tolist()]


def having(trigger, given, *disabled, **settings):
    """Which objects have a trigger."""
    return [bool(flags & trigger) for flags in flags_of(given, *disabled, **settings)]


# ---- each alone


ALONE = {
    Trigger.UNCERTAIN: {"sigma_px": 4.1},
    Trigger.NEW: {"is_due": True, "reference_explained_ratio": 0.5, "score": 0.8, "last_score": 0.8, "mean_score": 0.8},
    Trigger.LOW_SCORE: {"score": 0.71, "last_score": 0.71},
    Trigger.DRIFT: {"is_drift_due": True, "drift_s": 0.051},
    Trigger.SLOW_DRIFT: {"is_drift_due": True, "time_since_validated_s": 0.051, "last_score": 0.7},
    Trigger.LOST: {"triggers": int(Trigger.LOST)},
    Trigger.DEPTH_CHANGED: {"triggers": int(Trigger.DEPTH_CHANGED)},
    Trigger.FAR_BELOW_REFERENCE: {"triggers": int(Trigger.FAR_BELOW_REFERENCE)},
    Trigger.UNCONFIRMED: {"confirmations": 2.0},
}


@pytest.mark.parametrize("trigger", ALONE, ids=lambda trigger: trigger.name)
def test_each_condition_alone_sets_its_bit_and_its_neighbour_has_none(trigger):
    changes = {name: [value, SEEN_WELL[name]] for name, value in ALONE[trigger].items()}
    assert flags_of(evidence(2, **changes)) == [trigger, Trigger(0)]


def test_every_trigger_is_set_alone_here():
    assert set(Trigger) == set(ALONE)


def test_what_is_seen_well_has_no_trigger_whatever_it_is_time_for():
    assert flags_of(evidence(is_due=True, is_drift_due=True)) == [Trigger(0)]


@pytest.mark.parametrize("trigger", ALONE, ids=lambda trigger: trigger.name)
def test_without_searches_there_are_no_triggers(trigger):
    assert flags_of(evidence(**ALONE[trigger]), hypotheses=0) == [Trigger(0)]


# ---- when


def test_uncertain_objects_and_those_explained_worse_than_usual_are_searched_for():
    changes = {"last_score": [0.9, 0.71, 0.73, 0.9, 0.0], "mean_score": [0.9, 0.9, 0.9, 0.9, 0.0]}
    given = evidence(5, sigma_px=[1.0, 1.0, 1.0, 4.1, 1.0], score=changes["last_score"], **changes)
    assert having(Trigger.UNCERTAIN, given, trigger_sigma_px=4.0) == [False, False, False, True, False]
    assert having(Trigger.LOW_SCORE, given) == [False, True, False, False, False]
    assert not any(having(Trigger.LOW_SCORE, given, Component.LOW_SCORE))
    # One window that is a little worse is no reason.
    assert not any(having(Trigger.LOW_SCORE, evidence(score=0.65)))


def test_where_looking_has_not_helped_for_long_it_waits_too_of_objects_whose_place_is_known():
    near = {"is_near_due": [True, False]}
    low = evidence(2, score=0.5, last_score=0.5, **near)
    assert having(Trigger.LOW_SCORE, low) == [True, False]
    assert having(Trigger.UNCERTAIN, evidence(2, sigma_px=4.1, **near), trigger_sigma_px=4.0) == [True, False]


def test_a_pose_is_compared_with_others_in_the_window_that_would_confirm_it_and_once_in_a_while_before():
    given = evidence(
        6,
        confirmations=[1.0, 2.0, 3.0, 4.0, 3.0, 3.0],
        measured_ratio=[0.9, 0.9, 0.6, 0.9, 0.59, torch.nan],
    )
    assert having(Trigger.UNCONFIRMED, given) == [False, True, True, False, False, False]
    assert not any(having(Trigger.UNCONFIRMED, given, Component.UNCONFIRMED))
    waits_long = evidence(4, confirmations=[0.0, 0.0, 4.0, 0.0], measured_ratio=[0.9, 0.9, 0.9, 0.59], is_drift_due=[True, False, True, True])
    assert having(Trigger.UNCONFIRMED, waits_long) == [True, False, False, False]
    # Not in a part of a window, of which the motion is not known yet.
    assert not any(having(Trigger.UNCONFIRMED, evidence(confirmations=3.0, is_starting=True)))


def test_very_uncertain_objects_wait_until_it_is_time_and_others_do_not():
    settings = {"trigger_sigma_px": 4.0, "wide_sigma_px": 10.0}
    given = evidence(3, sigma_px=[11.0, 11.0, 9.0], is_due=[False, True, False], score=0.0, last_score=0.0)
    assert having(Trigger.UNCERTAIN, given, **settings) == having(Trigger.LOW_SCORE, given, **settings) == [False, True, True]


def test_objects_that_drift_are_searched_for_however_certain_they_are():
    assert having(SEARCHED, evidence(2, sigma_px=0.5, drift_s=[0.1, 0.0], is_drift_due=True)) == [True, False]


def test_new_objects_that_leave_much_unexplained_are_searched_for_when_it_is_time():
    score = torch.tensor([0.8, 0.95, 0.8])
    given = evidence(3, is_due=[True, True, False], score=score, last_score=score, mean_score=score, reference_explained_ratio=0.5)
    assert having(Trigger.NEW, given, new_below=0.9) == having(SEARCHED, given, new_below=0.9) == [True, False, False]
    # Of one that explained about as much when it was seen well, nothing is new.
    assert not any(having(Trigger.NEW, replace(given, reference_explained_ratio=torch.full((3,), 0.75))))
    # One window that is a little worse is no reason.
    assert not any(having(Trigger.NEW, replace(given, last_score=torch.full((3,), 0.95))))
    assert not any(having(Trigger.NEW, given, new_below=0))


def test_an_object_drifts_once_it_explained_too_little_for_long_and_it_is_time():
    given = evidence(3, drift_s=[0.045, 0.051, 0.051], is_drift_due=[True, True, False])
    assert having(Trigger.DRIFT, given) == [False, True, False]
    assert not any(having(Trigger.DRIFT, given, Component.DRIFT))


def test_what_is_sure_of_its_place_and_was_not_seen_well_for_long_may_drift_slowly_when_it_is_time():
    given = evidence(
        6,
        last_score=[0.7, 0.8, 0.7, 0.7, 0.7, 0.3],
        reference_explained_ratio=[0.9] * 5 + [0.3],
        time_since_validated_s=[0.051, 0.051, 0.049, 0.051, 0.051, 0.051],
        sigma_px=[1.0, 1.0, 1.0, 6.1, 1.0, 1.0],
        is_drift_due=[True] * 4 + [False, True],
    )
    settings = {"slow_drift_below": 0.85}
    assert having(Trigger.SLOW_DRIFT, given, **settings) == [True] + [False] * 5
    assert not any(having(Trigger.SLOW_DRIFT, given, slow_drift_below=0))
    assert not any(having(Trigger.SLOW_DRIFT, given, Component.DRIFT))
    # What drifts at once does not drift slowly, nor does what only starts.
    for other in ({"drift_s": torch.full((6,), 0.1)}, {"is_starting": torch.ones(6, dtype=torch.bool)}):
        assert not any(having(Trigger.SLOW_DRIFT, replace(given, **other), **settings))


def test_of_those_whose_place_is_not_known_events_need_not_gather():
    full = reference_where_known(torch.tensor([1.0, 3.9, 4.1]), torch.tensor([0.9, 0.8, 0.7]), RelocalizationConfig(trigger_sigma_px=4.0))
    torch.testing.assert_close(full, torch.tensor([0.9, 0.8, 0.0]))


# ---- what comes of it


@torch.no_grad()
def slipped(config, count=10, streams=1, displaced=0):
    """Runs on from full motion with the pose of one object off, though all is sure of itself; the states before and after, and results."""
    tracks = [moving_box(pose(), count + 10, seed=stream, stream=stream) for stream in range(streams)]
    tracker = Tracker([box_model()] * streams, [SMALL_CAMERA] * streams, config, stream_index=range(streams))
    cut = [windows(events, count + 10) for _, events in tracks]
    batches = [(concatenate([events for events, _ in row]), row[0][1]) for row in zip(*cut, strict=True)]
    state, _ = follow(tracker, tracker.init(pose().expand(streams, 4, 4), 0), batches[:10])
    moved = retract_about(state.T_cam_obj, SLIPPED.expand(streams, 6), tracker.centre_obj.double())
    T_cam_obj = torch.where(torch.arange(streams)[:, None, None] == displaced, moved, state.T_cam_obj)
    # As after a while of being seen well.
    known = torch.full_like(state.health.reference_explained_ratio, 0.95)
    state = changed(state, T_cam_obj=T_cam_obj, reference_explained_ratio=known, reference_inlier_ratio=known)
    after, results = follow(tracker, state, batches[10:])
    return after, results, tracks[0][0].at(results[-1].t_us)


def test_a_pose_that_slipped_drifts_and_is_relocalized(monkeypatch):
    drifting_soon(monkeypatch, diameters_s=4)
    after, results, T_true = slipped(SEARCHING, count=20)
    still_off, without, _ = slipped(NEVER_DRIFTING, count=20)
    statuses = [int(result.status) for result in results]
    assert statuses[:2] == [Status.UNCERTAIN] * 2 and statuses[10:] == [Status.TRACKING] * 10
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, T_true)
    assert float(degrees) < 0.5
    assert float(millimetres) < 1.0
    assert float(after.health.drift_s) == 0
    assert float(pose_errors(without[-1].T_cam_obj, T_true)[0]) > 5
    assert float(still_off.health.drift_s) > 0.05


def test_a_pose_that_drifts_slowly_is_relocalized_though_its_events_were_never_smeared(monkeypatch):
    drifting_soon(monkeypatch, diameters_s=4)
    monkeypatch.setattr(verdict, "DRIFT_BELOW", 0)
    # From nearer it comes back by itself.
    monkeypatch.setitem(globals(), "SLIPPED", torch.tensor([[0.6, 0.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64))
    after, results, T_true = slipped(SLOWLY, count=30)
    _, without, _ = slipped(NEVER_SLOWLY, count=30)
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, T_true)
    assert float(degrees) < 0.5
    assert float(millimetres) < 1.0
    assert float(pose_errors(without[-1].T_cam_obj, T_true)[0]) > 2
    assert float(after.health.time_since_validated_s) == 0
    assert float(after.health.drift_s) == 0


@pytest.mark.parametrize(("config", "count", "drift_below"), [(SEARCHING, 10, 0.6), (SLOWLY, 20, 0)])
def test_relocalizing_what_slipped_changes_nothing_for_its_neighbour(monkeypatch, config, count, drift_below):
    drifting_soon(monkeypatch, diameters_s=4)
    monkeypatch.setattr(verdict, "DRIFT_BELOW", drift_below)
    _, alone, _ = slipped(config, count, streams=2, displaced=-1)
    _, neighbours, _ = slipped(config, count, streams=2, displaced=0)
    # Sums over as many columns as the fullest of the two has are rounded otherwise.
    torch.testing.assert_close(poses_of(alone, 1), poses_of(neighbours, 1), rtol=0, atol=1e-7)
    assert float((poses_of(alone) - poses_of(neighbours)).abs().max()) > 1e-3


def test_what_is_tracked_well_never_drifts(monkeypatch):
    drifting_soon(monkeypatch, diameters_s=4)
    state, results, _ = slipped(SEARCHING, displaced=-1)
    assert [int(result.status) for result in results] == [Status.TRACKING] * len(results)
    assert float(state.health.drift_s) == 0
    assert 0.5 < float(state.health.reference_inlier_ratio) <= 1


def test_how_far_events_gather_can_be_left_out():
    """Then poses are compared by what they explain alone."""
    config = TrackerConfig(disabled={Component.INLIER_RATIO})
    state, results, _ = slipped(config, displaced=-1)
    assert_same(state.health.score, results[-1].quality)
    assert float(slipped(config)[0].health.drift_s) == 0


def test_a_score_is_less_where_events_are_smeared():
    *_, actual, _ = in_motion()
    for times, expected in ((2 / 0.9, 0.5), (1 / 0.9, 1.0), (0.5, 1.0), (0.0, 1.0)):
        score = replace(actual, reference_inlier_ratio=times * actual.inlier_ratio).score
        assert float(score) == pytest.approx(expected * float(actual.explained_ratio), rel=1e-6)


@pytest.mark.parametrize(
    ("triggers", "last", "expected"),
    [
        ([0, int(Trigger.LOST)], 0, 0),
        ([0, int(Trigger.UNCERTAIN)], 0, int(AROUND_PREDICTION)),
        ([int(Trigger.UNCERTAIN), int(Trigger.UNCONFIRMED)], int(AROUND_PREDICTION), int(Trigger.UNCONFIRMED)),
        ([int(Trigger.UNCERTAIN)], int(AROUND_PREDICTION), int(AROUND_PREDICTION)),
        ([int(Trigger.UNCERTAIN | Trigger.DEPTH_CHANGED)], int(Trigger.UNCONFIRMED), int(AROUND_PREDICTION)),
    ],
)
def test_the_next_kind_of_search_is_the_next_that_is_asked_for(triggers, last, expected):
    assert next_kind(torch.tensor(triggers), last) == expected
