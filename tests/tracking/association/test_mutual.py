"""Mutual agreement: an observation that does not lie where the others of its bit of contour do is trusted less."""

import pytest
import torch
from helpers import IMAGE_SIZE, generator, moving_objects, seen, upright_line
from pydantic import ValidationError

from torchtrack.config.tracker import MatchingConfig
from torchtrack.tracking.association.nearest import contour_table, match_nearest
from torchtrack.tracking.association.weights import mutual_agreement, patch, patch_sums
from torchtrack.tracking.contours.index import index_contours


def agreement(offsets, *, matched=True, place=50.0, spread_px=0.7, dtype=torch.float64):
    """Agreement of observations of one object, all on the bit of contour at one place."""
    offsets = torch.as_tensor(offsets, dtype=dtype)[None]
    places = torch.as_tensor(place, dtype=dtype).expand(offsets.shape)[..., None].expand(*offsets.shape, 2)
    return mutual_agreement(places, offsets, torch.as_tensor(matched).expand(offsets.shape), spread_px)[0]


def test_those_side_by_side_count_in_full_wherever_they_are(dtype):
    for shift in (0.0, 1.3, -4.0):
        weights = agreement([shift] * 20, dtype=dtype)
        assert weights.dtype == dtype
        torch.testing.assert_close(weights, torch.ones_like(weights), rtol=0, atol=1e-6)


@pytest.mark.parametrize("spread_px", [0.35, 0.7, 2.0])
def test_at_the_spread_from_the_mean_trust_is_a_half(spread_px):
    weights = agreement([spread_px, -spread_px] * 10, spread_px=spread_px)
    assert weights.tolist() == pytest.approx([0.5] * 20)


def test_one_beside_many_is_trusted_little():
    weights = agreement([0.0] * 30 + [2.5])
    assert float(weights[:30].min()) > 0.97
    assert float(weights[30]) < 0.1


def test_on_the_contour_is_not_where_trust_lies_but_where_the_others_are():
    """A contour beside all of its events is pulled to them by the many, and not held by the few that chance has on it."""
    weights = agreement([1.5] * 30 + [0.0])
    assert float(weights[:30].min()) > 0.97
    assert float(weights[30]) < 0.25


def test_one_alone_is_trusted_and_more_of_them_bind_each_other_more():
    """One, two, three and four observations, half of them a pixel to either side: Cauchy's weight by the number of others."""
    assert float(agreement([3.0])) == 1
    for others in (1, 2, 3, 5):
        offsets = [1.0 - 2 * (number % 2) for number in range(others + 1)]
        mean = sum(offsets) / len(offsets)
        expected = [1 / (1 + min(others, 3) / 3 * ((offset - mean) / 0.7) ** 2) for offset in offsets]
        assert agreement(offsets).tolist() == pytest.approx(expected)


def test_other_bits_of_contour_and_what_has_no_match_have_no_say():
    assert float(agreement([0.0] + [3.0] * 20)[0]) < 0.1
    assert float(agreement([0.0] + [3.0] * 20, place=[50.0] + [60.0] * 20)[0]) == 1
    assert float(agreement([0.0] + [3.0] * 20, matched=[True] + [False] * 20)[0]) == 1


def test_bits_of_contour_are_eight_pixels_wide():
    far_apart = [float(agreement([0.0] + [3.0] * 20, place=[48.0] + [other] * 20)[0]) for other in (55.9, 56.0, 47.9)]
    assert far_apart == pytest.approx([far_apart[0], 1.0, 1.0])
    assert far_apart[0] < 0.1


def test_patches_of_another_size():
    pixels = torch.tensor([[[0.0, 0.0], [7.9, 7.9], [8.0, 0.0], [0.0, 8.0], [512.0, 0.0], [-0.1, 0.0]]])
    cell = patch(pixels, 3)
    assert cell[0].tolist() == [0, 0, 1, 64, 0, 63]
    assert patch_sums(cell, torch.ones(1, 1, 6))[0, 0, [0, 1, 63, 64]].tolist() == [3, 1, 1, 1]


# ---- on contours


def weights_on_a_line(offsets, rows, **settings):
    """Weights of observations beside the line at 80 px."""
    places = torch.stack([80 + torch.as_tensor(offsets, dtype=torch.float64), torch.as_tensor(rows, dtype=torch.float64)], -1)[None]
    table = contour_table(upright_line(80.0), index_contours(upright_line(80.0), IMAGE_SIZE, 8, 1))
    config = MatchingConfig(**{"concentration": False, "polarity": False, "dark_shift_px": 0.0, "mutual_px": 0.7, **settings})
    return match_nearest(seen(places), table, places, moving_objects((0.0, 0.0)), 4.0, config)[0].weights[0]


def test_strays_beside_an_edge_are_trusted_less():
    rows = 32 + 32 * torch.rand(120, generator=generator(), dtype=torch.float64)
    offsets = torch.cat([torch.full((100,), 0.5), torch.full((20,), -2.5)])
    weights = weights_on_a_line(offsets, rows)
    assert float(weights[100:].max()) < 0.35
    assert float(weights[:100].mean()) > 2.5 * float(weights[100:].mean())
    assert ((weights > 0) & (weights <= 1)).all()


def test_it_is_off_until_asked_for():
    offsets, rows = [0.0] * 20 + [2.5], torch.linspace(40, 47, 21)
    assert MatchingConfig().mutual_px == 0
    assert (weights_on_a_line(offsets, rows, mutual_px=0.0) == 1).all()
    assert not (weights_on_a_line(offsets, rows) == 1).all()


@pytest.mark.parametrize("value", [-0.1, 101.0])
def test_a_spread_out_of_bounds_is_an_error(value):
    with pytest.raises(ValidationError, match="mutual_px"):
        MatchingConfig(mutual_px=value)
