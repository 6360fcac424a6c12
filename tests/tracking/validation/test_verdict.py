"""Statuses one by one, how far a pose is trusted, and what is remembered; and the same source compiled for numbers."""

import math

import pytest
import torch

from torchtrack.config.components import Component
from torchtrack.config.tracker import AssociationConfig, CornerConfig, TrackerConfig
from torchtrack.config.validation import ValidationConfig
from torchtrack.tracking.validation import verdict as rules
from torchtrack.tracking.validation.status import Status
from torchtrack.tracking.validation.verdict import (
    AGREES_FROM,
    STILL_AGREES_FROM,
    Limits,
    Measured,
    References,
    judge,
    needed_ratio,
    partly_hidden,
    smeared,
    trust,
)

NOTHING_HIDDEN = torch.zeros(1)


def limits(**settings):
    return Limits.from_config(TrackerConfig(validation=ValidationConfig(**settings)))


def measured(**values):
    """Of objects that are seen well, but for what is given."""
    usual = Measured(1.0, 1.0, 0.8, 0.8, 1.0, 1.0, 1.0, 0.0, 0.0, 100, 120, True, True, False)
    given = {name: torch.as_tensor(value).reshape(-1) for name, value in usual._replace(**values)._asdict().items()}
    longest = max(len(value) for value in given.values())
    return Measured(**{name: value.expand(longest) for name, value in given.items()})


def status_of(settings=None, **values):
    return Status(int(judge(measured(**values), NOTHING_HIDDEN, limits(**settings or {}))))


# ---- statuses


def test_a_good_pose_is_tracking():
    assert status_of() == Status.TRACKING


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"explained_ratio": 0.39}, Status.UNCERTAIN),
        ({"explained_ratio": 0.4}, Status.TRACKING),
        ({"explained_ratio": 0.09}, Status.LOST),
        ({"explained_ratio": 0.2}, Status.UNCERTAIN),
        ({"explained_ratio": 0.0}, Status.LOST),
        ({"matched": 29}, Status.TOO_FEW_EVENTS),
        ({"matched": 30}, Status.TRACKING),
        ({"matched": 0}, Status.TOO_FEW_EVENTS),
        ({"in_view": 0.19}, Status.OUT_OF_VIEW),
        ({"in_view": 0.2}, Status.TRACKING),
        ({"rotated_rad": 0.51}, Status.DIVERGED),
        ({"rotated_rad": 0.49}, Status.TRACKING),
        ({"moved_diameters": 0.51}, Status.DIVERGED),
        ({"moved_diameters": 0.49}, Status.TRACKING),
        ({"rotated_rad": float("nan")}, Status.DIVERGED),
        ({"moved_diameters": float("inf")}, Status.DIVERGED),
    ],
    ids=lambda value: value.name if isinstance(value, Status) else "-".join(f"{k}={v}" for k, v in value.items()),
)
def test_each_reason_has_its_status(change, expected):
    assert status_of(**change) == expected


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"explained_ratio": 0.0, "matched": 0}, Status.TOO_FEW_EVENTS),
        ({"explained_ratio": 0.0, "matched": 0, "in_view": 0.0}, Status.OUT_OF_VIEW),
        ({"explained_ratio": 0.0, "matched": 0, "in_view": 0.0, "rotated_rad": 1.0}, Status.DIVERGED),
    ],
)
def test_the_gravest_reason_is_told(change, expected):
    assert status_of(**change) == expected


def test_thresholds_are_those_of_the_settings():
    asked = {"min_observations": 200, "uncertain_below": 0.9, "lost_below": 0.8, "min_visible_ratio": 0.7, "max_rotation_rad": 0.1}
    assert status_of(asked, matched=150) == Status.TOO_FEW_EVENTS
    assert status_of(asked, matched=250, explained_ratio=0.85) == Status.UNCERTAIN
    assert status_of(asked, matched=250, explained_ratio=0.75) == Status.LOST
    assert status_of(asked, matched=250, in_view=0.6) == Status.OUT_OF_VIEW
    assert status_of(asked, matched=250, rotated_rad=0.2) == Status.DIVERGED


def test_what_has_no_prediction_before_the_camera_has_diverged():
    assert status_of(is_usable=False) == Status.DIVERGED


def test_objects_are_judged_each_for_itself():
    status = judge(measured(explained_ratio=[1.0, 0.3, 0.0, 1.0], matched=[100, 100, 100, 3]), torch.zeros(4), limits())
    assert status.tolist() == [Status.TRACKING, Status.UNCERTAIN, Status.LOST, Status.TOO_FEW_EVENTS]


@pytest.mark.parametrize(("gate_scale", "expected"), [(1.0, Status.UNCERTAIN), (1.5, Status.UNCERTAIN), (1.75, Status.LOST), (3.0, Status.LOST)])
def test_more_is_asked_of_an_object_that_was_looked_for_in_more_places(gate_scale, expected):
    """Between lost below 0.2 and found again from 0.35: 0.275 is needed at 1.5 times the gate, 0.3125 at 1.75, and no more than 0.35."""
    assert status_of({"lost_below": 0.2}, explained_ratio=0.3, gate_scale=gate_scale) == expected


def test_an_uncertain_object_may_be_found_farther_away():
    status = judge(measured(rotated_rad=0.8, gate_scale=[1.0, 2.0]), torch.zeros(2), limits())
    assert status.tolist() == [Status.DIVERGED, Status.TRACKING]


def test_a_new_pose_of_what_may_be_anywhere_is_no_jump_unless_it_is_not_a_number():
    status = judge(measured(rotated_rad=[2.0, 2.0, math.nan], gate_scale=[2.0, 1.9, 2.0], is_relocalized=True), torch.zeros(3), limits())
    assert status.tolist() == [Status.TRACKING, Status.DIVERGED, Status.DIVERGED]


# ---- how far a pose is trusted


def test_the_ratio_that_is_needed_rises_with_the_gate_to_its_limit():
    gate_scale = torch.tensor([1.0, 1.5, 2.0, 3.2])
    assert needed_ratio(gate_scale, torch.zeros(4), limits(lost_below=0.2)).tolist() == pytest.approx([0.2, 0.275, 0.35, 0.35])
    # A ratio to be caught at that is less than that of a lost one asks for nothing more.
    assert needed_ratio(gate_scale, torch.zeros(4), limits(lost_below=0.4)).tolist() == pytest.approx([0.4] * 4)


def test_trust_rises_from_lost_to_certain():
    explained = [0.0, 0.2, 0.3, 0.4, 1.0]
    actual = trust(measured(explained_ratio=explained), torch.ones(5), limits(lost_below=0.2, uncertain_below=0.4))
    assert actual.tolist() == pytest.approx([0, 0, 0.5, 1, 1])
    step = trust(measured(explained_ratio=[0.29, 0.31]), torch.ones(2), limits(lost_below=0.3, uncertain_below=0.3))
    assert step.tolist() == [0, 1]


def test_more_is_asked_of_finds_in_many_places_by_what_is_usual():
    seen = measured(explained_ratio=[0.4, 0.4, 0.6, 0.4], gate_scale=[1.0, 2.0, 3.0, 2.0])
    actual = trust(seen, torch.tensor([0.8, 0.8, 0.8, 0.2]), limits(lost_below=0.1, uncertain_below=0.4))
    assert actual.tolist() == pytest.approx([1.0, 0.6, 1.0, 1.0])


def hidden(inlier_ratio=0.8, usually=0.8, matched=200, elsewhere=False, asked=None):
    seen = measured(inlier_ratio=inlier_ratio, reference_inlier_ratio=usually, matched=matched, is_relocalized=elsewhere)
    return float(partly_hidden(seen, asked or limits()))


@pytest.mark.parametrize(("inlier_ratio", "expected"), [(0.0, 0), (0.64, 0), (0.7, 0.5), (0.76, 1), (1.0, 1), (math.nan, 0)])
def test_what_gathers_as_ever_counts_however_little_is_explained(inlier_ratio, expected):
    assert hidden(inlier_ratio) == pytest.approx(expected, abs=1e-6)


def test_nothing_counts_as_hidden_that_does_not_tell():
    # Found by a search, too few observations, hardly gathering when seen well, never seen well, switched off.
    assert hidden(elsewhere=True) == hidden(matched=100) == hidden(0.5, 0.5) == hidden(usually=0.0) == 0
    assert hidden(asked=Limits.from_config(TrackerConfig(disabled={Component.PARTLY_HIDDEN}))) == 0
    assert hidden(matched=30, asked=limits(min_observations=7)) == 1


def test_of_a_hidden_object_no_more_is_asked_in_more_places():
    asked = limits(lost_below=0.2)
    assert needed_ratio(torch.full((3,), 2.0), torch.tensor([0.0, 0.5, 1.0]), asked).tolist() == pytest.approx([0.35, 0.275, 0.2])
    status = judge(measured(explained_ratio=[0.3, 0.3], gate_scale=2.0), torch.tensor([0.0, 1.0]), asked)
    assert status.tolist() == [Status.LOST, Status.UNCERTAIN]


# ---- drift


def test_what_explains_much_less_than_when_seen_well_by_smeared_events_is_smeared():
    seen = measured(score=[0.5, 0.2, 0.0, 0.2, 0.5], inlier_ratio=0.6)
    assert smeared(seen, torch.tensor([0.9, 0.3, 0.0, 0.9, 0.9]), limits()).tolist() == [True, False, False, True, True]


def test_what_is_partly_hidden_is_not_smeared():
    """Less is explained, but what is seen gathers as ever; nor does it tell anything where too few events are seen."""
    assert not smeared(measured(score=0.3, inlier_ratio=[0.7, 0.9, math.nan]), torch.full((3,), 0.9), limits()).any()


# ---- poses that are not confirmed yet


def confirmed_after(windows, before=0.0, asked=None):
    """Confirmations after windows, each with what it measured."""
    asked, known = asked or limits(), torch.tensor([before])
    for values in windows:
        seen = measured(**values)
        judged = rules.verdict(seen, References(*torch.zeros(6, 1)), asked)
        known = rules.confirmations(known, seen, judged, asked)
    return float(known)


WELL, BARELY, BADLY = {"explained_ratio": 0.7}, {"explained_ratio": 0.55}, {"explained_ratio": 0.45}


@pytest.mark.parametrize(
    ("windows", "expected"),
    [
        ([WELL] * 3, 3),
        ([WELL] * 9, 3),
        ([WELL, WELL], 2),
        ([BARELY] * 9, 0),
        ([WELL, BARELY, WELL], 2),
        ([WELL, BADLY, WELL], 1),
        ([BADLY] * 5 + [WELL], 1),
        ([WELL] * 3 + [BADLY] * 9, 0),
        ([WELL, WELL, {"explained_ratio": 0.05}, WELL], 1),
        ([WELL, WELL, {"matched": 3}, WELL], 3),
        ([WELL] * 5 + [{"is_relocalized": True}], 0),
        ([{"is_moving": False}] * 9, 0),
    ],
)
def test_a_pose_is_confirmed_by_windows_that_explain_it(windows, expected):
    assert confirmed_after(windows) == expected


def test_a_pose_is_confirmed_by_a_look_at_others_and_not_before_windows_enough_speak_for_it():
    asked, before = limits(), torch.tensor([2.0, 3.0, 3.0, 4.0])
    after = rules.looked_elsewhere(before, torch.tensor([True, False, True, True]), asked)
    assert (after >= asked.confirmed_by).tolist() == [False, False, True, True]
    assert torch.equal(after[:2], before[:2])


def test_what_is_confirmed_stays_that_until_a_search_gives_another_pose():
    confirmed = limits().confirmed_by
    assert confirmed_after([BADLY] * 9 + [{"explained_ratio": 0.05}], confirmed) == confirmed
    assert confirmed_after([{"is_relocalized": True}], confirmed) == 0


@pytest.mark.parametrize(
    ("before", "agreement", "expected"),
    [
        (2.0, AGREES_FROM - 0.01, 0.0),
        (2.0, AGREES_FROM + 0.01, 3.0),
        (2.0, math.nan, 3.0),
        (4.0, AGREES_FROM - 0.01, 4.0),
        (4.0, STILL_AGREES_FROM - 0.01, 0.0),
        (4.0, math.nan, 4.0),
    ],
)
def test_a_pose_that_texture_contradicts_is_confirmed_anew_and_more_is_asked_to_contradict_a_confirmed_one(before, agreement, expected):
    assert confirmed_after([{"explained_ratio": 0.7, "texture_agreement": agreement}], before) == expected


@pytest.mark.parametrize(
    "settings",
    [
        {"disabled": ["unconfirmed"]},
        {"relocalization": {"hypotheses": 0}},
        {"solver": {"prior": False}},
    ],
)
def test_where_no_others_are_looked_at_windows_alone_confirm_a_pose(settings):
    asked = Limits.from_config(TrackerConfig.model_validate(settings))
    assert confirmed_after([WELL] * 3 + [BADLY] * 9, asked=asked) == asked.confirmed_by == 3


def test_of_corners_alone_no_contour_can_be_explained_and_no_pose_waits_for_that():
    asked = Limits.from_config(TrackerConfig(association=AssociationConfig(max_events=0), corners=CornerConfig(max_corners=9)))
    assert rules.confirmed_status(torch.tensor([Status.TRACKING]), torch.zeros(1), asked).tolist() == [Status.TRACKING]


def test_what_is_not_confirmed_is_uncertain_at_best():
    status = torch.tensor([Status.TRACKING, Status.TRACKING, Status.LOST, Status.UNCERTAIN])
    stated = rules.confirmed_status(status, torch.tensor([3.0, 4.0, 0.0, 4.0]), limits())
    assert stated.tolist() == [Status.UNCERTAIN, Status.TRACKING, Status.LOST, Status.UNCERTAIN]


def test_what_is_not_confirmed_is_not_remembered_as_seen_well():
    known = References(*torch.tensor([0.9, 0.9, 0.8, 0.0, 0.4, 0.0])[:, None].expand(6, 2))._replace(confirmations=torch.tensor([3.0, 4.0]))
    seen = measured(matched=torch.tensor([100, 100]))
    judged = rules.verdict(seen, known, limits())
    assert judged.is_certain.tolist() == [False, True]
    after = rules.remembered(known, seen, judged, torch.full((2,), 0.005), limits())
    assert after.time_since_validated_s.tolist() == pytest.approx([0.405, 0.0])


def test_what_a_search_gave_just_now_is_not_remembered_as_seen_well_by_what_spoke_for_the_pose_before():
    known = References(*torch.tensor([0.9, 0.9, 0.8, 0.0, 0.4, 4.0])[:, None].expand(6, 2))
    seen = measured(matched=torch.tensor([100, 100]), is_relocalized=torch.tensor([False, True]))
    assert rules.verdict(seen, known, limits()).is_certain.tolist() == [True, False]


# ---- what stays where it was


@pytest.mark.parametrize(("matched", "near", "held"), [(29, 29, True), (29, 30, False), (30, 30, False), (0, 0, True), (0, 400, False)])
def test_what_hardly_fires_rests_and_what_fires_elsewhere_does_not(matched, near, held):
    known = References(*torch.tensor([0.8, 0.8, 0.8, 0.0, 0.0, 4.0])[:, None])
    judged = rules.verdict(measured(matched=matched, near=near), known, limits())
    assert bool(judged.held) == held
    assert bool(judged.failed) == (matched < 30)


def test_what_is_out_of_view_does_not_rest():
    known = References(*torch.tensor([0.8, 0.8, 0.8, 0.0, 0.0, 4.0])[:, None])
    assert not rules.verdict(measured(matched=0, near=0, in_view=0.1), known, limits()).held


# ---- the whole, for tensors and for numbers


def random_cases(count=300):
    """Objects near and beyond every limit, and some of which something is not a number."""
    generator = torch.Generator().manual_seed(3)
    draw = lambda most=1.0: most * torch.rand(count, generator=generator, dtype=torch.float64)  # noqa: E731
    seen = Measured(
        *(draw() for _ in range(6)),
        1 + draw(2),
        draw(0.7),
        draw(0.7),
        *((200 * draw()).long() for _ in range(2)),
        *(draw() > threshold for threshold in (0.2, 0.1, 0.7)),
    )
    for values in (seen.inlier_ratio, seen.texture_agreement, seen.rotated_rad):
        values[torch.rand(count, generator=generator) < 0.1] = torch.nan
    return seen, References(*(draw(most) for most in (1, 1, 1, 0.1, 1, 6))), draw(0.02)


@pytest.mark.parametrize(
    "settings", [{}, {"disabled": ["partly_hidden"]}, {"validation": {"lost_below": 0.4}}, {"motion": {"without_events": "hold"}}]
)
def test_the_source_compiled_for_numbers_decides_as_for_tensors(settings):
    compiler = pytest.importorskip("torchtrack.backends.numba.compiler")
    names = "needed_ratio", "partly_hidden", "trust", "judge", "smeared", "verdict", "seen_well", "confirmations", "remembered"
    numbers = compiler.for_numbers(*(getattr(rules, name) for name in names))
    (seen, known, dt_s), asked = random_cases(), Limits.from_config(TrackerConfig.model_validate(settings))
    judged = rules.verdict(seen, known, asked)
    after = rules.remembered(known, seen, judged, dt_s, asked)
    assert len(judged.status.unique()) == len(Status)
    for number in range(len(dt_s)):
        row, before = Measured(*(value[number].item() for value in seen)), References(*(value[number].item() for value in known))
        alone = numbers["verdict"](row, before, asked)
        assert tuple(alone) == pytest.approx(tuple(value[number].item() for value in judged), abs=1e-12)
        expected = tuple(value[number].item() for value in after)
        assert tuple(numbers["remembered"](before, row, alone, dt_s[number].item(), asked)) == pytest.approx(expected, abs=1e-12)
