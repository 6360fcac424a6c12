"""Rivals of a pose that is about to be confirmed: what they have to explain, and that starts that are off give way to the truth."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose, pose_errors
from lost_objects import evidence, lost_object
from tracked_boxes import follow, in_motion, moving_box, scene_of_one_stream, started, windows

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.lie import retract_about
from torchtrack.tracking.relocalization.acceptance import Choice
from torchtrack.tracking.relocalization.hypotheses import Hypotheses
from torchtrack.tracking.relocalization.relocalize import relocalize
from torchtrack.tracking.relocalization.rivals import FarMore, explains_far_more, turned, turned_far
from torchtrack.tracking.relocalization.triggers import Trigger
from torchtrack.tracking.validation.status import Status
from torchtrack.tracking.validation.verdict import AGREES_FROM

LOOP = "torchtrack.tracking.relocalization.relocalize"
UNCHECKED = TrackerConfig(disabled={Component.UNCONFIRMED})
# The prediction is off by so much, and the solver has settled there.
TURNED = torch.tensor([[0.35, -0.25, 0.4, 0.0, 0.0, 0.0]], dtype=torch.float64)


# ---- what is asked of them


def chosen(rivals, from_prior_rad=0.1, agreements=(torch.nan, torch.nan)):
    """Whether one of some rivals takes the place of a pose that explains 0.7 by 400 events, of which 0.6 gather, and which.

    Args:
        agreements: of events on the texture of that pose, and of the rivals.
    """
    tracker, prediction, seen, scored, _ = in_motion()
    own = replace(scored, measured_ratio=torch.tensor([0.7]), count=torch.tensor([400]), inlier_ratio=torch.tensor([0.6]))
    own = replace(own, texture_agreement=torch.tensor([agreements[0]]))
    lost = lost_object(tracker, prediction, seen, replace(own, reference_inlier_ratio=torch.zeros(1)), 1.0)
    share, count, inliers = (torch.tensor(values) for values in zip(*rivals, strict=True))
    rows = len(rivals)
    offsets = torch.zeros(rows, 12)
    offsets[:, 0] = from_prior_rad
    agreement = torch.full_like(share, agreements[1])
    values = {"measured_ratio": share, "count": count, "inlier_ratio": inliers, "texture_agreement": agreement}
    tried = replace(scored, **values, ratio_at_rest=torch.zeros(rows), reference_inlier_ratio=torch.zeros(rows))
    tried = replace(tried, fit=replace(tried.fit, solution=replace(tried.fit.solution, from_prior=offsets)))
    covariance = turned(prediction, tracker.config).covariance
    hypotheses = Hypotheses(prediction, offsets, covariance, (seen.pixels, seen.mask), is_wide=True)
    choice = explains_far_more(evidence(), own, tracker.config).rows(lost.rows).choose(tried, hypotheses, lost)
    return int(choice.row), bool(choice.is_accepted)


@pytest.mark.parametrize(
    ("rival", "accepted"),
    [
        ((0.9, 500, 0.7), True),
        # 1.5 times as much
        ((0.84, 480, 0.625), False),
        # far more of one, less of another
        ((0.95, 390, 0.9), False),
        ((0.69, 900, 0.9), False),
        ((0.95, 900, 0.59), False),
        # as much of two is no less
        ((0.95, 480, 0.6), True),
        ((1.0, 400, 0.72), True),
        ((0.7, 700, 0.6), True),
        ((torch.nan, 900, 0.9), False),
        ((0.9, 900, torch.nan), False),
    ],
)
def test_a_rival_explains_more_by_more_events_that_gather_more(rival, accepted):
    assert chosen([rival])[1] is accepted


def test_the_rival_that_explains_most_of_all_three_is_taken():
    assert chosen([(0.95, 500, 0.65), (0.9, 700, 0.8), (1.0, 300, 0.9)]) == (1, True)


@pytest.mark.parametrize(
    ("own", "rival", "accepted"),
    [
        (AGREES_FROM - 0.01, 0.95, True),
        (AGREES_FROM - 0.01, torch.nan, True),
        (AGREES_FROM - 0.01, AGREES_FROM - 0.01, False),
        (AGREES_FROM + 0.01, 0.95, False),
        (torch.nan, 0.95, False),
    ],
)
def test_what_texture_contradicts_gives_way_to_what_is_as_good_and_is_not_contradicted(own, rival, accepted):
    assert chosen([(0.69, 395, 0.59)], agreements=(own, rival))[1] is accepted
    assert not chosen([(0.6, 395, 0.6)], agreements=(own, rival))[1]


def test_a_rival_that_texture_contradicts_is_none_however_much_it_explains():
    assert chosen([(0.95, 900, 0.9)], agreements=(0.95, 0.95))[1]
    assert not chosen([(0.95, 900, 0.9)], agreements=(0.95, 0.5))[1]


def test_a_rival_is_where_what_was_turned_wrong_may_be():
    assert chosen([(0.95, 500, 0.9)], from_prior_rad=2.0)[1] and not chosen([(0.95, 500, 0.9)], from_prior_rad=2.2)[1]


def test_of_a_pose_of_which_it_is_not_known_how_far_events_gather_nothing_is_better():
    tracker, prediction, seen, scored, _ = in_motion()
    unknown = replace(scored, inlier_ratio=torch.full((1,), torch.nan))
    lost = lost_object(tracker, prediction, seen, unknown, 1.0)
    hypotheses = turned_far(lost)
    tried = replace(scored, count=scored.count * 9)
    choice = explains_far_more(evidence(), unknown, tracker.config).choose(tried, hypotheses, lost)
    assert choice.is_accepted.tolist() == [False]


# ---- where they are looked for


def test_they_are_turned_tens_of_degrees_and_moved_little():
    tracker, prediction, seen, scored, _ = in_motion()
    sigma = turned(prediction, tracker.config).covariance[0].diagonal().sqrt()
    depth_m = float(prediction.objects.depth_m(prediction.T_cam_obj))
    expected = [0.5] * 3 + [0.1 * float(tracker.diameter_m)] * 2 + [0.05 * depth_m]
    assert sigma[:6].tolist() == pytest.approx(expected, rel=1e-5)
    hypotheses = turned_far(lost_object(tracker, prediction, seen, scored, 1.0))
    assert len(hypotheses.offsets) == tracker.config.relocalization.hypotheses and hypotheses.replaces_prediction
    assert hypotheses.offsets[0].abs().max() == 0


def looked_at(displaced):
    """The window of a box whose pose may be off, with a look at rivals; and the true pose."""
    tracker, prediction, seen, scored, T_true = in_motion(displaced=displaced)
    lost = lost_object(tracker, prediction, seen, scored, 1.0)
    flags = torch.tensor([int(Trigger.UNCONFIRMED)])
    return scored, relocalize(lost.window, evidence(triggers=flags), seen, lost.last_seen, tracker.config), T_true


def test_a_pose_that_is_tens_of_degrees_off_gives_way_to_the_truth():
    scored, after, T_true = looked_at(TURNED)
    assert float(pose_errors(scored.fit.solution.T_cam_obj.double(), T_true)[0]) > 20
    assert after.scored.is_relocalized.tolist() == after.looked.tolist() == [True]
    assert float(pose_errors(after.scored.fit.solution.T_cam_obj.double(), T_true)[0]) < 2


def test_a_right_pose_stays_as_it_is_bit_for_bit():
    scored, after, _ = looked_at(None)
    assert after.scored is scored and after.looked.tolist() == [True]


# ---- in the tracker


def statuses(config, count=8, turned_by=None):
    trajectory, events = moving_box(pose(), count)
    tracker = Tracker([box_model()], SMALL_CAMERA, config)
    start = pose()[None]
    if turned_by is not None:
        start = retract_about(start, turned_by, tracker.centre_obj.double())
    _, results = follow(tracker, tracker.init(start, 0), windows(events, count))
    return results, trajectory


def test_a_right_start_is_confirmed_as_soon_as_without_the_look_and_poses_are_the_same():
    (looked, _), (unlooked, _) = statuses(TrackerConfig()), statuses(UNCHECKED)
    assert [int(result.status) for result in looked] == [int(result.status) for result in unlooked]
    assert Status.UNCERTAIN in [int(result.status) for result in looked[:2]] and int(looked[-1].status) == Status.TRACKING
    for ours, theirs in zip(looked, unlooked, strict=True):
        assert torch.equal(ours.T_cam_obj, theirs.T_cam_obj)


def test_one_look_is_made_for_a_start(monkeypatch):
    looks = []
    monkeypatch.setattr(f"{LOOP}._tried", lambda lost, source, test: looks.append(source.triggers) or lost.window)
    statuses(TrackerConfig())
    assert looks.count(Trigger.UNCONFIRMED) == 1


def test_what_takes_its_place_has_to_be_confirmed_itself(monkeypatch):
    tracker, state, _, window, _ = started()
    monkeypatch.setattr(FarMore, "choose", lambda *_: Choice(torch.tensor([0]), torch.tensor([True])))
    state = replace(state, health=replace(state.health, confirmations=torch.tensor([2.0])))
    after, result = tracker.step(state, *window)
    assert int(result.status) == Status.UNCERTAIN and float(after.health.confirmations) == 0


def test_where_many_start_at_once_each_waits_for_its_look():
    starts, stream_index, cameras, cut = scene_of_one_stream(8)
    config = TrackerConfig(relocalization=RelocalizationConfig(objects=1))
    tracker = Tracker([box_model()] * 2, cameras, config, stream_index=stream_index)
    _, results = follow(tracker, tracker.init(torch.stack(starts), 0), cut)
    tracking = torch.stack([result.status == int(Status.TRACKING) for result in results])
    first = [int(of_one.nonzero()[0]) for of_one in tracking.T]
    assert abs(first[0] - first[1]) == 1 and tracking[-1].all()
