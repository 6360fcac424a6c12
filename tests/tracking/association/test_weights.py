"""Polarity: an event that says the opposite of most others on the contour around it is trusted less."""

import pytest
import torch
from helpers import IMAGE_SIZE, generator, moving_objects, seen, upright_line
from nearest_cases import matching

from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association.nearest import Gate, contour_table, match_nearest
from torchtrack.tracking.association.weights import on_and_around, patch, patch_sums, polarity_agreement
from torchtrack.tracking.contours.index import index_contours


def agreement(dark, *, offsets=0.0, near=True, place=50.0):
    """Agreement of observations of one object, all in the patch of one place."""
    dark = torch.as_tensor(dark, dtype=torch.float64)[None]
    offsets, near = torch.as_tensor(offsets, dtype=torch.float64).expand(dark.shape), torch.as_tensor(near).expand(dark.shape)
    targets = torch.as_tensor(place, dtype=torch.float64).expand(dark.shape)[..., None].expand(*dark.shape, 2)
    cell, on = patch(targets), on_and_around(offsets, near)[:, 0]
    votes, voters = patch_sums(cell, torch.stack([on * dark, on], 1)).gather(2, cell[:, None].expand(-1, 2, -1)).unbind(1)
    return polarity_agreement(dark, votes, voters)[0]


def test_those_of_one_mind_count_in_full():
    for sign in (1.0, -1.0):
        assert (agreement([sign] * 20) == 1).all()


def test_a_few_against_many_count_least():
    weights = agreement([1.0] * 40 + [-1.0] * 4)
    assert (weights[:40] == 1).all()
    # Votes of 36, of 44 voters and two more: 1 - 1.5 * 36 / 46 is below nothing.
    assert weights[40:].tolist() == pytest.approx([0.05] * 4)


def test_trust_falls_with_the_majority_of_the_others():
    least = [float(agreement([1.0] * on + [-1.0] * (40 - on))[-1]) for on in (20, 24, 28, 32)]
    assert least == sorted(least, reverse=True)
    assert least == pytest.approx([1.0, *(1 - 1.5 * (2 * on - 40) / 42 for on in (24, 28, 32))])


def test_where_both_polarities_are_as_many_nothing_is_held_against_either():
    assert (agreement([1.0, -1.0] * 10) == 1).all()


def test_of_unknown_polarity_nothing_is_said():
    assert (agreement([0.0] * 5 + [1.0] * 20)[:5] == 1).all()


def test_a_single_observation_is_trusted():
    assert float(agreement([-1.0])) == 1


def test_only_observations_on_the_contour_vote():
    against = agreement([-1.0] + [1.0] * 20)[0]
    assert float(against) < 0.1
    assert float(agreement([-1.0] + [1.0] * 20, offsets=[0.0] + [2.0] * 20)[0]) == 1
    assert float(agreement([-1.0] + [1.0] * 20, near=[True] + [False] * 20)[0]) == 1


def test_other_patches_do_not_vote():
    assert float(agreement([-1.0] + [1.0] * 20, place=[50.0] + [70.0] * 20)[0]) == 1


def test_patches_are_sixteen_pixels_wide_and_wrap_around():
    pixels = torch.tensor([[[0.0, 0.0], [15.9, 15.9], [16.0, 0.0], [0.0, 16.0], [1024.0, 0.0], [-0.1, 0.0]]])
    assert patch(pixels)[0].tolist() == [0, 0, 1, 64, 0, 63]


# ---- on contours that move


def weights_on_a_line(polarity, *, speed=500.0, kind=ContourKind.CREASE, polarity_counts=True, of_texture=True):
    """Weights of observations on the line at 80 px, which moves across itself at ``speed`` px/s."""
    contours = upright_line(80.0, kind=kind)
    v = 32 + 15 * torch.rand(len(polarity), generator=generator(), dtype=torch.float64)
    places = torch.stack([torch.full_like(v, 80.0), v], -1)[None]
    observations = seen(places, polarity=torch.tensor(polarity, dtype=torch.float64)[None])
    table = contour_table(contours, index_contours(contours, IMAGE_SIZE, 8, 1), of_texture=of_texture)
    return match_nearest(observations, table, places, moving_objects((speed, 0.0)), Gate(3.0), matching(polarity=polarity_counts))[0].weights[0]


@pytest.mark.parametrize("kind", [ContourKind.SMOOTH, ContourKind.CREASE])
@pytest.mark.parametrize("speed", [500.0, -500.0])
def test_events_of_the_wrong_polarity_count_least_on_the_edges_of_a_mesh(kind, speed):
    weights = weights_on_a_line([1.0] * 30 + [-1.0] * 3, kind=kind, speed=speed)
    assert (weights[:30] == 1).all()
    assert float(weights[30:].max()) < 0.1


@pytest.mark.parametrize("speed", [500.0, -500.0])
def test_the_darker_side_of_texture_is_known_whatever_the_majority_says(speed):
    # Normals point to the darker side: it becomes brighter there where texture moves along its normal.
    right = 1.0 if speed > 0 else -1.0
    weights = weights_on_a_line([-right] * 30 + [right] * 3 + [0.0], kind=ContourKind.TEXTURE, speed=speed)
    assert float(weights[:30].max()) < 0.1
    assert (weights[30:] == 1).all()
    assert (weights_on_a_line([-right] * 30, kind=ContourKind.TEXTURE, speed=speed, of_texture=False) == 1).all()


@pytest.mark.parametrize("kind", [ContourKind.SEGMENT, ContourKind.SPLAT, ContourKind.LEARNED])
def test_contours_whose_normals_may_point_either_way_have_no_majority(kind):
    assert (weights_on_a_line([1.0] * 30 + [-1.0] * 3, kind=kind) == 1).all()


def test_what_hardly_moves_across_itself_has_no_leading_side():
    slow, fast = (float(weights_on_a_line([1.0] * 30 + [-1.0] * 3, speed=speed)[-1]) for speed in (1.0, 500.0))
    assert slow > 0.95
    assert fast < 0.1


def test_polarity_can_be_switched_off():
    switched_off = weights_on_a_line([1.0] * 30 + [-1.0] * 3, polarity_counts=False)
    assert (switched_off == 1).all()
