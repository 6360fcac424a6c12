"""The search over many poses: what is drawn, how it is marked, that lost objects are found again and others left alone."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors, random_events
from tracked_boxes import WINDOW_US, follow, in_motion, moving_box, poses_of, started, tensors_of, windows

from torchtrack import Tracker
from torchtrack.config.search import SearchConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import backend_is_installed
from torchtrack.core.events import concatenate
from torchtrack.core.lie import retract_about
from torchtrack.tracking.relocalization.acceptance import is_likely, likeliest
from torchtrack.tracking.relocalization.last_seen import LastSeen
from torchtrack.tracking.relocalization.refine import align_all, rehearse, search
from torchtrack.tracking.relocalization.relocalize import _least, _search_slipped, _stands, search_wanted
from torchtrack.tracking.validation.scored_fit import explained_at_rest
from torchtrack.tracking.validation.status import Status

SEARCHED = TrackerConfig()
UNSEARCHED = TrackerConfig(search=SearchConfig(hypotheses=0))
IMAGE_SIZE = (SMALL_CAMERA.height, SMALL_CAMERA.width)
# Ten degrees and some millimetres: edges are several pixels off, farther than the tight gate reaches.
DISPLACED = torch.tensor([[0.09, -0.06, 0.12, 0.008, -0.006, 0.0]], dtype=torch.float64)


# By how much another pose must explain more, how much it must explain, how much of the events around it it must gather, and how many explain.
LEAST = torch.tensor([0.1, 0.0, 0.0, 0.0])
# Neither far off in depth nor explaining little: no reason to be looked for around where it was last seen well.
NOT_ANEW = torch.tensor([False]), torch.tensor([False])


def test_rest_explains_nothing_of_what_was_looked_for_in_many_places():
    assert explained_at_rest(torch.tensor([1.0, 1.5, 2.0, 3.2])).tolist() == [1.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize(("hypotheses", "times"), [(24, 1), (0, 0)])
def test_a_search_is_rehearsed_before_the_first_window(hypotheses, times, monkeypatch):
    rehearsed = []
    monkeypatch.setattr(
        "torchtrack.tracking.tracker.rehearse", lambda prediction, config: (rehearsed.append(prediction), rehearse(prediction, config))
    )
    tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig(search=SearchConfig(hypotheses=hypotheses)))
    tracker.prepare(tracker.init(pose()[None], 0))
    assert len(rehearsed) == times * backend_is_installed()


# ---- what is found


def test_a_displaced_box_is_found_again_by_the_search(dtype):
    tracker, prediction, seen, found, T_true = in_motion(displaced=DISPLACED, dtype=dtype)
    sigma = torch.tensor([0.1] * 3 + [0.01] * 3 + [1.0] * 3 + [0.1] * 3, dtype=torch.float64)
    prediction = replace(prediction, covariance=torch.diag_embed(sigma.square())[None])
    before, better = found, search(0, prediction, 8.0, LEAST, seen, found, tracker.config)
    degrees, millimetres = pose_errors(better.fit.solution.T_cam_obj.double(), T_true)
    assert float(pose_errors(before.fit.solution.T_cam_obj.double(), T_true)[0]) > 3
    assert float(degrees) < 1.0
    assert float(millimetres) < 3.0
    assert float(better.share) > float(before.share) + tracker.config.search.margin
    assert better.fit.contours.pixels.shape[1] >= before.fit.contours.pixels.shape[1]


FAR = torch.tensor([[0.3, -0.25, 0.2, 0.04, -0.03, 0.02]], dtype=torch.float64)


@pytest.mark.parametrize("velocity_known", [True, False])
def test_a_box_is_found_again_where_hardly_anything_is_known_of_it(velocity_known):
    """Twenty-five degrees and five centimetres off; a velocity that is taken for zero makes no pose explain anything by resting."""
    tracker, prediction, seen, found, T_true = in_motion(displaced=FAR)
    sigma = torch.tensor([0.3] * 3 + [0.04] * 3 + [2.0] * 3 + [0.3] * 3, dtype=torch.float64)
    velocity = prediction.velocity if velocity_known else torch.zeros_like(prediction.velocity)
    prediction = replace(prediction, covariance=torch.diag_embed(sigma.square())[None], velocity=velocity)
    better = search(0, prediction, 30.0, LEAST, seen, replace(found, measured=torch.zeros(1)), tracker.config)
    degrees, millimetres = pose_errors(better.fit.solution.T_cam_obj.double(), T_true)
    assert float(degrees) < 2.0
    assert float(millimetres) < 5.0


@pytest.mark.parametrize("axis", [(0.5, -0.8, 0.3), (-0.6, 0.2, 0.8), (0.9, 0.4, 0.1), (-0.1, -0.7, -0.7)])
def test_a_box_is_found_again_half_a_quarter_turn_off_about_any_axis(axis):
    turn = torch.nn.functional.normalize(torch.tensor(axis, dtype=torch.float64), dim=0) * 0.8
    displaced = torch.cat([turn, torch.tensor([0.03, -0.02, 0.03], dtype=torch.float64)])[None]
    tracker, prediction, seen, found, T_true = in_motion(displaced=displaced)
    sigma = torch.tensor([0.7] * 3 + [0.06, 0.06, 0.05] + [2.0] * 3 + [0.3] * 3, dtype=torch.float64)
    prediction = replace(prediction, covariance=torch.diag_embed(sigma.square())[None])
    better = search(0, prediction, 40.0, LEAST, seen, found, tracker.config)
    degrees, millimetres = pose_errors(better.fit.solution.T_cam_obj.double(), T_true)
    assert float(degrees) < 1.0 and float(millimetres) < 3.0


def test_the_best_poses_are_aligned_again_where_hardly_anything_is_known_and_nowhere_else(monkeypatch):
    counts = []
    monkeypatch.setattr(
        "torchtrack.tracking.relocalization.refine.align_all", lambda copies, *told: counts.append(len(told[0])) or align_all(copies, *told)
    )
    tracker, prediction, seen, found, _ = in_motion(displaced=DISPLACED)
    for sigma_px in (8.0, 30.0):
        search(0, prediction, sigma_px, LEAST, seen, found, tracker.config)
    once = replace_settings(tracker.config, realigned=0)
    search(0, prediction, 30.0, LEAST, seen, found, once)
    few = replace_settings(tracker.config, hypotheses=3, realigned=1)
    search(0, prediction, 30.0, LEAST, seen, found, few)
    assert counts == [24, 24, 8, 8, 24, 3, 3]


def replace_settings(config, **search_settings):
    return config.model_copy(update={"search": config.search.model_copy(update=search_settings)})


def test_of_poses_that_explain_as_much_the_most_expected_is_taken():
    """Turns of a vase about its axis all explain the same: the best of them by a hair is chance."""
    from_prior = torch.zeros(4, 13)
    from_prior[:, 1] = torch.tensor([0.5, 0.01, 0.0, 0.3])
    share, covariance = torch.tensor([0.9, 0.89, 0.6, 0.885]), 1e-2 * torch.eye(12, dtype=torch.float64)
    assert likeliest(share, from_prior, covariance).tolist() == [1]
    assert likeliest(share, from_prior.index_fill(0, torch.tensor([1]), torch.nan), covariance).tolist() == [3]
    assert likeliest(torch.tensor([0.9, 0.8, 0.6, 0.0]), from_prior, covariance).tolist() == [0]


def test_what_a_prediction_does_not_allow_is_not_likely():
    """In standard deviations; what is not a number is none."""
    offsets = torch.zeros(5, 13)
    offsets[1, 0], offsets[2, 0], offsets[3, :6], offsets[4, 2] = 0.4, 0.42, 0.18, torch.nan
    assert is_likely(offsets, 1e-2 * torch.eye(12, dtype=torch.float64)).tolist() == [True, True, False, False, False]
    wide = torch.full((1, 13), 5.0)
    assert is_likely(torch.cat([offsets[:1], wide]), 25.0 * torch.eye(12, dtype=torch.float64)).tolist() == [True, True]


def test_what_is_no_better_by_the_margin_is_left():
    tracker, prediction, seen, found, _ = in_motion()
    assert float(found.share) > 0.7
    assert search(0, prediction, 1.0, LEAST, seen, found, tracker.config) is found


def test_what_explains_too_little_for_being_far_away_is_left():
    tracker, prediction, seen, found, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    assert search(0, prediction, 8.0, torch.tensor([0.1, 1.1, 0.0, 0.0]), seen, found, tracker.config) is found
    better = search(0, prediction, 8.0, LEAST, seen, found, tracker.config)
    assert better.elsewhere.tolist() == [True] and found.elsewhere.tolist() == [False]


@pytest.mark.parametrize("gathered", [0.3, torch.nan])
def test_what_smears_events_more_than_it_may_is_left(gathered):
    """Where it cannot be told how far events gather, nothing speaks against a pose."""
    tracker, prediction, seen, found, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    assert search(0, prediction, 8.0, torch.tensor([0.1, 0.0, 1.01, 0.0]), seen, found, tracker.config) is found
    better = search(0, prediction, 8.0, torch.tensor([0.1, 0.0, gathered, 0.0]), seen, found, tracker.config)
    assert better.elsewhere.tolist() == [True]
    assert float(better.gathered) > 0.3


def test_what_explains_too_few_events_is_left():
    tracker, prediction, seen, found, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    better = search(0, prediction, 8.0, LEAST, seen, found, tracker.config)
    many = float(better.count)
    assert search(0, prediction, 8.0, torch.tensor([0.1, 0.0, 0.0, many]), seen, found, tracker.config).elsewhere.tolist() == [True]
    assert search(0, prediction, 8.0, torch.tensor([0.1, 0.0, 0.0, 2 * many]), seen, found, tracker.config) is found


def test_what_was_merely_not_seen_well_has_to_explain_nearly_all_elsewhere_and_no_fewer_events():
    tracker, state, _, _, _ = started()
    _, _, _, found, _ = in_motion()
    state = replace(state, score=torch.full((1,), 0.5), full_share=torch.full((1,), 0.8), unseen_s=torch.full((1,), 0.2))
    strayed, in_place = (tracker._doubt(state, state.t_us + later_us, torch.ones(1), torch.tensor([False]), NOT_ANEW) for later_us in (50_000, 0))
    assert strayed.strayed.tolist() == strayed.adrift.tolist() == [True]
    torch.testing.assert_close(strayed.doubted_s, state.unseen_s)
    assert in_place.adrift.tolist() == [False]
    near, elsewhere, _, as_last_seen = _least(strayed, found, tracker.config)[:, :, 0]
    for least in (near, as_last_seen):
        torch.testing.assert_close(least, torch.tensor([0.15, 0.72, 0.0, float(found.count)]))
    torch.testing.assert_close(elsewhere, torch.tensor([0.15, 0.72, 0.0, 0.0]))
    torch.testing.assert_close(_least(in_place, found, tracker.config)[0, :, 0], torch.tensor([0.1, 0.0, 0.0, 0.0]))


def in_doubt_and_sure():
    """A tracker, what is found of a box that was in doubt for long, and the doubt of it."""
    tracker, state, _, _, _ = started()
    _, _, _, found, _ = in_motion()
    found = replace(found, count=torch.full_like(found.count, 200))
    state = replace(state, score=torch.full((1,), 0.3), full_share=torch.full((1,), 0.8), doubted_s=torch.full((1,), 0.2))
    doubt = tracker._doubt(state, state.t_us + 50_000, torch.ones(1), torch.tensor([False]), NOT_ANEW)
    assert doubt.adrift.tolist() == [True] and doubt.strayed.tolist() == [False]
    return tracker, found, doubt


def test_what_is_in_doubt_but_explains_enough_by_many_events_stands():
    tracker, found, doubt = in_doubt_and_sure()
    stands = partial(_stands, config=tracker.config)
    assert stands(doubt, found).tolist() == [True]
    # Of 0.8 that it explains when seen well, a quarter.
    less = replace(found, measured=torch.full((1,), 0.19))
    assert stands(doubt, less).tolist() == stands(doubt, replace(found, count=torch.full_like(found.count, 119))).tolist() == [False]
    others = {"adrift": False, "strayed": True, "starting": True, "sigma_px": 6.5}
    assert not any(stands(replace(doubt, **{name: torch.tensor([value])}), found).any() for name, value in others.items())
    never = TrackerConfig(search=SearchConfig(stands_from=0))
    assert _stands(doubt, found, never).tolist() == [False]


def test_what_stands_is_looked_for_as_if_it_had_slipped_and_gives_way_to_far_more_events_elsewhere(monkeypatch):
    tracker, found, doubt = in_doubt_and_sure()
    assert _least(doubt, found, tracker.config)[3, :, 0].tolist() == pytest.approx([0.15, 0.72, 0.0, 400.0])
    _, prediction, seen, _, _ = in_motion()
    looked = {}
    for stands in (True, False):
        monkeypatch.setattr("torchtrack.tracking.relocalization.relocalize._stands", lambda *_, stands=stands: torch.tensor([stands]))
        monkeypatch.setattr(
            "torchtrack.tracking.relocalization.relocalize.search", lambda *args, stands=stands: looked.setdefault(stands, args[2]) and args[5]
        )
        last_seen = LastSeen(prediction.T_cam_obj.double(), prediction.covariance)
        told = replace(doubt, unseen_s=torch.zeros(1), has_symmetry=torch.tensor([False]))
        search_wanted(prediction, told, seen, found, torch.ones(1), tracker.config, last_seen, tracker.planes, tracker.axes)
    assert looked[True] == tracker.config.search.slip_sigma_px
    assert looked[False] > 2 * looked[True]


def test_while_a_motion_is_not_known_other_poses_must_not_smear_events_more():
    """Of any two poses, dense print explains about as much."""
    tracker, state, _, _, _ = started()
    _, _, _, found, _ = in_motion()
    doubts = [tracker._doubt(state, state.t_us, torch.ones(1), torch.tensor([starting]), NOT_ANEW) for starting in (True, False)]
    least = [_least(doubt, found, tracker.config) for doubt in doubts]
    assert 0.5 < float(least[0][0, 2]) < float(found.gathered) < float(least[0][0, 2]) + 0.05
    assert least[1][0, 2].tolist() == least[0][1, 2].tolist() == [0.0]
    assert _least(doubts[0], replace(found, gathered=torch.full((1,), torch.nan)), tracker.config)[0, 2] <= 0


def test_a_search_leaves_what_it_was_given_as_it_was():
    tracker, prediction, seen, found, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    before = [tensor.clone() for tensor in tensors_of(found)]
    search(0, prediction, 8.0, LEAST, seen, found, tracker.config)
    assert all(torch.equal(now, then) for now, then in zip(tensors_of(found), before, strict=True))


def displaced_runs(config, covariance_scale, count=10, displaced=DISPLACED):
    """Runs on from full motion with the pose displaced and its covariance scaled; results, and the true pose at their end."""
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    trajectory, events = moving_box(pose(), count + 5)
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 5))
    state = replace(
        state,
        T_cam_obj=retract_about(state.T_cam_obj, displaced, tracker.centre_obj.double()),
        covariance=covariance_scale * state.covariance,
    )
    _, results = follow(tracker, state, windows(events, count, 5 * WINDOW_US))
    return results, trajectory.at(results[-1].t_us)


def test_a_lost_box_is_found_again_and_without_the_search_it_is_not():
    # A little nearer, and it may come back by itself.
    with_search, T_true = displaced_runs(SEARCHED, 1.0, displaced=1.15 * DISPLACED)
    without, _ = displaced_runs(UNSEARCHED, 1.0, displaced=1.15 * DISPLACED)
    degrees, millimetres = pose_errors(with_search[-1].T_cam_obj, T_true)
    assert float(degrees) < 1.2
    assert float(millimetres) < 2.0
    assert int(with_search[-1].status) == Status.TRACKING
    assert float(pose_errors(without[-1].T_cam_obj, T_true)[0]) > 3


@pytest.mark.parametrize("farther", [1.0, 1.3, 1.5])
def test_a_box_that_slipped_is_found_within_a_window_however_sure_it_is_of_itself(farther):
    """Ten to fifteen degrees off, with the covariance of one that is tracked well; held by that, no search finds it."""
    slips, never = (TrackerConfig(search=SearchConfig(doubt_us=0, slipped_to=to)) for to in (SearchConfig().slipped_to, 0))
    found, T_true = displaced_runs(slips, 1.0, displaced=farther * DISPLACED)
    held, _ = displaced_runs(never, 1.0, displaced=farther * DISPLACED)
    assert int(found[0].status) == int(found[-1].status) == Status.TRACKING
    degrees, millimetres = pose_errors(found[-1].T_cam_obj, T_true)
    assert float(degrees) < 0.3 and float(millimetres) < 0.5
    assert [int(result.status) for result in held[:5]] == [Status.TOO_FEW_EVENTS] * 5


def test_what_slipped_goes_on_as_certain_as_if_it_had_been_predicted():
    """No less than what the prediction told, and events beside: the loose prior of the search is not left in it."""
    tracker, prediction, seen, found, _ = in_motion(displaced=DISPLACED)
    better = _search_slipped(0, prediction, float(prediction.sigma_px(found.fit.contours)), LEAST, seen, found, tracker.config)
    assert better.elsewhere.tolist() == [True] and found.elsewhere.tolist() == [False]
    told = tracker.config.solver.observation_px**2 * prediction.information[0]
    beside = better.fit.solution.hessian[0, :12, :12].double() - told
    scale = told.diagonal().rsqrt()
    assert float(torch.linalg.eigvalsh(beside * scale[:, None] * scale).min()) > -1e-3
    assert _search_slipped(0, prediction, 1.0, torch.tensor([0.1, 1.1, 0.0, 0.0]), seen, found, tracker.config) is found


@pytest.mark.parametrize("config", [UNSEARCHED, SEARCHED.model_copy(update={"solver": SEARCHED.solver.model_copy(update={"prior": False})})])
def test_without_hypotheses_or_a_prior_nothing_is_searched_for(config, monkeypatch):
    searched = []
    monkeypatch.setattr(
        "torchtrack.tracking.relocalization.relocalize.search",
        lambda number, prediction, sigma, least, seen, found, config: searched.append(number) or found,
    )
    displaced_runs(config, 100.0, count=2)
    assert searched == []


def test_while_all_goes_well_nothing_is_searched_for(monkeypatch):
    searched = []
    monkeypatch.setattr(
        "torchtrack.tracking.relocalization.relocalize.search",
        lambda number, prediction, sigma, least, seen, found, config: searched.append(number) or found,
    )
    _, events = moving_box(pose(), 10)
    # As a new object it would be, once in a while.
    tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig(search=SearchConfig(new_share=0)))
    follow(tracker, tracker.init(pose()[None], 0), windows(events, 10))
    assert len(searched) <= 1


def test_a_search_for_one_changes_nothing_for_its_neighbours(dtype):
    """Bit for bit: the first and last object of three are as if the one between had not been searched for."""
    starts = pose()[None].repeat(3, 1, 1)
    streams = [moving_box(pose(), 4, seed=s, stream=s)[1] for s in range(3)]
    batches = [(concatenate([stream.slice_time(k * WINDOW_US, (k + 1) * WINDOW_US) for stream in streams]), (k + 1) * WINDOW_US) for k in range(4)]
    runs = {}
    for name, config in (("with", SEARCHED), ("without", UNSEARCHED)):
        tracker = Tracker([box_model()] * 3, [SMALL_CAMERA] * 3, config, stream_index=[0, 1, 2], dtype=dtype)
        state, _ = follow(tracker, tracker.init(starts, 0), batches[:2])
        T, covariance = state.T_cam_obj.clone(), state.covariance.clone()
        T[1] = retract_about(T[1:2], DISPLACED, tracker.centre_obj[1:2].double())[0]
        covariance[1] *= 100
        runs[name] = follow(tracker, replace(state, T_cam_obj=T, covariance=covariance), batches[2:])[1]
    for number in (0, 2):
        assert torch.equal(poses_of(runs["with"], number), poses_of(runs["without"], number))
        for ours, theirs in zip(runs["with"], runs["without"], strict=True):
            assert torch.equal(ours.covariance[number], theirs.covariance[number])
            # There are as many places as the object with the most contours needs, and rounding hangs on how many there are.
            pixels = [contours.pixels[number][contours.mask[number]] for contours in (ours.contours, theirs.contours)]
            torch.testing.assert_close(*pixels, rtol=0, atol=1e-4)
    assert not torch.equal(poses_of(runs["with"], 1), poses_of(runs["without"], 1))


@pytest.mark.parametrize(("count", "times"), [(0, 0), (29, 0), (200, 1)])
def test_without_enough_events_there_is_nothing_to_search_in(count, times, monkeypatch):
    searched = []
    monkeypatch.setattr(
        "torchtrack.tracking.relocalization.relocalize.search",
        lambda number, prediction, sigma, least, seen, found, config: searched.append(number) or found,
    )
    tracker, state, _, _, _ = started(config=TrackerConfig(search=SearchConfig(interval_us=0, new_share=0)))
    noise = random_events(count, width=200, height=150, duration_us=WINDOW_US)
    after, result = tracker.step(replace(state, covariance=1e3 * state.covariance), replace(noise, t_us=noise.t_us + 25_000), 30_000)
    assert len(searched) == times
    assert count > 0 or Status(int(result.status)) == Status.TOO_FEW_EVENTS
    assert torch.isfinite(after.covariance).all()
