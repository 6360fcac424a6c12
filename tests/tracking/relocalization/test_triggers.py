"""When other poses are tried, how far away they may be, and that poses which slipped unnoticed are found again."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from tracked_boxes import assert_same, follow, in_motion, moving_box, poses_of, windows

from torchtrack import Tracker
from torchtrack.config.search import SearchConfig
from torchtrack.config.tracker import CornerConfig, MatchingConfig, MotionConfig, TrackerConfig
from torchtrack.core.events import concatenate
from torchtrack.core.lie import retract_about
from torchtrack.tracking.relocalization.last_seen import drifted, less_certain
from torchtrack.tracking.relocalization.triggers import Doubt, gathered_when_known, has_strayed, in_doubt, is_adrift, is_due, is_wanted
from torchtrack.tracking.validation.status import Status

# The box fires few events: with corners beside them, enough is observed of one that slipped to say more than that it is too little.
# Polarities of these events are drawn by lot: there is nothing to remember of them.
# Were close edges taken for each other, it would come back by itself.
FORGETFUL = MatchingConfig(polarity_memory_s=0.0, close_edges_px=0.0)
# What slips turns on: with turns that die away it would be drawn back.
TURNING = MotionConfig(turn_s=0)
SEARCHED = TrackerConfig(
    corners=CornerConfig(max_corners=32), matching=FORGETFUL, motion=TURNING, search=SearchConfig(doubt_us=10_000, drift_diameters_s=4)
)
NEVER_ADRIFT = TrackerConfig(corners=CornerConfig(max_corners=32), matching=FORGETFUL, motion=TURNING, search=SearchConfig(doubt_us=0, slipped_to=0))
# Nothing is ever in doubt, and looks farther away are for what was not seen well for long, or for nothing.
UNDOUBTED = {"doubt_us": 10_000, "drift_diameters_s": 4, "doubted_below": 0, "slipped_to": 0, "anew_below": 0}
STRAYING, NEVER_STRAYED = (SEARCHED.model_copy(update={"search": SearchConfig(strayed_to=share, **UNDOUBTED)}) for share in (0.85, 0.0))
# Twenty degrees, onto other edges: farther than a pose that is sure of itself is looked for.
SLIPPED = torch.tensor([[0.35, 0.0, 0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)


def doubt(
    sigma_px,
    score=0.9,
    usual=0.9,
    starting=False,
    due=True,
    adrift=False,
    doubted_s=0.0,
    full=0.9,
    far_due=False,
    symmetric=False,
    unseen_s=1.0,
    strayed=False,
    may_have_turned=False,
    off_in_depth=False,
    little=False,
):
    sigma_px = torch.as_tensor(sigma_px)
    values = score, usual, starting, due, adrift, doubted_s, full, far_due, symmetric, unseen_s, strayed, may_have_turned, off_in_depth, little
    return Doubt(sigma_px, *(torch.as_tensor(value).expand_as(sigma_px) for value in values))


# ---- when


def test_uncertain_objects_and_those_explained_worse_than_usual_are_searched_for():
    config = SearchConfig(from_sigma_px=4.0, dropped_to=0.8)
    score, usual = torch.tensor([0.9, 0.71, 0.73, 0.9, 0.0]), torch.tensor([0.9, 0.9, 0.9, 0.9, 0.0])
    asked = doubt([1.0, 1.0, 1.0, 4.1, 1.0], score, usual).asks(score, config)
    assert asked.tolist() == [False, True, False, True, False]
    # One window that is a little worse is no reason.
    assert not doubt([1.0], 0.9, 0.9).asks(torch.tensor([0.65]), config).any()


def test_what_is_sure_of_its_place_and_explains_far_less_may_have_slipped_at_once():
    settings, score = SearchConfig(slipped_to=0.7, slip_sigma_px=6.0), torch.tensor([0.62, 0.64, 0.62, 0.62, 0.62])
    elsewhere = {"starting": torch.tensor([False] * 3 + [True, False]), "adrift": torch.tensor([False] * 4 + [True])}
    state = doubt([1.0, 1.0, 6.1, 1.0, 1.0], 0.9, 0.9, **elsewhere)
    assert state.slips(score, settings).tolist() == [True, False, False, False, False]
    assert bool(is_wanted(state, score, TrackerConfig(search=settings))[0])
    assert not state.slips(score, SearchConfig(slipped_to=0)).any()
    assert not is_wanted(state, score, TrackerConfig(search=SearchConfig(hypotheses=0))).any()


@pytest.mark.parametrize("at_start", [True, False])
def test_objects_whose_motion_is_not_known_are_searched_for(at_start):
    start = doubt([1.0, 1.0], starting=torch.tensor([True, False]), due=False)
    config = TrackerConfig(search=SearchConfig(at_start=at_start))
    assert start.asks(start.last_score, config.search).tolist() == is_wanted(start, start.last_score, config).tolist() == [at_start, False]


def test_very_uncertain_objects_wait_until_it_is_time_and_others_do_not():
    config, nothing = SearchConfig(from_sigma_px=4.0, wide_sigma_px=10.0), torch.zeros(3)
    sigma_px, due = [11.0, 11.0, 9.0], torch.tensor([False, True, False])
    assert doubt(sigma_px, due=due).asks(nothing, config).tolist() == [False, True, True]
    assert doubt(sigma_px, starting=True, due=~due).asks(nothing, config).all()


def test_objects_adrift_are_searched_for_however_certain_they_are():
    adrift = doubt([0.5, 0.5], adrift=torch.tensor([True, False]))
    assert adrift.asks(torch.ones(2), SearchConfig()).tolist() == is_wanted(adrift, torch.ones(2), TrackerConfig()).tolist() == [True, False]
    assert not is_wanted(adrift, torch.ones(2), TrackerConfig(search=SearchConfig(hypotheses=0))).any()


def test_new_objects_that_leave_much_unexplained_are_searched_for_when_it_is_time():
    settings, score = SearchConfig(new_share=0.9), torch.tensor([0.8, 0.95, 0.8])
    state = replace(doubt([1.0] * 3, due=torch.tensor([True, True, False])), last_score=score, full_share=torch.full((3,), 0.5))
    assert state.is_new(score, settings).tolist() == state.asks(score, settings).tolist() == [True, False, False]
    # Of one that explained about as much when it was seen well, nothing is new.
    assert not replace(state, full_share=torch.full((3,), 0.75)).is_new(score, settings).any()
    # One window that is a little worse is no reason.
    assert not replace(state, last_score=torch.full((3,), 0.95)).is_new(score, settings).any()
    assert not state.is_new(score, SearchConfig(new_share=0)).any()


def test_what_has_a_plane_of_symmetry_and_does_not_explain_all_may_be_mirrored_when_it_is_time():
    settings, score = SearchConfig(mirrored_to=0.8, slip_sigma_px=6.0), torch.tensor([0.7, 0.73, 0.7, 0.7, 0.7, 0.7])
    flags = {name: torch.tensor([at != number for at in range(6)]) for name, number in (("far_due", 2), ("symmetric", 3))}
    state = doubt([1.0] * 4 + [6.1, 1.0], 0.7, starting=torch.tensor([False] * 5 + [True]), **flags)
    assert state.is_mirrored(score, settings).tolist() == [True] + [False] * 5
    # One window that is a little worse is no reason.
    assert not replace(state, last_score=torch.full((6,), 0.73)).is_mirrored(score, settings).any()
    only_mirrors = {"slipped_to": 0, "dropped_to": 0, "from_sigma_px": 9.0, "at_start": False}
    assert is_wanted(state, score, TrackerConfig(search=SearchConfig(**only_mirrors))).tolist() == [True] + [False] * 5
    for never in ({"mirrored_to": 0}, {"doubt_us": 0}):
        assert not state.is_mirrored(score, SearchConfig(**never)).any()


def test_what_may_have_turned_is_looked_at_once_it_is_seen_well_again_and_sure_of_its_place():
    settings, score = SearchConfig(slip_share=0.9, slip_sigma_px=6.0), torch.tensor([0.82, 0.8, 0.82, 0.82, 0.82])
    turned, starting, due = (torch.tensor([number != wrong for number in range(5)]) for wrong in (2, 3, 4))
    state = doubt([1.0] * 5, full=0.9, may_have_turned=turned, starting=~starting, far_due=due)
    assert state.is_turned(score, settings).tolist() == [True, False, False, False, False]
    assert is_wanted(state, score, TrackerConfig(search=settings)).tolist()[0]
    assert not doubt([6.1], full=0.9, may_have_turned=True, far_due=True).is_turned(score[:1], settings).any()


def test_what_is_adrift_or_very_uncertain_is_looked_for_as_it_was_last_seen_when_it_is_time():
    config = SearchConfig(wide_sigma_px=10.0)
    state = doubt([1.0, 1.0, 11.0, 11.0], adrift=torch.tensor([True, False, False, False]), far_due=torch.tensor([True, True, True, False]))
    assert state.has_run_off(config).tolist() == [True, False, True, False]
    assert replace(state, unseen_s=torch.tensor([0.21, 0.21, 0.19, 0.21])).has_run_off(config).tolist() == [True, False, False, False]
    for never in ({"unseen_us": 0}, {"doubt_us": 0}):
        assert not state.has_run_off(config.model_copy(update=never)).any()


def test_it_is_time_once_in_every_interval_whatever_the_windows():
    ends_us = torch.arange(0, 100_001, 5000)
    due = is_due(ends_us[:-1], ends_us[1:], 20_000)[0]
    assert due.nonzero().flatten().tolist() == [3, 7, 11, 15, 19]
    assert is_due(ends_us[:-1], ends_us[1:], 0).all()
    assert is_due(torch.tensor([1000]), torch.tensor([61_000]), 20_000).all()
    of_each = is_due(ends_us[:-1], ends_us[1:], 20_000, 0)
    assert torch.equal(of_each[0], due) and of_each[1].all()


@pytest.mark.parametrize(("doubt_us", "expected"), [(50_000, [False, True, False]), (20_000, [True, True, False]), (0, [False] * 3)])
def test_an_object_is_adrift_once_it_was_in_doubt_for_long_and_it_is_time(doubt_us, expected):
    doubted_s, due = torch.tensor([0.045, 0.051, 0.051]), torch.tensor([True, True, False])
    assert is_adrift(doubted_s, due, SearchConfig(doubt_us=doubt_us)).tolist() == expected


def test_what_is_sure_of_its_place_and_was_not_seen_well_for_long_may_have_strayed_when_it_is_time():
    score, full = torch.tensor([0.7, 0.8, 0.7, 0.7, 0.7, 0.3]), torch.tensor([0.9] * 5 + [0.3])
    unseen_s, sigma_px = torch.tensor([0.051, 0.051, 0.049, 0.051, 0.051, 0.051]), torch.tensor([1.0, 1.0, 1.0, 6.1, 1.0, 1.0])
    due = torch.tensor([True] * 4 + [False, True])
    settings = {"strayed_to": 0.85, "doubt_us": 50_000, "slip_sigma_px": 6.0}
    assert has_strayed(score, full, unseen_s, sigma_px, due, SearchConfig(**settings)).tolist() == [True] + [False] * 5
    for never in ({"strayed_to": 0}, {"doubt_us": 0}):
        assert not has_strayed(score, full, unseen_s, sigma_px, due, SearchConfig(**{**settings, **never})).any()


def test_what_explains_much_less_than_when_seen_well_by_smeared_events_is_in_doubt():
    score, full = torch.tensor([0.5, 0.2, 0.0, 0.2, 0.5]), torch.tensor([0.9, 0.3, 0.0, 0.9, 0.9])
    smeared = in_doubt(score, full, torch.full((5,), 0.6), torch.full((5,), 0.8), SearchConfig(doubted_below=0.6))
    assert smeared.tolist() == [True, False, False, True, True]


def test_what_is_partly_hidden_is_not_in_doubt():
    """Less is explained, but what is seen gathers as ever; nor does it tell anything where too few events are seen."""
    gathered = torch.tensor([0.7, 0.9, torch.nan])
    assert not in_doubt(torch.full((3,), 0.3), torch.full((3,), 0.9), gathered, torch.full((3,), 0.8), SearchConfig()).any()


def test_of_those_whose_place_is_not_known_events_need_not_gather():
    full = gathered_when_known(doubt([1.0, 3.9, 4.1]), torch.tensor([0.9, 0.8, 0.7]), SearchConfig(from_sigma_px=4.0))
    torch.testing.assert_close(full, torch.tensor([0.9, 0.8, 0.0]))


# ---- how far


def test_who_drifts_off_is_the_less_certain_the_longer_it_lasts():
    _, prediction, _, found, _ = in_motion()
    contours, config = found.fit.contours, SearchConfig(drift_px_s=200, drift_diameters_s=100)
    grown = [drifted(prediction, doubt([1.0], adrift=True, doubted_s=t), config) for t in (0.05, 0.1, 0.4, 1.0, 5.0)]
    sigma_px = [float(of_doubt.sigma_px(contours)) for of_doubt in grown]
    # Turning and moving together carry contours farther than either.
    assert all(20 * n < px < 40 * n for px, n in zip(sigma_px[:3], (0.5, 1, 4), strict=True))
    # In the end it may be turned anyhow, but it is not looked for in another place.
    turned_rad, moved_m = (torch.stack([of_doubt.covariance[0, k, k].sqrt() for of_doubt in grown[2:]]) for k in (0, 3))
    torch.testing.assert_close(turned_rad[1:] / turned_rad[0], torch.full((2,), 2.5, dtype=torch.float64), atol=0.01, rtol=0)
    torch.testing.assert_close(moved_m, moved_m[:1].expand(3))


def test_what_is_small_in_the_image_drifts_no_faster_for_its_size():
    _, prediction, _, found, _ = in_motion()
    sigma_px = [
        float(drifted(prediction, doubt([1.0], adrift=True, doubted_s=0.2), config).sigma_px(found.fit.contours))
        for config in (SearchConfig(drift_px_s=1e6, drift_diameters_s=1.0), SearchConfig(drift_px_s=1e6, drift_diameters_s=2.0))
    ]
    size_px = float(prediction.objects.size_px(prediction.T_cam_obj))
    assert 0.2 * size_px < sigma_px[0] < 0.4 * size_px
    assert sigma_px[1] == pytest.approx(2 * sigma_px[0], rel=0.1)


def test_a_drift_is_one_velocity_that_explains_where_the_pose_is():
    _, prediction, _, _, _ = in_motion()
    lasted_s = 0.25
    added = drifted(prediction, doubt([1.0], adrift=True, doubted_s=lasted_s), SearchConfig()).covariance - prediction.covariance
    pose_part, both, rate = added[0, :6, :6], added[0, :6, 6:], added[0, 6:, 6:]
    torch.testing.assert_close(pose_part, lasted_s**2 * rate)
    torch.testing.assert_close(both, lasted_s * rate)


def test_others_are_as_certain_as_before():
    _, prediction, _, _, _ = in_motion()
    assert torch.equal(drifted(prediction, doubt([1.0], doubted_s=0.2), SearchConfig()).covariance, prediction.covariance)


# ---- what comes of it


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
    known = torch.full_like(state.full_share, 0.95)
    state = replace(state, T_cam_obj=T_cam_obj, full_share=known, full_gathered=known)
    after, results = follow(tracker, state, batches[10:])
    return after, results, tracks[0][0].at(results[-1].t_us)


def test_of_what_slipped_one_is_less_certain_in_all_ways_and_of_others_as_before():
    _, prediction, *_ = in_motion()
    two = prediction.copies(0, 2)
    covariance = less_certain(two, 1, 0.5, 2.5).covariance
    torch.testing.assert_close(covariance[1], 25 * two.covariance[1])
    assert torch.equal(covariance[0], two.covariance[0])
    torch.testing.assert_close(two.covariance[1], prediction.covariance[0])


def test_a_pose_that_slipped_is_in_doubt_and_found_again():
    after, results, T_true = slipped(SEARCHED, count=20)
    doubted, without, _ = slipped(NEVER_ADRIFT, count=20)
    statuses = [int(result.status) for result in results]
    assert statuses[:3] == [Status.UNCERTAIN] * 3 and statuses[5:] == [Status.TRACKING] * 15
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, T_true)
    assert float(degrees) < 0.5
    assert float(millimetres) < 1.0
    assert float(after.doubted_s) == 0
    assert float(pose_errors(without[-1].T_cam_obj, T_true)[0]) > 5
    assert float(doubted.doubted_s) > 0.05


def test_a_pose_that_strayed_is_found_again_though_it_was_never_in_doubt():
    after, results, T_true = slipped(STRAYING, count=30)
    lost, without, _ = slipped(NEVER_STRAYED, count=30)
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, T_true)
    assert float(degrees) < 0.5
    assert float(millimetres) < 1.0
    assert float(after.unseen_s) == 0
    assert float(pose_errors(without[-1].T_cam_obj, T_true)[0]) > 5
    assert float(lost.unseen_s) > 0.1
    assert float(after.doubted_s) == float(lost.doubted_s) == 0


@pytest.mark.parametrize(("config", "count"), [(SEARCHED, 10), (STRAYING, 20)])
def test_finding_one_that_slipped_changes_nothing_for_its_neighbour(config, count):
    _, alone, _ = slipped(config, count, streams=2, displaced=-1)
    _, beside, _ = slipped(config, count, streams=2, displaced=0)
    # Sums over as many columns as the fullest of the two has are rounded otherwise.
    torch.testing.assert_close(poses_of(alone, 1), poses_of(beside, 1), rtol=0, atol=1e-7)
    assert float((poses_of(alone) - poses_of(beside)).abs().max()) > 1e-3


def test_what_is_tracked_well_is_never_in_doubt():
    state, results, _ = slipped(SEARCHED, displaced=-1)
    assert [int(result.status) for result in results] == [Status.TRACKING] * len(results)
    assert float(state.doubted_s) == 0
    assert 0.5 < float(state.full_gathered) <= 1


def test_how_far_events_gather_can_be_left_out():
    """Then poses are compared by what they explain alone."""
    config = TrackerConfig(search=SearchConfig(by_gathering=False))
    state, results, _ = slipped(config, displaced=-1)
    assert_same(state.score, results[-1].quality)
    assert float(slipped(config)[0].doubted_s) == 0


def test_a_score_is_less_where_events_are_smeared():
    *_, found, _ = in_motion()
    for times, expected in ((2 / 0.9, 0.5), (1 / 0.9, 1.0), (0.5, 1.0), (0.0, 1.0)):
        score = replace(found, full_gathered=times * found.gathered).score
        assert float(score) == pytest.approx(expected * float(found.share), rel=1e-6)
