"""The search over many poses: what is drawn, how it is marked, that lost objects are found again and others left alone."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, generator, pose, pose_errors, random_events
from tracked_boxes import WINDOW_US, follow, moving_box, poses_of, started, tensors_of, windows

from torchtrack import Tracker
from torchtrack.alignment import align, gate_widening, index_for
from torchtrack.config.tracker import SearchConfig, TrackerConfig
from torchtrack.events import concatenate, pad_streams
from torchtrack.lie import retract_about
from torchtrack.observations import select_events
from torchtrack.quality import Status
from torchtrack.search import Doubt, draw_offsets, event_density, judge_fit, mark, may_be_wanted, search

SEARCHED = TrackerConfig()
UNSEARCHED = TrackerConfig(search=SearchConfig(hypotheses=0))
IMAGE_SIZE = (SMALL_CAMERA.height, SMALL_CAMERA.width)
# Ten degrees and some millimetres: edges are several pixels off, farther than the tight gate reaches.
DISPLACED = torch.tensor([[0.09, -0.06, 0.12, 0.008, -0.006, 0.0]], dtype=torch.float64)


MARGIN = torch.tensor(0.1)


def random_covariance(seed=0, scale=1e-4):
    root = torch.randn((12, 24), generator=generator(seed), dtype=torch.float64)
    return scale * root @ root.T / 24


# ---- when


def test_uncertain_objects_and_those_explained_worse_than_usual_are_searched_for():
    config = SearchConfig(from_sigma_px=4.0, dropped_to=0.8)
    share, usual = torch.tensor([0.9, 0.71, 0.73, 0.9, 0.0]), torch.tensor([0.9, 0.9, 0.9, 0.9, 0.0])
    sigma_px = torch.tensor([1.0, 1.0, 1.0, 4.1, 1.0])
    starting = torch.zeros(5, dtype=torch.bool)
    assert Doubt(sigma_px, share, usual, starting).asks(share, config).tolist() == [False, True, False, True, False]


@pytest.mark.parametrize("at_start", [True, False])
def test_objects_whose_motion_is_not_known_are_searched_for(at_start):
    starting, usual = torch.tensor([True, False]), torch.full((2,), 0.9)
    doubt = Doubt(torch.ones(2), usual, usual, starting)
    config = TrackerConfig(search=SearchConfig(at_start=at_start))
    assert doubt.asks(usual, config.search).tolist() == may_be_wanted(doubt, config).tolist() == [at_start, False]


# ---- what is drawn


def test_offsets_are_drawn_with_the_covariance():
    covariance = random_covariance()
    offsets = draw_offsets(covariance, 8000)
    assert offsets.shape == (8000, 13)
    assert (offsets[0] == 0).all()
    assert (offsets[:, 12] == 0).all()
    found = offsets[:, :6].T @ offsets[:, :6] / len(offsets)
    scale = covariance[:6, :6].diagonal().sqrt()
    assert float(((found - covariance[:6, :6]) / (scale[:, None] * scale)).abs().max()) < 0.03
    assert float((offsets[:, :6].mean(0) / scale).abs().max()) < 0.01
    assert torch.isfinite(offsets).all()


def test_the_velocity_of_an_offset_is_what_its_pose_implies():
    """The mean of the velocity given the pose; with a covariance that knows of no relation there is none."""
    covariance = random_covariance()
    offsets = draw_offsets(covariance, 100)
    gain = covariance[6:, :6] @ torch.linalg.inv(covariance[:6, :6])
    torch.testing.assert_close(offsets[:, 6:12], offsets[:, :6] @ gain.T)
    apart = covariance.clone()
    apart[6:, :6] = apart[:6, 6:] = 0
    assert float(draw_offsets(apart, 100)[:, 6:].abs().max()) == 0


def test_the_draw_is_the_same_every_time_and_more_of_it_begins_as_less():
    covariance = random_covariance()
    assert torch.equal(draw_offsets(covariance, 300), draw_offsets(covariance, 300))
    assert torch.equal(draw_offsets(covariance, 600)[:300], draw_offsets(covariance, 300))


# ---- how poses are marked


def test_density_counts_the_events_around_every_pixel():
    places = torch.tensor([[[10.0, 20.0], [10.4, 20.4], [11.0, 20.0], [60.0, 30.0], [0.0, 0.0], [90.0, 40.0]]])
    density = event_density(places, torch.tensor([[True] * 5 + [False]]), IMAGE_SIZE)
    # Two pixels of border all around.
    assert density.shape == (154, 204)
    for (u, v), count in {(10, 20): 3, (9, 20): 2, (12, 21): 1, (60, 30): 1, (62, 30): 0, (0, 0): 1, (90, 40): 0}.items():
        assert int(density[v + 2, u + 2]) == count
    assert int(density.sum()) == 9 * 5


def test_events_outside_the_image_or_nowhere_are_not_counted():
    places = torch.tensor([[[-50.0, 3.0], [1e9, 1e9], [torch.nan, 5.0], [50.0, torch.inf], [199.0, 149.0]]])
    density = event_density(places, torch.ones(1, 5, dtype=torch.bool), IMAGE_SIZE)
    assert int(density.sum()) == 9
    assert int(density[151, 201]) == 1


def in_motion(config=None, displaced=None, dtype=torch.float32):
    """A box in full motion, whose pose may be displaced: tracker, prediction, events, found alone, and the true pose."""
    tracker, state, _, (events, end_us), trajectory = started(dtype, config)
    if displaced is not None:
        state = replace(state, T_cam_obj=retract_about(state.T_cam_obj, displaced, tracker.centre_obj.double()))
    prediction = tracker._predict(state, torch.tensor([5e-3], dtype=dtype))
    seen = tracker.sensors.seen(pad_streams(events, 1, torch.tensor([end_us])))
    contours = prediction.objects.contours(prediction.T_cam_obj, tracker.config.contours)
    tight = gate_widening(torch.zeros(1, dtype=dtype), tracker.config)
    index = index_for(contours, IMAGE_SIZE, tracker.config, tight)
    observations = select_events(seen, index, prediction.plane_velocity(seen.pixels), 1000)
    found = judge_fit(prediction, align(prediction, contours, index, tight, observations, tracker.config), tracker.config)
    return tracker, prediction, seen, found, trajectory.at(torch.tensor([end_us]))


def test_the_true_pose_is_marked_best(dtype):
    _, prediction, seen, found, _ = in_motion(dtype=dtype)
    density = event_density(seen.pixels + prediction.plane_velocity(seen.pixels) * seen.age_s[..., None], seen.mask, IMAGE_SIZE)
    away = torch.zeros(13, 13, dtype=dtype)
    for axis in range(6):
        away[2 * axis + 1, axis], away[2 * axis + 2, axis] = (0.15, -0.15) if axis < 3 else (0.015, -0.015)
    # Depth moves contours least.
    away[11:] *= 4
    marks = mark(prediction, found.fit.contours, 0, away, density)
    assert int(marks.argmax()) == 0
    assert float(marks[0]) > 1.5 * float(marks[1:].max())


def test_marks_of_poses_behind_the_camera_are_numbers():
    _, prediction, seen, found, _ = in_motion()
    offsets = torch.zeros(2, 13)
    offsets[1, 5] = -2.0
    assert torch.isfinite(mark(prediction, found.fit.contours, 0, offsets, event_density(seen.pixels, seen.mask, IMAGE_SIZE))).all()


# ---- what is found


def test_a_displaced_box_is_found_again_by_the_search(dtype):
    tracker, prediction, seen, found, T_true = in_motion(displaced=DISPLACED, dtype=dtype)
    sigma = torch.tensor([0.1] * 3 + [0.01] * 3 + [1.0] * 3 + [0.1] * 3, dtype=torch.float64)
    prediction = replace(prediction, covariance=torch.diag_embed(sigma.square())[None])
    before, better = found, search(0, prediction, 8.0, MARGIN, seen, found, tracker.config)
    degrees, millimetres = pose_errors(better.fit.solution.T_cam_obj.double(), T_true)
    assert float(pose_errors(before.fit.solution.T_cam_obj.double(), T_true)[0]) > 3
    assert float(degrees) < 1.0
    assert float(millimetres) < 3.0
    assert float(better.share) > float(before.share) + tracker.config.search.margin
    assert better.fit.contours.pixels.shape[1] >= before.fit.contours.pixels.shape[1]


def test_what_is_no_better_by_the_margin_is_left():
    tracker, prediction, seen, found, _ = in_motion()
    assert float(found.share) > 0.7
    assert search(0, prediction, 1.0, MARGIN, seen, found, tracker.config) is found


def test_a_search_leaves_what_it_was_given_as_it_was():
    tracker, prediction, seen, found, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    before = [tensor.clone() for tensor in tensors_of(found)]
    search(0, prediction, 8.0, MARGIN, seen, found, tracker.config)
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


@pytest.mark.parametrize("config", [UNSEARCHED, SEARCHED.model_copy(update={"solver": SEARCHED.solver.model_copy(update={"prior": False})})])
def test_without_hypotheses_or_a_prior_nothing_is_searched_for(config, monkeypatch):
    searched = []
    monkeypatch.setattr("torchtrack.search.search", lambda number, prediction, sigma, margin, seen, found, config: searched.append(number) or found)
    displaced_runs(config, 100.0, count=2)
    assert searched == []


def test_while_all_goes_well_nothing_is_searched_for(monkeypatch):
    searched = []
    monkeypatch.setattr("torchtrack.search.search", lambda number, prediction, sigma, margin, seen, found, config: searched.append(number) or found)
    _, events = moving_box(pose(), 10)
    tracker = Tracker([box_model()], SMALL_CAMERA)
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
    monkeypatch.setattr("torchtrack.search.search", lambda number, prediction, sigma, margin, seen, found, config: searched.append(number) or found)
    tracker, state, _, _, _ = started()
    noise = random_events(count, width=200, height=150, duration_us=WINDOW_US)
    after, result = tracker.step(replace(state, covariance=1e3 * state.covariance), replace(noise, t_us=noise.t_us + 25_000), 30_000)
    assert len(searched) == times
    assert count > 0 or Status(int(result.status)) == Status.TOO_FEW_EVENTS
    assert torch.isfinite(after.covariance).all()
