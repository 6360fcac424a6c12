"""Statuses one by one, the explained ratio, what is in view, and how far a pose is trusted."""

import math

import pytest
import torch
from measured_matches import matches_at

from torchtrack.config.components import Component
from torchtrack.config.tracker import AssociationConfig, CornerConfig, TrackerConfig
from torchtrack.config.validation import ValidationConfig
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.validation.measures import explained_ratio, inlier_ratio, visible_ratio
from torchtrack.tracking.validation.status import Status, judge, needed_ratio, partly_hidden, trust

IMAGE_SIZE = (150, 200)
CONFIG, TRACKER = ValidationConfig(), TrackerConfig()

CORNERS_ALONE = TrackerConfig(corners=CornerConfig(max_corners=32), association=AssociationConfig(max_events=0))


def verdict(*, quality=1.0, count=100, in_view=1.0, rotated=0.0, moved=0.0, config=CONFIG):
    """Status of one object whose prediction was rotated by ``rotated`` rad and moved by ``moved`` diameters."""
    step = torch.tensor([[0.6 * rotated, 0.8 * rotated, 0.0, 0.0, 0.0, 0.2 * moved]])
    status = judge(torch.tensor([quality]), torch.tensor([count]), torch.tensor([in_view]), step, torch.tensor([0.2]), config)
    return Status(int(status))


def contours_at(pixels, normals=(1.0, 0.0), mask=None):
    pixels = torch.as_tensor(pixels, dtype=torch.float64)
    points = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1)
    mask = torch.ones(pixels.shape[:2], dtype=torch.bool) if mask is None else torch.as_tensor(mask)
    normals = torch.tensor(normals, dtype=torch.float64).expand_as(pixels)
    return Contours(points, torch.zeros_like(points), torch.full(mask.shape, int(ContourKind.CREASE)), mask, points, pixels, normals)


def upright_line(u=80.0, count=80, first=20.0):
    v = first + torch.arange(count, dtype=torch.float64)
    return torch.stack([torch.full_like(v, u), v], -1)[None]


def ratio(contours, matches, velocity=(100.0, 0.0), config=TRACKER):
    moving = torch.tensor(velocity, dtype=torch.float64).expand_as(contours.pixels)
    return explained_ratio(contours, matches, moving, IMAGE_SIZE, config)


# ---- statuses


def test_a_good_pose_is_tracking():
    assert verdict() == Status.TRACKING


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"quality": 0.39}, Status.UNCERTAIN),
        ({"quality": 0.4}, Status.TRACKING),
        ({"quality": 0.09}, Status.LOST),
        ({"quality": 0.2}, Status.UNCERTAIN),
        ({"quality": 0.0}, Status.LOST),
        ({"count": 29}, Status.TOO_FEW_EVENTS),
        ({"count": 30}, Status.TRACKING),
        ({"count": 0}, Status.TOO_FEW_EVENTS),
        ({"in_view": 0.19}, Status.OUT_OF_VIEW),
        ({"in_view": 0.2}, Status.TRACKING),
        ({"rotated": 0.51}, Status.DIVERGED),
        ({"rotated": 0.49}, Status.TRACKING),
        ({"moved": 0.51}, Status.DIVERGED),
        ({"moved": 0.49}, Status.TRACKING),
        ({"rotated": float("nan")}, Status.DIVERGED),
        ({"moved": float("inf")}, Status.DIVERGED),
    ],
    ids=lambda value: value.name if isinstance(value, Status) else "-".join(f"{k}={v}" for k, v in value.items()),
)
def test_each_reason_has_its_status(change, expected):
    assert verdict(**change) == expected


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"quality": 0.0, "count": 0}, Status.TOO_FEW_EVENTS),
        ({"quality": 0.0, "count": 0, "in_view": 0.0}, Status.OUT_OF_VIEW),
        ({"quality": 0.0, "count": 0, "in_view": 0.0, "rotated": 1.0}, Status.DIVERGED),
    ],
)
def test_the_gravest_reason_is_told(change, expected):
    assert verdict(**change) == expected


def test_thresholds_are_those_of_the_settings():
    config = ValidationConfig(min_observations=200, uncertain_below=0.9, lost_below=0.8, min_visible_ratio=0.7, max_rotation_rad=0.1)
    assert verdict(count=150, config=config) == Status.TOO_FEW_EVENTS
    assert verdict(count=250, quality=0.85, config=config) == Status.UNCERTAIN
    assert verdict(count=250, quality=0.75, config=config) == Status.LOST
    assert verdict(count=250, in_view=0.6, config=config) == Status.OUT_OF_VIEW
    assert verdict(count=250, rotated=0.2, config=config) == Status.DIVERGED


def test_objects_are_judged_each_for_itself():
    status = judge(
        torch.tensor([1.0, 0.3, 0.0, 1.0]), torch.tensor([100, 100, 100, 3]), torch.ones(4), torch.zeros(4, 6), torch.full((4,), 0.2), CONFIG
    )
    assert status.tolist() == [Status.TRACKING, Status.UNCERTAIN, Status.LOST, Status.TOO_FEW_EVENTS]


@pytest.mark.parametrize(("gate_scale", "expected"), [(1.0, Status.UNCERTAIN), (1.5, Status.UNCERTAIN), (1.75, Status.LOST), (3.0, Status.LOST)])
def test_more_is_asked_of_an_object_that_was_looked_for_in_more_places(gate_scale, expected):
    """Between lost below 0.2 and found again from 0.35: 0.275 is needed at 1.5 times the gate, 0.3125 at 1.75, and no more than 0.35."""
    config = ValidationConfig(lost_below=0.2)
    status = judge(*(torch.tensor(value) for value in ([0.3], [100], [1.0])), torch.zeros(1, 6), torch.ones(1), config, torch.tensor([gate_scale]))
    assert Status(int(status)) == expected


# ---- how far a pose is trusted


def test_the_ratio_that_is_needed_rises_with_the_gate_to_its_limit():
    gate_scale = torch.tensor([1.0, 1.5, 2.0, 3.2])
    assert needed_ratio(gate_scale, ValidationConfig(lost_below=0.2)).tolist() == pytest.approx([0.2, 0.275, 0.35, 0.35])
    # A ratio to be caught at that is less than that of a lost one asks for nothing more.
    assert needed_ratio(gate_scale, ValidationConfig(lost_below=0.4)).tolist() == pytest.approx([0.4] * 4)


def test_trust_rises_from_lost_to_certain():
    explained = torch.tensor([0.0, 0.2, 0.3, 0.4, 1.0])
    assert trust(explained, ValidationConfig(lost_below=0.2, uncertain_below=0.4)).tolist() == pytest.approx([0, 0, 0.5, 1, 1])
    step = trust(torch.tensor([0.29, 0.31]), ValidationConfig(lost_below=0.3, uncertain_below=0.3))
    assert step.tolist() == [0, 1]


def test_more_is_asked_of_finds_in_many_places_by_what_is_usual():
    config = ValidationConfig(lost_below=0.1, uncertain_below=0.4)
    explained, usual, gate_scale = torch.tensor([0.4, 0.4, 0.6, 0.4]), torch.tensor([0.8, 0.8, 0.8, 0.2]), torch.tensor([1.0, 2.0, 3.0, 2.0])
    assert trust(explained, config, usual, gate_scale).tolist() == pytest.approx([1.0, 0.6, 1.0, 1.0])


def hidden(inlier_ratio=0.8, usually=0.8, count=200, elsewhere=False, config=TRACKER):
    return float(partly_hidden(torch.tensor([inlier_ratio]), torch.tensor([usually]), torch.tensor([count]), torch.tensor([elsewhere]), config))


@pytest.mark.parametrize(("inlier_ratio", "expected"), [(0.0, 0), (0.64, 0), (0.7, 0.5), (0.76, 1), (1.0, 1), (math.nan, 0)])
def test_what_gathers_as_ever_counts_however_little_is_explained(inlier_ratio, expected):
    assert hidden(inlier_ratio) == pytest.approx(expected, abs=1e-6)


def test_nothing_counts_as_hidden_that_does_not_tell():
    # Found by a search, too few observations, hardly gathering when seen well, never seen well, switched off.
    assert hidden(elsewhere=True) == hidden(count=100) == hidden(0.5, 0.5) == hidden(usually=0.0) == 0
    assert hidden(config=TrackerConfig(disabled={Component.PARTLY_HIDDEN})) == 0
    assert hidden(count=30, config=TrackerConfig(validation=ValidationConfig(min_observations=7))) == 1


def test_of_a_hidden_object_no_more_is_asked_in_more_places():
    config, gate_scale = ValidationConfig(lost_below=0.2), torch.full((3,), 2.0)
    assert needed_ratio(gate_scale, config, torch.tensor([0.0, 0.5, 1.0])).tolist() == pytest.approx([0.35, 0.275, 0.2])
    stated = torch.full((2,), 0.3), torch.full((2,), 100), torch.ones(2), torch.zeros(2, 6), torch.ones(2)
    assert judge(*stated, config, gate_scale[:2], torch.tensor([0.0, 1.0])).tolist() == [Status.LOST, Status.UNCERTAIN]


def test_an_uncertain_object_may_be_found_farther_away():
    step = torch.zeros(2, 6)
    step[:, 0] = 0.8
    status = judge(torch.ones(2), torch.full((2,), 100), torch.ones(2), step, torch.ones(2), ValidationConfig(), torch.tensor([1.0, 2.0]))
    assert status.tolist() == [Status.DIVERGED, Status.TRACKING]


# ---- the explained ratio


def test_a_contour_with_matches_all_along_is_explained():
    assert float(ratio(contours_at(upright_line()), matches_at(upright_line(u=81.0)))) == 1


def test_a_contour_without_matches_is_not():
    assert float(ratio(contours_at(upright_line()), matches_at(upright_line(u=120.0)))) == 0
    assert float(ratio(contours_at(upright_line()), matches_at(upright_line(), near=torch.zeros(1, 80, dtype=torch.bool)))) == 0


@pytest.mark.parametrize(("config", "count", "expected"), [(TRACKER, 2, 0), (TRACKER, 3, 1), (CORNERS_ALONE, 1, 1)])
def test_a_patch_needs_a_few_observations_on_its_contours_and_of_corners_alone_one(config, count, expected):
    contours = contours_at(upright_line(count=16, first=32.0))
    actual = ratio(contours, matches_at(upright_line(count=count, first=36.0)), config=config)
    assert float(actual) == expected


@pytest.mark.parametrize(("on", "expected"), [(20, 0), (39, 0), (41, 1), (80, 1)])
def test_a_patch_is_explained_where_most_observations_near_its_contours_are_on_them(on, expected):
    """Chance scatters observations around a contour: a fourth of those within 3 px are on it."""
    targets = torch.full((1, 80, 2), 40.0)
    offsets = torch.where(torch.arange(80)[None] < on, 0.5, -2.0)
    assert float(ratio(contours_at(upright_line(40.0, count=16, first=32.0)), matches_at(targets, offsets=offsets))) == expected
    # Those farther off count neither way.
    away = torch.where(torch.arange(80)[None] < on, 0.5, -3.5)
    assert float(ratio(contours_at(upright_line(40.0, count=16, first=32.0)), matches_at(targets, offsets=away))) == 1


def test_half_a_contour_is_half_explained():
    actual = float(ratio(contours_at(upright_line()), matches_at(upright_line(count=40))))
    assert actual == pytest.approx(0.5, abs=0.1)
    assert actual >= 0.5


def test_what_does_not_move_need_not_be_explained():
    still = torch.cat([upright_line(60.0), upright_line(80.0)], 1)
    contours = contours_at(still)
    moving = torch.zeros_like(still)
    moving[:, 80:, 0] = 100.0
    moving[:, :80, 0] = 29.0
    matches = matches_at(upright_line(80.0))
    assert float(explained_ratio(contours, matches, moving, IMAGE_SIZE, TRACKER)) == 1
    moving[:, :80, 0] = 31.0
    assert float(explained_ratio(contours, matches, moving, IMAGE_SIZE, TRACKER)) == 0.5


def test_only_motion_across_the_contour_counts():
    """A contour that slides along itself fires no events."""
    nothing = matches_at(upright_line(150.0))
    assert float(ratio(contours_at(upright_line()), nothing, velocity=(0.0, 500.0))) == 1
    assert float(ratio(contours_at(upright_line()), nothing, velocity=(40.0, 500.0))) == 0


def test_hidden_contours_and_those_outside_the_image_need_no_explanation():
    outside = torch.cat([upright_line(80.0), upright_line(230.0), upright_line(-20.0), upright_line(60.0)], 1)
    mask = torch.ones(1, 320, dtype=torch.bool)
    mask[:, 240:] = False
    assert float(ratio(contours_at(outside, mask=mask), matches_at(upright_line(80.0)))) == 1


def test_hardly_anything_moving_says_nothing():
    assert float(ratio(contours_at(upright_line(count=15)), matches_at(upright_line(150.0)))) == 1
    assert float(ratio(contours_at(upright_line(count=16)), matches_at(upright_line(150.0)))) == 0


def test_matches_outside_the_image_explain_nothing():
    """Neither at the border that they would be moved to, nor on the other side of it."""
    border = torch.cat([upright_line(1.0), upright_line(198.0)], 1)
    for u in (-30.0, 230.0, -1e9):
        assert float(ratio(contours_at(border), matches_at(upright_line(u)))) == 0


def test_the_ratio_of_an_object_does_not_depend_on_the_others():
    contours = contours_at(torch.cat([upright_line(), upright_line(100.0)]))
    matches = matches_at(torch.cat([upright_line(count=80, first=60.0), upright_line(100.0)]))
    actual = ratio(contours, matches).tolist()
    assert actual[0] == float(ratio(contours_at(upright_line()), matches_at(upright_line(count=80, first=60.0))))
    assert actual[1] == 1


# ---- how far events gather


@pytest.mark.parametrize(("on", "around", "away", "expected"), [(30, 0, 0, 1.0), (30, 30, 0, 0.5), (30, 30, 100, 0.5), (0, 40, 0, 0.0)])
def test_events_around_contours_gather_on_them_or_not(on, around, away, expected):
    offsets = torch.cat([torch.full((on,), -0.7), torch.full((around,), 0.9), torch.full((away,), 5.5)])[None]
    assert float(inlier_ratio(matches_at(torch.zeros(1, on + around + away, 2), offsets=offsets), CONFIG)) == expected


def test_few_events_do_not_tell_how_far_they_gather():
    assert inlier_ratio(matches_at(torch.zeros(1, 29, 2)), CONFIG).isnan().all()
    far = torch.zeros(1, 60, dtype=torch.bool)
    assert inlier_ratio(matches_at(torch.zeros(1, 60, 2), near=far), CONFIG).isnan().all()


# ---- in view


def test_the_visible_ratio_counts_points_in_the_image():
    pixels = [[[0.0, 0.0], [199.5, 149.5], [200.0, 20.0], [-0.1, 20.0], [20.0, -0.1], [20.0, 150.0], [50.0, 50.0]]]
    assert float(visible_ratio(contours_at(pixels), IMAGE_SIZE)) == pytest.approx(3 / 7)
    mask = [[True, True, False, False, False, False, True]]
    assert float(visible_ratio(contours_at(pixels, mask=mask), IMAGE_SIZE)) == 1


def test_without_contours_nothing_is_in_view():
    assert float(visible_ratio(contours_at([[[50.0, 50.0]]], mask=[[False]]), IMAGE_SIZE)) == 0
