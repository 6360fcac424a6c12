"""Contours learned on the surface of objects: what is tracked with them, what is not learned, and what is left alone."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, edge_events, pose, pose_errors
from printed_plate import PLATE_CAMERA, PLATE_POSE, PRINTED, line_events, plate_model, starting
from states import changed
from tracked_boxes import WIDE_CAMERA, assert_same, follow, merged, moving_box, poses_of, windows

from torchtrack import Tracker
from torchtrack.config.tracker import AdaptationConfig, ContourConfig, TrackerConfig
from torchtrack.core.events import concatenate
from torchtrack.core.lie import rotation_angle_deg
from torchtrack.object_model import contour_source
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.adaptation import learned_contours, surface_learning
from torchtrack.tracking.adaptation.learned_contours import TRUSTED_FROM, LearnedContours

COUNT = 24
OFF = TrackerConfig(adaptation=AdaptationConfig(learned_points=0))


@cache
def plate_sequence(seed=0, stream=0, count=COUNT):
    trajectory = starting(count * 5_000)
    return trajectory, line_events(trajectory, PRINTED, seed=seed, stream=stream)


@cache
def plate_followed(config=None):
    _, events = plate_sequence()
    tracker = Tracker([plate_model()], PLATE_CAMERA, config)
    return follow(tracker, tracker.init(PLATE_POSE[None], 0), windows(events, COUNT))


def trusted(learned):
    return learned.evidence >= TRUSTED_FROM


def errors_of(results):
    times = torch.stack([result.t_us[0] for result in results])
    return pose_errors(poses_of(results), plate_sequence()[0].at(times))


def test_a_plate_with_print_that_its_model_lacks_is_followed():
    _, results = plate_followed()
    rotation_deg, translation_mm = errors_of(results)
    assert float(rotation_deg.max()) < 1.5
    assert float(translation_mm.max()) < 4
    _, without = plate_followed(OFF)
    assert float(errors_of(without)[1].max()) > 10


def test_learned_contours_lie_on_the_print():
    state, results = plate_followed()
    learned = state.appearance.learned
    points = learned.points_obj[0][trusted(learned)[0]].double()
    assert len(points) > 100
    start, end = PRINTED.unbind(1)
    along = ((points[:, None] - start) * (end - start)).sum(-1) / (end - start).square().sum(-1)
    distance_m = (points[:, None] - start - along.clamp(0, 1)[..., None] * (end - start)).norm(dim=-1).min(1).values
    assert float(distance_m.median()) < 1.5e-3
    tangents = learned.tangents_obj[0][trusted(learned)[0]]
    torch.testing.assert_close(tangents.norm(dim=-1), torch.ones(len(tangents)))
    # The sides of the texture are parallel to those of the plate.
    assert float((tangents[:, :2].abs().max(1).values > 0.97).float().mean()) > 0.8
    shown = results[-1].contours
    assert bool((shown.mask & (shown.kind == int(ContourKind.LEARNED))).any())


def test_an_object_that_its_model_explains_uses_nothing_learned():
    _, events = moving_box(pose(), 10)
    on, off = (Tracker([box_model()], SMALL_CAMERA, config) for config in (None, OFF))
    state, results = follow(on, on.init(pose()[None], 0), windows(events, 10))
    _, without = follow(off, off.init(pose()[None], 0), windows(events, 10))
    assert not bool(state.appearance.learned.needed.any())
    assert torch.equal(poses_of(results), poses_of(without))


def test_an_object_that_its_model_explains_learns_nothing_beside_one_that_lacks_contours():
    _, events = plate_sequence()
    cut = windows(events, 7)
    tracker = Tracker([plate_model()] * 2, [PLATE_CAMERA] * 2, stream_index=[0, 1])
    both = [(concatenate([window, window.of_stream(1)]), end_us) for window, end_us in cut]
    state, _ = follow(tracker, tracker.init(PLATE_POSE.repeat(2, 1, 1), 0), both[:-1])
    before = changed(state, learned=replace(state.appearance.learned, model_share=torch.tensor([0.3, 0.9])))
    after, _ = tracker.step(before, *both[-1])
    for name in ("drafts_obj", "drafted", "evidence"):
        mine, theirs = getattr(after.appearance.learned, name), getattr(before.appearance.learned, name)
        assert not torch.equal(mine[0], theirs[0])
        assert torch.equal(mine[1], theirs[1])
    # Whether that is still so is looked at all the same.
    assert (after.appearance.learned.model_share != before.appearance.learned.model_share).all()


def test_objects_that_are_not_beside_one_to_learn_of_are_left_out_and_change_nothing(monkeypatch):
    starts = torch.stack([pose(translation=(x_m, 0.0, depth_m)) for x_m, depth_m in ((-0.16, 0.5), (-0.15, 0.7), (0.2, 0.5), (-0.18, 0.8))])
    events = merged(*(moving_box(start, 4, WIDE_CAMERA, seed=number)[1] for number, start in enumerate(starts[:3])))
    tracker = Tracker([box_model()] * 4, WIDE_CAMERA)
    state, _ = follow(tracker, tracker.init(starts, 0), windows(events, 3))
    before = changed(state, learned=replace(state.appearance.learned, model_share=torch.tensor([0.3, 0.9, 0.9, 0.9])))
    asked, concerned = [], surface_learning._concerned
    monkeypatch.setattr(surface_learning, "_concerned", lambda *given: asked.append(concerned(*given)) or asked[-1])
    after = tracker.step(before, *windows(events, 4)[3])
    assert asked[0].tolist() == [True, True, False, True]
    assert not torch.equal(after[0].appearance.learned.drafted[0], before.appearance.learned.drafted[0])
    monkeypatch.setattr(surface_learning, "_concerned", lambda wanted, _: torch.ones_like(wanted))
    assert_same(after, tracker.step(before, *windows(events, 4)[3]))


def test_an_occluder_that_passes_teaches_nothing(monkeypatch):
    """Bars that sweep over a plate whose own texture is known by then."""
    monkeypatch.setattr(learned_contours, "EVERY", 1)
    trajectory, events = plate_sequence()
    bars = torch.tensor([[[x_m, -0.1, 0.0], [x_m, 0.1, 0.0]] for x_m in (-0.3, -0.28, -0.26)], dtype=torch.float64)
    T_bars = replace(trajectory, T_cam_obj=torch.eye(4, dtype=torch.float64).repeat(len(trajectory.t_us), 1, 1))
    T_bars.T_cam_obj[:, 0, 3] = 5e-6 * trajectory.t_us
    T_bars.T_cam_obj[:, 2, 3] = 0.45
    tracker = Tracker([plate_model()], PLATE_CAMERA)
    both = merged(events, line_events(T_bars, bars, seed=1))
    state, results = follow(tracker, tracker.init(PLATE_POSE[None], 0), windows(both, COUNT))
    assert float(errors_of(results)[1].max()) < 6
    points = state.appearance.learned.points_obj[0][trusted(state.appearance.learned)[0]].double()
    start, end = PRINTED.unbind(1)
    along = ((points[:, None] - start) * (end - start)).sum(-1) / (end - start).square().sum(-1)
    distance_m = (points[:, None] - start - along.clamp(0, 1)[..., None] * (end - start)).norm(dim=-1).min(1).values
    assert len(points) > 100
    assert float((distance_m > 5e-3).double().mean()) < 0.03


def test_what_falls_silent_is_forgotten(monkeypatch):
    monkeypatch.setattr(learned_contours, "EVERY", 1)
    state, _ = plate_followed()
    tracker = Tracker([plate_model()], PLATE_CAMERA)
    # From now on only the border and the frame fire: the text is gone.
    later = starting((COUNT + 12) * 5_000)
    events = line_events(later, PRINTED[:6]).slice_time(COUNT * 5_000, (COUNT + 12) * 5_000)
    before = state.appearance.learned
    is_text = trusted(before)[0] & (before.points_obj[0, :, 0].abs() < 0.088) & (before.points_obj[0, :, 1].abs() < 0.062)
    after, _ = follow(tracker, state, windows(events, 12, COUNT * 5_000))
    assert int(is_text.sum()) > 50
    assert float(after.appearance.learned.evidence[0, is_text].mean()) < 0.8 * float(before.evidence[0, is_text].mean())


@pytest.mark.parametrize("points", [1, 40, 300])
def test_no_more_is_learned_than_there_is_room_for(monkeypatch, points):
    monkeypatch.setattr(learned_contours, "DRAFTS", 500)
    _, events = plate_sequence()
    tracker = Tracker([plate_model()], PLATE_CAMERA, TrackerConfig(adaptation=AdaptationConfig(learned_points=points)))
    state, results = follow(tracker, tracker.init(PLATE_POSE[None], 0), windows(events, 12))
    assert state.appearance.learned.points_obj.shape == (1, points, 3)
    assert state.appearance.learned.drafts_obj.shape == (1, 500, 3)
    assert int((state.appearance.learned.evidence > 0).sum()) == points or points == 300
    assert bool(torch.isfinite(state.appearance.learned.points_obj).all())
    assert int((results[-1].contours.kind == int(ContourKind.LEARNED)).sum()) in (0, points)


def test_learned_points_are_apart():
    state, results = plate_followed()
    learned = state.appearance.learned
    pixels = learned.points(least=1e-6).contours(results[-1].T_cam_obj.float(), torch.tensor([[450.0, 450.0, 159.5, 119.5]])).pixels[0]
    known = pixels[learned.evidence[0] > 0]
    distance = torch.cdist(known, known) + 100 * torch.eye(len(known))
    assert float(distance.min(1).values.quantile(0.05)) > 1


def test_a_batch_learns_what_each_object_alone_learns():
    sequences = [plate_sequence(seed, stream)[1] for stream, seed in enumerate((0, 3))]
    pair = Tracker([plate_model()] * 2, [PLATE_CAMERA] * 2, stream_index=[0, 1], dtype=torch.float64)
    both = [(concatenate([a, b]), end_us) for (a, end_us), (b, _) in zip(*(windows(events, 8) for events in sequences), strict=True)]
    state, results = follow(pair, pair.init(PLATE_POSE.repeat(2, 1, 1), 0), both)
    for number, seed in enumerate((0, 3)):
        alone = Tracker([plate_model()], PLATE_CAMERA, dtype=torch.float64)
        own, ours = follow(alone, alone.init(PLATE_POSE[None], 0), windows(plate_sequence(seed)[1], 8))
        torch.testing.assert_close(poses_of(results, number), poses_of(ours), rtol=0, atol=1e-6)
        torch.testing.assert_close(state.appearance.learned.evidence[number], own.appearance.learned.evidence[0])


def test_a_neighbour_that_fails_changes_nothing():
    _, events = plate_sequence()
    states = []
    for broken in (False, True):
        tracker = Tracker([plate_model()] * 2, [PLATE_CAMERA] * 2, stream_index=[0, 1])
        state = tracker.init(PLATE_POSE.repeat(2, 1, 1), 0)
        if broken:
            state.T_cam_obj[1, 0, 3] = torch.nan
        states.append(follow(tracker, state, windows(events, 6))[0])
    assert torch.equal(states[0].T_cam_obj[0], states[1].T_cam_obj[0])
    for ours, theirs in zip(vars(states[0].appearance.learned).values(), vars(states[1].appearance.learned).values(), strict=True):
        assert ours[0].equal(theirs[0]) if torch.is_tensor(ours) else ours == theirs
    assert not bool(states[1].appearance.learned.evidence[1].any())


def test_the_state_before_is_left_as_it_was(monkeypatch):
    monkeypatch.setattr(learned_contours, "EVERY", 1)
    state, _ = plate_followed()
    tracker = Tracker([plate_model()], PLATE_CAMERA)
    kept = [value.clone() for value in vars(state.appearance.learned).values() if torch.is_tensor(value)]
    events = line_events(starting((COUNT + 1) * 5_000), PRINTED).slice_time(COUNT * 5_000, (COUNT + 1) * 5_000)
    once, again = (tracker.step(state, events, (COUNT + 1) * 5_000) for _ in range(2))
    assert_same(once, again)
    assert all(
        torch.equal(value, before) for value, before in zip(filter(torch.is_tensor, vars(state.appearance.learned).values()), kept, strict=True)
    )


def test_only_some_of_the_later_windows_are_learned_from():
    learned = LearnedContours.none(1, 16, torch.zeros(1))
    assert [number for number in range(45) if replace(learned, windows=number).due()] == [*range(20), 20, 30, 40]


@pytest.mark.parametrize("config", [OFF, TrackerConfig(contours=ContourConfig(source="splat"))], ids=["off", "splat"])
def test_switched_off_there_is_nothing(config):
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    assert tracker.init(pose()[None], 0).appearance.learned is None


def test_nothing_is_learned_on_dense_meshes(monkeypatch):
    monkeypatch.setattr(contour_source, "EXACT_FACES", 0)
    _, events = plate_sequence()
    tracker = Tracker([plate_model()], PLATE_CAMERA)
    state, results = follow(tracker, tracker.init(PLATE_POSE[None], 0), windows(events, 2))
    assert not bool(state.appearance.learned.drafted.any())
    assert not bool((results[-1].contours.kind == int(ContourKind.LEARNED)).any())


def test_a_search_takes_what_was_learned_along():
    state, _ = plate_followed()
    tracker = Tracker([plate_model()], PLATE_CAMERA)
    away = state.T_cam_obj.clone()
    away[:, 0, 3] += 0.006
    lost = changed(state, T_cam_obj=away, covariance=state.motion.covariance * 400)
    trajectory = starting((COUNT + 2) * 5_000)
    events = line_events(trajectory, PRINTED).slice_time(COUNT * 5_000, (COUNT + 2) * 5_000)
    _, results = follow(tracker, lost, windows(events, 2, COUNT * 5_000))
    true = trajectory.at(results[-1].t_us[:1])
    assert float((results[-1].T_cam_obj - true)[0, :3, 3].norm()) < 5e-3
    assert float(rotation_angle_deg(results[-1].T_cam_obj[0, :3, :3], true[0, :3, :3])) < 2


def test_boxes_in_one_stream_learn_each_their_own():
    """What one object shows in front of another is not learned on the one behind."""
    front, behind = pose(translation=(0.0, 0.0, 0.4)), pose(translation=(0.02, 0.0, 0.6))
    trajectory, events = moving_box(front, 6, move=(0.1, 0.0, 0.0))
    still = edge_events(replace(trajectory, T_cam_obj=behind.repeat(len(trajectory.t_us), 1, 1)))
    tracker = Tracker([box_model()] * 2, SMALL_CAMERA)
    state, _ = follow(tracker, tracker.init(torch.stack([front, behind]), 0), windows(merged(events, still), 6))
    assert int((state.appearance.learned.evidence[1] >= 3).sum()) <= 5
