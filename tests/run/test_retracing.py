"""Objects followed back in time: nearer to the truth where they were lost, the same elsewhere, and without a change for their neighbours."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose
from states import changed
from tracked_boxes import WIDE_CAMERA, merged, moving_box, windows

from torchtrack import Tracker, preset
from torchtrack.config.tracker import SmoothingConfig, TrackerConfig
from torchtrack.core.lie import retract_about
from torchtrack.core.windows import EventWindow
from torchtrack.run import retrace
from torchtrack.run.refine import Refinement, refined_steps
from torchtrack.run.retrace import Retracer
from torchtrack.run.retracing import Gap, in_reverse, retraced
from torchtrack.run.runner import track
from torchtrack.run.smooth import SmoothedObjects
from torchtrack.run.stepping import Step
from torchtrack.tracking.validation.status import Status

COUNT, FIRST, SEEN = 24, 8, 20
# Off by some 5 degrees and 4 mm.
OFF = torch.tensor([0.06, -0.05, 0.04, 0.003, 0.002, 0.002], dtype=torch.float64)


def steps_of(tracker, starts, events):
    """The steps of a tracker, without maps."""
    state, taken = tracker.init(torch.stack(starts), 0), []
    with torch.inference_mode():
        for window, end_us in windows(events, COUNT):
            state, result = tracker.step(state, window, end_us)
            taken.append(Step(EventWindow(window, end_us - 5000, end_us), state.without_maps(), result, 0.0))
    return taken


def astray(step, number, tracker, *, lost=True, by=OFF):
    """The step with an object in a wrong place, and lost, or not seen well."""
    with torch.inference_mode():
        T_cam_obj = step.state.T_cam_obj.clone()
        rows = slice(number, number + 1)
        T_cam_obj[rows] = retract_about(T_cam_obj[rows], by[None], tracker.centre_obj[rows].double())
        status, score, unseen_s = step.result.status.clone(), step.state.health.score.clone(), step.state.health.time_since_validated_s.clone()
        status[number], score[number], unseen_s[number] = int(Status.LOST) if lost else int(Status.UNCERTAIN), 0.2, 0.05
        state = changed(step.state, T_cam_obj=T_cam_obj, score=score, time_since_validated_s=unseen_s)
        return replace(step, state=state, result=replace(step.result, T_cam_obj=T_cam_obj, status=status))


@pytest.fixture(scope="module", params=[torch.float32, torch.float64], ids=["float32", "float64"])
def followed(request):
    """A tracker of one box, its steps, and its true poses."""
    trajectory, events = moving_box(pose(), COUNT)
    tracker = Tracker([box_model()], SMALL_CAMERA, preset("causal"), dtype=request.param)
    return tracker, steps_of(tracker, [pose()], events), trajectory


@pytest.fixture(scope="module")
def two():
    """A tracker of two boxes in one stream, and its steps."""
    starts = [pose((0.5, 0.6, 0.1), (-0.17, 0.0, 0.5)), pose((0.4, -0.7, 0.3), (0.17, 0.0, 0.5))]
    events = merged(*(moving_box(start, COUNT, WIDE_CAMERA, seed=number)[1] for number, start in enumerate(starts)))
    tracker = Tracker([box_model()] * 2, WIDE_CAMERA, preset("causal"))
    return tracker, steps_of(tracker, starts, events)


def lost_for_a_while(steps, tracker, number=0):
    return [astray(step, number, tracker) if FIRST <= at < SEEN - 4 else step for at, step in enumerate(steps)]


def errors_m(steps, trajectory):
    true = trajectory.at(torch.tensor([step.window.t_end_us for step in steps]))
    T_estimated = torch.stack([step.result.T_cam_obj[0] for step in steps])
    # Of a point 5 cm beside the centre, so that turns count too.
    aside = torch.tensor([0.05, 0.05, 0.05, 1.0], dtype=torch.float64)
    return ((T_estimated - true) @ aside)[:, :3].norm(dim=-1)


def retracer_of(tracker, config):
    objects = SmoothedObjects(tracker.centre_obj.double(), tracker.diameter_m.double(), tracker.intrinsics.double())
    return Retracer(objects, config, tracker.alone)


RETRACED = TrackerConfig(smoothing=SmoothingConfig(retrace_s=0.06))


def test_a_window_in_reverse_is_one_of_the_other_end():
    _, events = moving_box(pose(), 2)
    window = EventWindow(events.slice_time(5000, 10_000), 5000, 10_000)
    reverse = in_reverse(window, 10_000)
    assert (reverse.t_us.diff() >= 0).all()
    assert int(reverse.t_us[0]) > 10_000
    assert int(reverse.t_us[-1]) <= 15_000
    assert torch.equal(reverse.polarity, ~window.events.polarity.flip(0))
    assert torch.equal(reverse.x, window.events.x.flip(0))
    assert torch.equal((20_001 - reverse.t_us).flip(0), window.events.t_us)


def test_an_object_is_followed_back_through_where_it_was_lost(followed):
    tracker, steps, trajectory = followed
    with torch.inference_mode():
        after = retraced(lost_for_a_while(steps, tracker), 0, Gap(FIRST, SEEN), tracker.alone(0))
    error_m = errors_m(after, trajectory)
    assert error_m[FIRST:SEEN].max() < 1e-3
    assert error_m[FIRST:SEEN].mean() < 1.5 * errors_m(steps, trajectory)[FIRST:SEEN].mean()
    for at, step in enumerate(after):
        assert (step is steps[at]) == (at < FIRST or at >= SEEN)
        assert torch.equal(step.state.T_cam_obj, step.result.T_cam_obj)
        assert int(step.result.status[0]) < int(Status.LOST)
        assert step.result.quality[0] > 0.5


def test_velocities_and_covariances_are_of_time_running_forwards(followed):
    tracker, steps, _ = followed
    with torch.inference_mode():
        after = retraced(lost_for_a_while(steps, tracker), 0, Gap(FIRST, SEEN), tracker.alone(0))
    torch.testing.assert_close(after[12].state.velocity, steps[12].state.velocity, rtol=0.2, atol=0.05)
    covariance, before = after[12].state.motion.covariance[0], steps[12].state.motion.covariance[0]
    assert torch.linalg.eigvalsh(covariance).min() > 0
    # What comes after a pose tells of it the other way than what came before: one that is found too far on is found too slow.
    along = [values[:6, 6:].diagonal().sign() for values in (covariance, before)]
    assert torch.equal(along[0], -along[1])


def test_contours_are_those_of_the_new_pose(followed):
    tracker, steps, _ = followed
    with torch.inference_mode():
        step = retraced(lost_for_a_while(steps, tracker), 0, Gap(FIRST, SEEN), tracker.alone(0))[12]
    contours, mask = step.result.contours, step.result.contours.mask[0]
    R, t = step.result.T_cam_obj[0, :3, :3], step.result.T_cam_obj[0, :3, 3]
    seen = contours.points_obj[0][mask].double() @ R.T + t
    torch.testing.assert_close(contours.points_cam[0][mask].double(), seen, rtol=0, atol=1e-5)


def test_where_it_was_not_lost_yet_a_pose_has_to_explain_clearly_more(followed):
    tracker, steps, trajectory = followed
    strayed = [astray(step, 0, tracker, lost=False) if 4 <= at < SEEN - 4 else step for at, step in enumerate(steps)]
    with torch.inference_mode():
        after = retraced(strayed, 0, Gap(12, SEEN), tracker.alone(0))
    assert errors_m(after, trajectory)[4:SEEN].max() < 1e-3
    assert all(after[at] is strayed[at] for at in (0, 1, 2, 3))


def hidden_for_a_while(steps, tracker, number=0, since=FIRST):
    """Lost, and without events in the middle of that."""
    lost = [astray(step, number, tracker) if since <= at < SEEN - 4 else step for at, step in enumerate(steps)]
    return [replace(step, window=replace(step.window, events=step.window.events[:0])) if 10 <= at < 15 else step for at, step in enumerate(lost)]


def test_while_it_is_hidden_it_is_on_its_way_and_stays_lost(followed):
    tracker, steps, trajectory = followed
    hidden = hidden_for_a_while(steps, tracker)
    with torch.inference_mode():
        after = retraced(hidden, 0, Gap(FIRST, SEEN), tracker.alone(0))
    assert all(after[at] is hidden[at] for at in (*range(FIRST), *range(SEEN, COUNT)))
    assert errors_m(after, trajectory)[FIRST:SEEN].max() < 1e-3 < errors_m(hidden, trajectory)[FIRST : SEEN - 4].min()
    lost = [int(step.result.status[0]) >= int(Status.LOST) for step in after]
    assert all(lost[FIRST:12]) and not any(lost[15:])
    for ours, theirs in zip(after[FIRST:12], hidden[FIRST:12], strict=True):
        assert torch.equal(ours.state.T_cam_obj, ours.result.T_cam_obj)
        assert torch.equal(ours.state.motion.covariance, theirs.state.motion.covariance)
    velocity = torch.stack([step.state.velocity[0] for step in after])
    torch.testing.assert_close(velocity[FIRST:12], velocity[FIRST - 1].expand(12 - FIRST, 6), rtol=0.3, atol=0.1)


def test_contours_of_what_is_hidden_are_where_it_is(followed):
    tracker, steps, _ = followed
    with torch.inference_mode():
        result = retraced(hidden_for_a_while(steps, tracker), 0, Gap(FIRST, SEEN), tracker.alone(0))[10].result
    R, t = result.T_cam_obj[0, :3, :3], result.T_cam_obj[0, :3, 3]
    torch.testing.assert_close(result.contours.points_cam[0].double(), result.contours.points_obj[0].double() @ R.T + t, rtol=0, atol=1e-5)


def test_what_was_lost_from_the_first_step_on_has_no_way(followed):
    tracker, steps, _ = followed
    hidden = hidden_for_a_while(steps, tracker, since=0)
    with torch.inference_mode():
        after = retraced(hidden, 0, Gap(0, SEEN), tracker.alone(0))
    assert all(after[at] is hidden[at] for at in range(12))


@pytest.mark.parametrize("hide", [lost_for_a_while, hidden_for_a_while])
@pytest.mark.parametrize("number", [0, 1])
def test_nothing_changes_for_its_neighbour(two, number, hide):
    tracker, steps = two
    lost = hide(steps, tracker, number)
    with torch.inference_mode():
        after = retraced(lost, number, Gap(FIRST, SEEN), tracker.alone(number))
    assert any(ours is not theirs for ours, theirs in zip(after, lost, strict=True))
    other = 1 - number
    for ours, theirs in zip(after, lost, strict=True):
        for name in ("T_cam_obj", "velocity", "covariance"):
            assert torch.equal(getattr(ours.state.motion, name)[other], getattr(theirs.state.motion, name)[other])
        assert torch.equal(ours.state.health.score[other], theirs.state.health.score[other])
        for name in ("T_cam_obj", "covariance", "status", "quality", "observation_count"):
            assert torch.equal(getattr(ours.result, name)[other], getattr(theirs.result, name)[other])
        mask = theirs.result.contours.mask[other]
        assert torch.equal(ours.result.contours.pixels[other][: len(mask)][mask], theirs.result.contours.pixels[other][mask])


def test_every_step_comes_once_and_in_order_and_the_lost_ones_with_better_poses(followed, monkeypatch):
    monkeypatch.setattr(retrace, "HIDDEN_FOR_S", 0.0)
    tracker, steps, trajectory = followed
    retracer, lost = retracer_of(tracker, RETRACED), lost_for_a_while(steps, tracker)
    given = [(at, due) for at, step in enumerate(lost) for due in retracer.add(step)]
    waited_us = [lost[at].window.t_end_us - due.window.t_end_us for at, due in given]
    assert min(waited_us) >= 60_000
    after = [due for _, due in given] + retracer.rest()
    assert [step.window.t_end_us for step in after] == [step.window.t_end_us for step in steps]
    assert retracer.rest() == []
    # Twelve windows are held: those at the start of the gap are gone by the time the object is seen well.
    assert errors_m(after, trajectory)[SEEN - 10 : SEEN].max() < 1e-3
    assert all(step.state.maps.last_event_us.numel() == 0 for step in after)


def test_the_way_of_what_was_hidden_reaches_farther_than_it_is_followed_back(followed):
    tracker, steps, trajectory = followed
    retracer = retracer_of(tracker, TrackerConfig(smoothing=SmoothingConfig(retrace_s=0.03)))
    after = [due for step in hidden_for_a_while(steps, tracker) for due in retracer.add(step)] + retracer.rest()
    lost = [int(step.result.status[0]) >= int(Status.LOST) for step in after]
    assert all(lost[FIRST:14]) and not any(lost[15:])
    assert errors_m(after, trajectory)[FIRST:SEEN].max() < 1e-3


def test_an_object_that_is_never_lost_stays_as_it_was(followed):
    tracker, steps, _ = followed
    steady = steps[6:]
    retracer = retracer_of(tracker, RETRACED)
    after = [due for step in steady for due in retracer.add(step)] + retracer.rest()
    assert all(torch.equal(ours.result.T_cam_obj, theirs.result.T_cam_obj) for ours, theirs in zip(after, steady, strict=True))


def test_one_that_is_not_seen_well_again_stays_lost(followed):
    tracker, steps, _ = followed
    lost = [astray(step, 0, tracker) if at >= FIRST else step for at, step in enumerate(steps)][6:]
    retracer = retracer_of(tracker, RETRACED)
    after = [due for step in lost for due in retracer.add(step)] + retracer.rest()
    assert all(torch.equal(ours.result.T_cam_obj, theirs.result.T_cam_obj) for ours, theirs in zip(after, lost, strict=True))


@pytest.mark.parametrize("count", [0, 1, 3])
def test_short_runs_come_whole(followed, count):
    tracker, steps, _ = followed
    config = TrackerConfig(smoothing=SmoothingConfig(lag_s=0.05, retrace_s=0.5))
    objects = SmoothedObjects(tracker.centre_obj.double(), tracker.diameter_m.double(), tracker.intrinsics.double())
    assert len(list(refined_steps(iter(steps[:count]), Refinement(objects, config, tracker.alone)))) == count


def test_a_tracker_of_one_object_alone_is_as_the_one_of_all(two):
    tracker, _ = two
    alone = tracker.alone(1)
    assert alone.object_names == tracker.object_names[1:]
    assert torch.equal(alone.intrinsics, tracker.intrinsics[1:])
    assert alone.config is tracker.config
    assert alone.kernels == tracker.kernels


def test_a_weigher_of_ones_own_judges_what_is_followed_back_too():
    weighting_network = torch.nn.Identity()
    assert Tracker([box_model()], SMALL_CAMERA, weighting_network=weighting_network).alone(0).weighting_network is weighting_network


def test_track_follows_objects_back_where_the_tracker_is_set_so():
    _, events = moving_box(pose(), 12)
    by_setting = {}
    for retrace_s in (0.0, 0.5):
        tracker = Tracker([box_model()], SMALL_CAMERA, TrackerConfig(smoothing=SmoothingConfig(retrace_s=retrace_s)))
        by_setting[retrace_s] = list(track([events], tracker, tracker.init(pose()[None], 0)))
    times = [[int(result.t_us[0]) for result in results] for results in by_setting.values()]
    assert times[0] == times[1]


def test_objects_are_followed_back_in_recordings_alone():
    assert {preset(name).smoothing.retrace_s for name in ("default", "learned", "guided", "nns")} == {0.5}
    assert {preset(name).smoothing.retrace_s for name in ("causal", "paper", "line", "ls")} == {0.0}


def test_what_has_no_filter_cannot_be_followed_back():
    with pytest.raises(ValueError, match="set smoothing.lag_s and smoothing.retrace_s to 0"):
        TrackerConfig.model_validate({"solver": {"prior": False}, "smoothing": {"retrace_s": 0.5}})
