"""What is asked of another pose to take the place of an object's own: in general, and by each test."""

from dataclasses import replace

import pytest
import torch
from lost_objects import acceptance_test, evidence, lost_object, searched
from tracked_boxes import in_motion

from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.relocalization import acceptance
from torchtrack.tracking.relocalization.acceptance import AcceptanceTest, is_contradicted, is_likely, likeliest
from torchtrack.tracking.relocalization.triggers import Trigger, triggered

CONFIG = TrackerConfig()
# Ten degrees and some millimetres: edges are several pixels off, farther than the tight gate reaches.
DISPLACED = torch.tensor([[0.09, -0.06, 0.12, 0.008, -0.006, 0.0]], dtype=torch.float64)


# ---- a test


def scored_as(score, inlier_ratio, count):
    """Fits of some poses, so good."""
    scored = in_motion()[3]
    rows = len(score)
    values = {"measured_ratio": torch.tensor(score), "inlier_ratio": torch.tensor(inlier_ratio), "count": torch.tensor(count)}
    return replace(scored, **values, ratio_at_rest=torch.zeros(rows), reference_inlier_ratio=torch.zeros(rows))


def test_a_pose_passes_that_matches_enough_events_which_gather_enough():
    tried = scored_as([0.9] * 5, [0.6, 0.4, torch.nan, 0.6, 0.6], [100, 100, 100, 99, 29])
    passed = acceptance_test(min_inlier_ratio=0.5, min_matches=100.0).is_passed(tried, CONFIG)
    assert passed.tolist() == [True, False, True, False, False]
    # Never by fewer than any fit needs.
    assert acceptance_test().is_passed(tried, CONFIG).tolist() == [True, True, True, True, False]


def test_the_score_to_surpass_is_better_than_ones_own_by_the_margin_and_no_less_than_the_least():
    own = scored_as([0.5, 0.7, 0.5], [torch.nan] * 3, [100, 100, 10])
    test = AcceptanceTest(torch.full((3,), 0.1), torch.full((3,), 0.65), torch.zeros(3), torch.zeros(3))
    # Of a fit by too few events nothing counts.
    assert test.asked_score(own.count, own.score, CONFIG).tolist() == pytest.approx([0.65, 0.8, 0.65])


def test_rows_are_the_test_of_some_objects():
    test = AcceptanceTest(*torch.arange(12.0).view(4, 3).unbind(0)).rows(torch.tensor([2, 1]))
    assert [value.tolist() for value in vars(test).values()] == [[2.0, 1.0], [5.0, 4.0], [8.0, 7.0], [11.0, 10.0]]


def test_of_poses_that_explain_as_much_the_most_expected_is_taken():
    """Turns of a vase about its axis all explain the same: the best of them by a hair is chance."""
    from_prior = torch.zeros(4, 12)
    from_prior[:, 1] = torch.tensor([0.5, 0.01, 0.0, 0.3])
    share, covariance = torch.tensor([0.9, 0.89, 0.6, 0.885]), 1e-2 * torch.eye(12, dtype=torch.float64)[None]
    assert likeliest(share, from_prior, covariance).tolist() == [1]
    assert likeliest(share, from_prior.index_fill(0, torch.tensor([1]), torch.nan), covariance).tolist() == [3]
    assert likeliest(torch.tensor([0.9, 0.8, 0.6, 0.0]), from_prior, covariance).tolist() == [0]


def test_what_a_prediction_does_not_allow_is_not_likely():
    """In standard deviations; what is not a number is none."""
    offsets = torch.zeros(5, 12)
    offsets[1, 0], offsets[2, 0], offsets[3, :6], offsets[4, 2] = 0.4, 0.42, 0.18, torch.nan
    assert is_likely(offsets, 1e-2 * torch.eye(12, dtype=torch.float64)[None]).tolist() == [True, True, False, False, False]
    wide = torch.full((1, 12), 5.0)
    assert is_likely(torch.cat([offsets[:1], wide]), 25.0 * torch.eye(12, dtype=torch.float64)[None]).tolist() == [True, True]


def test_events_on_texture_contradict_poses_where_they_agree_at_the_objects_own():
    tried = replace(scored_as([0.9] * 3, [torch.nan] * 3, [100] * 3), texture_agreement=torch.tensor([0.5, 0.9, torch.nan]))
    assert is_contradicted(tried, torch.tensor([0.9])).tolist() == [True, False, False]
    for own_agreement in (0.5, torch.nan):
        assert not is_contradicted(tried, torch.tensor([own_agreement])).any()


# ---- what it leaves


def test_what_is_no_better_by_the_margin_is_left():
    tracker, prediction, seen, scored, _ = in_motion()
    assert float(scored.explained_ratio) > 0.7
    assert searched(lost_object(tracker, prediction, seen, scored, 1.0)) is scored


def test_what_explains_too_little_for_being_far_away_is_left():
    tracker, prediction, seen, scored, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    assert searched(lost_object(tracker, prediction, seen, scored, 8.0), acceptance_test(min_score=1.1)) is scored
    better = searched(lost_object(tracker, prediction, seen, scored, 8.0))
    assert better.is_relocalized.tolist() == [True] and scored.is_relocalized.tolist() == [False]


@pytest.mark.parametrize("inlier_ratio", [0.3, torch.nan])
def test_what_smears_events_more_than_it_may_is_left(inlier_ratio):
    """Where it cannot be told how far events gather, nothing speaks against a pose."""
    tracker, prediction, seen, scored, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    assert searched(lost_object(tracker, prediction, seen, scored, 8.0), acceptance_test(min_inlier_ratio=1.01)) is scored
    better = searched(lost_object(tracker, prediction, seen, scored, 8.0), acceptance_test(min_inlier_ratio=inlier_ratio))
    assert better.is_relocalized.tolist() == [True]
    assert float(better.inlier_ratio) > 0.3


@pytest.mark.parametrize(("own_agreement", "is_left"), [(0.9, True), (0.5, False)])
def test_what_texture_contradicts_is_left(own_agreement, is_left, monkeypatch):
    tracker, prediction, seen, scored, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    scored = replace(scored, texture_agreement=torch.full_like(scored.texture_agreement, own_agreement))
    low = lambda tried: replace(tried, texture_agreement=torch.full_like(tried.texture_agreement, 0.3))  # noqa: E731
    monkeypatch.setattr(acceptance, "is_contradicted", lambda tried, own: is_contradicted(low(tried), own))
    assert (searched(lost_object(tracker, prediction, seen, scored, 8.0)) is scored) == is_left


def test_what_explains_too_few_events_is_left():
    tracker, prediction, seen, scored, _ = in_motion(displaced=DISPLACED)
    prediction = replace(prediction, covariance=1e2 * prediction.covariance)
    better = searched(lost_object(tracker, prediction, seen, scored, 8.0))
    many = float(better.count)
    assert searched(lost_object(tracker, prediction, seen, scored, 8.0), acceptance_test(min_matches=many)).is_relocalized.tolist() == [True]
    assert searched(lost_object(tracker, prediction, seen, scored, 8.0), acceptance_test(min_matches=2 * many)) is scored


# ---- the test of each source


def asked_by(test, given, scored=None):
    """What a test asks for of a single object."""
    scored = scored or in_motion()[3]
    return torch.stack(list(vars(test(triggered(given, CONFIG), scored, CONFIG)).values()))[:, 0], scored


SLOWLY = {"is_drift_due": True, "time_since_validated_s": 0.2, "last_score": 0.5, "score": 0.5, "reference_explained_ratio": 0.8}


def test_what_drifts_slowly_has_to_explain_nearly_all_elsewhere_and_by_no_fewer_events():
    given = evidence(**SLOWLY)
    asked, scored = asked_by(acceptance.near_prediction, given)
    torch.testing.assert_close(asked, torch.tensor([0.15, 0.72, 0.0, float(scored.count)]))


def test_what_is_where_it_is_predicted_gives_way_to_what_is_better_by_the_margin():
    torch.testing.assert_close(asked_by(acceptance.near_prediction, evidence(sigma_px=5.0))[0], torch.tensor([0.1, 0.0, 0.0, 0.0]))


def test_what_drifts_has_to_explain_about_as_much_as_usual_far_away():
    given = evidence(is_drift_due=True, drift_s=0.2)
    torch.testing.assert_close(asked_by(acceptance.near_prediction, given)[0], torch.tensor([0.1, 0.65 * 0.9, 0.0, 0.0]))


def test_a_new_object_has_to_be_explained_nearly_all_with_events_that_gather_no_less():
    given = evidence(is_due=True, reference_explained_ratio=0.5, score=0.8, last_score=0.8, mean_score=0.8)
    assert triggered(given, CONFIG).triggers.tolist() == [Trigger.NEW]
    asked, scored = asked_by(acceptance.near_prediction, given)
    torch.testing.assert_close(asked, torch.tensor([0.1, 0.9, float(scored.inlier_ratio) - 0.02, 0.0]))


def test_while_a_motion_is_not_known_other_poses_must_not_smear_events_more():
    """Of any two poses, dense texture explains about as much."""
    starting = evidence(is_starting=True)
    asked, scored = asked_by(acceptance.near_prediction, starting)
    assert 0.5 < float(asked[2]) < float(scored.inlier_ratio) < float(asked[2]) + 0.05
    assert float(asked[0]) == pytest.approx(0.02)
    assert float(asked_by(acceptance.near_prediction, evidence(sigma_px=5.0))[0][2]) == 0
    unknown = replace(scored, inlier_ratio=torch.full((1,), torch.nan))
    assert float(asked_by(acceptance.near_prediction, starting, unknown)[0][2]) <= 0


@pytest.mark.parametrize("also", [Trigger(0), Trigger.FAR_BELOW_REFERENCE])
def test_what_changed_its_depth_gives_way_to_far_more_events(also):
    asked, scored = asked_by(acceptance.around_last_seen, evidence(triggers=int(Trigger.DEPTH_CHANGED | also)))
    assert float(asked[0]) == -torch.inf and float(asked[2]) == 0
    assert float(asked[1]) == pytest.approx(0.75 * 0.9)
    assert float(asked[3]) == 2 * float(scored.count)


def test_what_is_far_below_its_reference_gives_way_to_nearly_all_by_no_fewer_events():
    asked, scored = asked_by(acceptance.around_last_seen, evidence(triggers=int(Trigger.FAR_BELOW_REFERENCE)))
    torch.testing.assert_close(asked, torch.tensor([0.15, 0.81, 0.0, float(scored.count)]))
