"""The explained ratio, what gathers on contours, and what is in view."""

import pytest
import torch
from helpers import contours_at
from measured_matches import matches_at

from torchtrack.config.tracker import AssociationConfig, CornerConfig, TrackerConfig
from torchtrack.config.validation import ValidationConfig
from torchtrack.tracking.validation.measures import explained_ratio, inlier_ratio, visible_ratio

IMAGE_SIZE = (150, 200)
CONFIG, TRACKER = ValidationConfig(), TrackerConfig()

CORNERS_ALONE = TrackerConfig(corners=CornerConfig(max_corners=32), association=AssociationConfig(max_events=0))


def upright_line(u=80.0, count=80, first=20.0):
    v = first + torch.arange(count, dtype=torch.float64)
    return torch.stack([torch.full_like(v, u), v], -1)[None]


def ratio(contours, matches, velocity=(100.0, 0.0), config=TRACKER):
    moving = torch.tensor(velocity, dtype=torch.float64).expand_as(contours.pixels)
    return explained_ratio(contours, matches, moving, torch.tensor([IMAGE_SIZE]).expand(len(moving), 2), config)


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
    assert float(explained_ratio(contours, matches, moving, torch.tensor([IMAGE_SIZE]), TRACKER)) == 1
    moving[:, :80, 0] = 31.0
    assert float(explained_ratio(contours, matches, moving, torch.tensor([IMAGE_SIZE]), TRACKER)) == 0.5


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
    assert float(visible_ratio(contours_at(pixels), torch.tensor([IMAGE_SIZE]))) == pytest.approx(3 / 7)
    mask = [[True, True, False, False, False, False, True]]
    assert float(visible_ratio(contours_at(pixels, mask=mask), torch.tensor([IMAGE_SIZE]))) == 1


def test_without_contours_nothing_is_in_view():
    assert float(visible_ratio(contours_at([[[50.0, 50.0]]], mask=[[False]]), torch.tensor([IMAGE_SIZE]))) == 0
