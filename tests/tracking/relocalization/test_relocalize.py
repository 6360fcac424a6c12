"""The loop of relocalization: which sources are tried for whom, that lost objects are reached again, and others left alone."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors, random_events
from lost_objects import acceptance_test, evidence, lost_object
from states import changed
from tracked_boxes import WINDOW_US, follow, in_motion, moving_box, poses_of, started, tensors_of, windows

from torchtrack import Tracker
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.dispatch import backend
from torchtrack.core.events import concatenate
from torchtrack.core.lie import retract_about
from torchtrack.tracking.relocalization import hypotheses, refine
from torchtrack.tracking.relocalization.hypotheses import around_prediction
from torchtrack.tracking.relocalization.relocalize import relocalize
from torchtrack.tracking.relocalization.sources import SOURCES, Source
from torchtrack.tracking.relocalization.triggers import AROUND_LAST_SEEN, AROUND_PREDICTION, Trigger, triggered
from torchtrack.tracking.validation.status import Status

LOOP = "torchtrack.tracking.relocalization.relocalize"
SEARCHED = TrackerConfig()
UNSEARCHED = TrackerConfig(relocalization=RelocalizationConfig(hypotheses=0))
# Ten degrees and some millimetres: edges are several pixels off, farther than the tight gate reaches.
DISPLACED = torch.tensor([[0.09, -0.06, 0.12, 0.008, -0.006, 0.0]], dtype=torch.float64)


# ---- which sources are tried


@pytest.mark.parametrize("trigger", [trigger for trigger in Trigger if trigger != Trigger.LOST], ids=lambda trigger: trigger.name)
def test_every_trigger_but_lost_calls_for_a_source(trigger):
    """What is lost is expected where it was last seen, and uncertain there."""
    assert any(source.is_called_for(trigger) for source in SOURCES)


def test_without_triggers_or_lost_alone_nothing_is_called_for():
    assert not any(source.is_called_for(flags) for source in SOURCES for flags in (Trigger(0), Trigger.LOST))


def test_what_is_called_for_around_the_last_place_comes_last():
    assert [source.triggers for source in SOURCES if source.comes_last] == [AROUND_LAST_SEEN, Trigger.UNCONFIRMED]
    assert AROUND_PREDICTION in [source.triggers for source in SOURCES]


def displaced_and_lost():
    """A box whose pose is off, as the loop has it: what relocalize takes, with a prediction that allows for that."""
    tracker, prediction, seen, scored, T_true = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    lost = lost_object(tracker, prediction, seen, scored, 8.0)
    return lost, seen, T_true


def looped(lost, seen, given, sources=SOURCES):
    return relocalize(lost.window, triggered(given, lost.config), seen, lost.last_seen, lost.config, sources)


def test_a_further_source_needs_no_change_of_the_loop():
    """It knows the true pose, which none of the others is asked for."""
    lost, seen, T_true = displaced_and_lost()

    def oracle(seen_by_it):
        known = replace(seen_by_it.widened, T_cam_obj=T_true.float())
        return replace(around_prediction(replace(seen_by_it, widened=known)), replaces_prediction=True)

    further = Source(Trigger.LOST, oracle, lambda *_: acceptance_test())
    given = evidence(triggers=int(Trigger.LOST))
    untried = looped(lost, seen, given)
    assert untried.scored is lost.window.scored and untried.looked.tolist() == [False]
    after = looped(lost, seen, given, (*SOURCES, further))
    degrees, millimetres = pose_errors(after.scored.fit.solution.T_cam_obj.double(), T_true)
    assert float(degrees) < 0.5 and float(millimetres) < 1.0
    assert torch.equal(after.prediction.T_cam_obj, T_true.float())
    assert after.scored.is_relocalized.tolist() == [True]


def test_sources_are_tried_in_order_and_each_on_what_those_before_gave():
    lost, seen, _ = displaced_and_lost()
    windows_seen = []

    def noted(seen_by_it):
        windows_seen.append(seen_by_it.window.scored)
        return around_prediction(seen_by_it)

    source = Source(Trigger.UNCERTAIN, noted, lambda *_: acceptance_test())
    after = looped(lost, seen, evidence(sigma_px=8.0), (source, source))
    assert windows_seen[0] is lost.window.scored
    assert windows_seen[1].is_relocalized.tolist() == [True]
    assert torch.equal(after.scored.fit.solution.T_cam_obj, windows_seen[1].fit.solution.T_cam_obj)


def test_what_had_drifted_and_is_relocalized_is_as_uncertain_as_that_made_it():
    lost, seen, _ = displaced_and_lost()
    drifts = evidence(is_drift_due=True, drift_s=0.2, sigma_px=8.0, reference_explained_ratio=0.5)
    after = looped(lost, seen, drifts)
    assert after.scored.is_relocalized.tolist() == [True]
    assert float(after.prediction.covariance[0, 3, 3]) > float(lost.window.prediction.covariance[0, 3, 3])
    assert float(after.gate_scale) > 1
    sure = looped(lost, seen, evidence(sigma_px=8.0))
    assert sure.scored.is_relocalized.tolist() == [True]
    assert torch.equal(sure.prediction.covariance, lost.window.prediction.covariance) and float(sure.gate_scale) == 1


def test_a_search_leaves_what_it_was_given_as_it_was():
    lost, seen, _ = displaced_and_lost()
    before = [tensor.clone() for tensor in tensors_of(lost.window.scored)]
    assert looped(lost, seen, evidence(sigma_px=8.0)).scored.is_relocalized.tolist() == [True]
    for now, then in zip(tensors_of(lost.window.scored), before, strict=True):
        torch.testing.assert_close(now, then, rtol=0, atol=0, equal_nan=True)


# ---- in the tracker


@torch.no_grad()
def displaced_runs(config, covariance_scale, count=10, displaced=DISPLACED):
    """Runs on from full motion with the pose displaced and its covariance scaled; results, and the true pose at their end."""
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    trajectory, events = moving_box(pose(), count + 5)
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 5))
    T_cam_obj = retract_about(state.T_cam_obj, displaced, tracker.centre_obj.double())
    state = changed(state, T_cam_obj=T_cam_obj, covariance=covariance_scale * state.motion.covariance)
    _, results = follow(tracker, state, windows(events, count, 5 * WINDOW_US))
    return results, trajectory.at(results[-1].t_us)


def test_a_lost_box_is_found_again_and_without_the_search_it_is_not():
    # A little nearer, and it may come back by itself.
    with_search, T_true = displaced_runs(SEARCHED, 1.0, 15, displaced=1.3 * DISPLACED)
    without, _ = displaced_runs(UNSEARCHED, 1.0, 15, displaced=1.3 * DISPLACED)
    degrees, millimetres = pose_errors(with_search[-1].T_cam_obj, T_true)
    assert float(degrees) < 1.2
    assert float(millimetres) < 2.0
    assert int(with_search[-1].status) == Status.TRACKING
    assert float(pose_errors(without[-1].T_cam_obj, T_true)[0]) > 3


@pytest.mark.parametrize("farther", [1.0, 1.3, 1.5])
def test_a_box_that_slipped_is_found_however_sure_it_is_of_itself(farther):
    """Ten to fifteen degrees off, with the covariance of one that is tracked well."""
    results, T_true = displaced_runs(TrackerConfig(), 1.0, 40, displaced=farther * DISPLACED)
    degrees, millimetres = pose_errors(results[-1].T_cam_obj, T_true)
    assert float(degrees) < 0.3 and float(millimetres) < 0.5
    assert int(results[-1].status) == Status.TRACKING


@pytest.mark.parametrize("config", [UNSEARCHED, SEARCHED.model_copy(update={"solver": SEARCHED.solver.model_copy(update={"prior": False})})])
def test_without_hypotheses_or_a_prior_nothing_is_searched_for(config, monkeypatch):
    searched = []
    monkeypatch.setattr(f"{LOOP}._tried", lambda lost, *_: searched.extend(lost.numbers) or lost.window)
    displaced_runs(config, 100.0, count=2)
    assert searched == []


@torch.no_grad()
def test_while_all_goes_well_nothing_is_searched_for(monkeypatch):
    searched = []
    monkeypatch.setattr(f"{LOOP}._tried", lambda lost, *_: searched.extend(lost.numbers) or lost.window)
    _, events = moving_box(pose(), 10)
    # As a new object it would be, once in a while.
    tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig(relocalization=RelocalizationConfig(new_below=0)))
    follow(tracker, tracker.init(pose()[None], 0), windows(events, 10))
    assert len(searched) <= 1


@torch.no_grad()
def test_a_search_for_one_changes_nothing_for_its_neighbours(dtype):
    """Bit for bit: the first and last object of three are as if the one between had not been searched for."""
    starts = pose()[None].repeat(3, 1, 1)
    streams = [moving_box(pose(), 4, seed=s, stream=s)[1] for s in range(3)]
    batches = [(concatenate([stream.slice_time(k * WINDOW_US, (k + 1) * WINDOW_US) for stream in streams]), (k + 1) * WINDOW_US) for k in range(4)]
    runs = {}
    for name, config in (("with", SEARCHED), ("without", UNSEARCHED)):
        tracker = Tracker([box_model()] * 3, [SMALL_CAMERA] * 3, config, stream_index=[0, 1, 2], dtype=dtype)
        state, _ = follow(tracker, tracker.init(starts, 0), batches[:2])
        T, covariance = state.T_cam_obj.clone(), state.motion.covariance.clone()
        T[1] = retract_about(T[1:2], DISPLACED, tracker.centre_obj[1:2].double())[0]
        covariance[1] *= 100
        runs[name] = follow(tracker, changed(state, T_cam_obj=T, covariance=covariance), batches[2:])[1]
    for number in (0, 2):
        assert torch.equal(poses_of(runs["with"], number), poses_of(runs["without"], number))
        for ours, theirs in zip(runs["with"], runs["without"], strict=True):
            assert torch.equal(ours.covariance[number], theirs.covariance[number])
            # There are as many places as the object with the most contours needs, and rounding hangs on how many there are.
            pixels = [contours.pixels[number][contours.mask[number]] for contours in (ours.contours, theirs.contours)]
            torch.testing.assert_close(*pixels, rtol=0, atol=1e-4)
    assert not torch.equal(poses_of(runs["with"], 1), poses_of(runs["without"], 1))


# ---- as a batch


@torch.no_grad()
def lost_boxes():
    """A tracker of four boxes in streams of their own, which are ten degrees off, and two of them very uncertain; their state, and a window."""
    streams = [moving_box(pose(), 4, seed=s, stream=s)[1] for s in range(4)]
    batches = [(concatenate([stream.slice_time(k * WINDOW_US, (k + 1) * WINDOW_US) for stream in streams]), (k + 1) * WINDOW_US) for k in range(4)]
    config = TrackerConfig(relocalization=RelocalizationConfig(interval_us=0, new_below=0))
    tracker = Tracker([box_model()] * 4, [SMALL_CAMERA] * 4, config, stream_index=[0, 1, 2, 3], dtype=torch.float64)
    state, _ = follow(tracker, tracker.init(pose()[None].repeat(4, 1, 1), 0), batches[:3])
    T_cam_obj = retract_about(state.T_cam_obj, DISPLACED * torch.tensor([[1.0], [-1.0], [1.3], [0.9]]).double(), tracker.centre_obj.double())
    uncertain = torch.tensor([1e2, 1e4, 1e2, 1e4])[:, None, None] * state.motion.covariance
    return tracker, changed(state, T_cam_obj=T_cam_obj, covariance=uncertain, confirmations=torch.full((4,), 9.0)), batches[3]


@torch.no_grad()
def looked_for_together(tracker, state, window, together, monkeypatch):
    """The result of a window in which so many objects are tried together, and how many were."""
    sizes = []
    monkeypatch.setattr(f"{LOOP}._TOGETHER", together)
    monkeypatch.setattr(f"{LOOP}.refined", lambda hypotheses, lost: sizes.append(len(lost.numbers)) or refine.refined(hypotheses, lost))
    return tracker.step(state, *window)[1], sizes


@pytest.mark.parametrize("kernels", [True, False])
def test_objects_that_are_tried_together_are_found_as_each_alone(kernels, monkeypatch):
    tracker, state, window = lost_boxes()
    with backend(wanted=kernels):
        alone, sizes = looked_for_together(tracker, state, window, 1, monkeypatch)
        assert sizes == [1, 1, 1, 1]
        together, sizes = looked_for_together(tracker, state, window, 8, monkeypatch)
    # What hardly anything is known of is tried apart.
    assert sizes == [2, 2]
    torch.testing.assert_close(together.T_cam_obj, alone.T_cam_obj, rtol=0, atol=1e-7)
    torch.testing.assert_close(together.quality, alone.quality, rtol=0, atol=1e-6)
    assert torch.equal(together.status, alone.status) and float((together.T_cam_obj - state.T_cam_obj).abs().amax((1, 2)).min()) > 1e-2


@pytest.mark.parametrize("sampler", ["sample_near", "sample_anywhere"])
@pytest.mark.parametrize("kernels", [True, False])
def test_hypotheses_that_are_no_numbers_spoil_no_other_that_is_tried_with_them(kernels, sampler, monkeypatch):
    """Of the two that are tried together, the first one's."""
    tracker, state, window = lost_boxes()
    whole = getattr(hypotheses, sampler)
    first = torch.arange(tracker.config.relocalization.hypotheses)
    with backend(wanted=kernels):
        expected, _ = looked_for_together(tracker, state, window, 8, monkeypatch)
        monkeypatch.setattr(hypotheses, sampler, lambda *given: whole(*given).index_fill(0, first, torch.nan))
        spoilt, sizes = looked_for_together(tracker, state, window, 8, monkeypatch)
    assert sizes == [2, 2]
    number = 0 if sampler == "sample_near" else 1
    others = [other for other in range(4) if other != number]
    torch.testing.assert_close(spoilt.T_cam_obj[others], expected.T_cam_obj[others], rtol=0, atol=1e-7)
    assert torch.equal(spoilt.status[others], expected.status[others])
    assert torch.isfinite(spoilt.T_cam_obj).all() and not torch.equal(spoilt.T_cam_obj[number], expected.T_cam_obj[number])


@torch.no_grad()
def test_the_work_of_a_window_is_bounded_however_many_are_lost(monkeypatch):
    """Of four that are lost, one is looked for in a window, each in its turn, by as many hypotheses as one that is lost alone."""
    aligned = []
    whole = refine.refined
    monkeypatch.setattr(
        "torchtrack.tracking.relocalization.relocalize.refined",
        lambda hypotheses, lost: aligned.append((*lost.numbers, len(hypotheses.offsets))) or whole(hypotheses, lost),
    )
    _, events = moving_box(pose(), 8)
    config = TrackerConfig(relocalization=RelocalizationConfig(interval_us=0, new_below=0, objects=1))
    tracker = Tracker([box_model()] * 4, SMALL_CAMERA, config)
    state, _ = follow(tracker, tracker.init(pose()[None].repeat(4, 1, 1), 0), windows(events, 3))
    work, looks = [], torch.zeros(4, dtype=torch.int64)
    for batch, end_us in windows(events, 5, 3 * WINDOW_US):
        aligned.clear()
        # Lost before every window, whatever the last one gave; and once confirmed.
        lost = changed(state, covariance=1e3 * state.motion.covariance, confirmations=torch.full((4,), 9.0))
        state, _ = tracker.step(replace(lost, health=replace(lost.health, looks=looks)), batch, end_us)
        looked_for = {number for number, _ in aligned}
        assert len(looked_for) == 1
        looks = looks + torch.tensor([number in looked_for for number in range(4)])
        work.append(sum(count for _, count in aligned))
    assert sorted(looks.tolist()) == [1, 1, 1, 2]
    assert len(set(work)) == 1


@pytest.mark.parametrize(("count", "times"), [(0, 0), (29, 0), (200, 1)])
@torch.no_grad()
def test_without_enough_events_there_is_nothing_to_search_in(count, times, monkeypatch):
    searched = []
    # The look at its rivals is made at its start.
    tracker, state, _, _, _ = started(config=TrackerConfig(relocalization=RelocalizationConfig(interval_us=0, new_below=0)))
    monkeypatch.setattr(f"{LOOP}._tried", lambda lost, *_: searched.extend(lost.numbers) or lost.window)
    noise = random_events(count, width=200, height=150, duration_us=WINDOW_US)
    after, result = tracker.step(changed(state, covariance=1e3 * state.motion.covariance), replace(noise, t_us=noise.t_us + 25_000), 30_000)
    assert len(searched) == times
    assert count > 0 or Status(int(result.status)) == Status.TOO_FEW_EVENTS
    assert torch.isfinite(after.motion.covariance).all()
