"""What observations that lie side by side have in common: many of them do not tell as much more."""

import math
from dataclasses import replace

import pytest
import torch
from close_edges import two_depths
from helpers import IMAGE_SIZE, contours_at, generator, moving_objects, seen, upright_line
from nearest_cases import matching

from torchtrack.object_model.contour_source import ContourKind
from torchtrack.tracking.association.nearest import contour_table, match_nearest
from torchtrack.tracking.association.weights import SORTED_PX2, edge_ambiguity_px2, effective_weight
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.contours.points import joined


@pytest.mark.parametrize(("observation_px", "common_px"), [(1.0, 0.5), (1.5, 0.2), (0.2, 1.0)])
def test_the_mean_of_many_has_the_variance_of_what_they_have_in_common(observation_px, common_px, dtype):
    count = torch.tensor([[1.0, 2.0, 10.0, 1e3, 1e6]], dtype=dtype)
    common_px2 = torch.full_like(count, common_px**2)
    variance = observation_px**2 / (count * effective_weight(count, common_px2, observation_px))
    torch.testing.assert_close(variance, common_px**2 + observation_px**2 / count)


def test_one_alone_and_those_with_nothing_in_common_tell_all(dtype):
    count = torch.arange(50, dtype=dtype)[None]
    assert (effective_weight(count, torch.zeros_like(count), 1.5) == 1).all()
    assert (effective_weight(torch.zeros_like(count), torch.ones_like(count), 1.5) == 1).all()


def test_observations_are_counted_by_patch_where_they_are_on_a_contour():
    """Two patches (16 px) with 30 and 5 observations on an upright line, and some 2 px beside it, which do not count."""
    rows = torch.cat([torch.linspace(33, 46, 30), torch.linspace(81, 94, 5), torch.linspace(33, 46, 8)]).double()
    columns = torch.cat([torch.full((35,), 85.2), torch.full((8,), 87.0)]).double()
    table = contour_table(contours := upright_line(85.0), index_contours(contours, IMAGE_SIZE, 8, 1))
    observations, still = seen(torch.stack([columns, rows], -1)[None]), moving_objects((0.0, 0.0), 1, torch.float64)
    matches, _ = match_nearest(observations, table, observations.pixels, still, 4.0, matching(concentration=True, polarity=True))
    assert matches.neighbours[0].tolist() == [30] * 30 + [5] * 5 + [30] * 8


def test_a_displaced_place_with_many_events_pulls_less_with_an_error_in_common():
    """Of two equal stretches of a line, one has ten times the events, and is half a pixel off: the mean of all is taken less to it."""
    rows = torch.cat([torch.linspace(33, 46, 100), torch.linspace(81, 94, 10)]).double()
    noise = 0.05 * torch.randn(110, generator=generator(3), dtype=torch.float64)
    columns = 85 + noise + torch.cat([torch.full((100,), 0.5), torch.zeros(10)]).double()
    table = contour_table(contours := upright_line(85.0), index_contours(contours, IMAGE_SIZE, 8, 1))
    observations, still = seen(torch.stack([columns, rows], -1)[None]), moving_objects((0.0, 0.0), 1, torch.float64)
    matches, _ = match_nearest(observations, table, observations.pixels, still, 4.0, matching(concentration=True))
    means = []
    for common_px2 in (0.0, 1.0):
        weights = matches.weights * effective_weight(matches.neighbours, torch.full_like(matches.neighbours, common_px2), 1.0)
        means.append(float((weights * matches.offsets.abs()).sum() / weights.sum()))
    assert means[0] == pytest.approx(0.455, abs=0.03)
    # Both stretches tell the same.
    assert means[1] == pytest.approx(0.26, abs=0.03)


# ---- edges that lie close


def two_lines(apart_px, dtype=torch.float64, kind=ContourKind.CREASE):
    """Two upright lines, of one kind, and the index of both."""
    contours = joined(upright_line(80.0, dtype, kind=kind), upright_line(80.0 + apart_px, dtype, kind=kind))
    return contours, index_contours(contours, IMAGE_SIZE, 8, 1)


def edge_ambiguity(contours, index, close_px=2.0):
    edges = (contours.kind == int(ContourKind.CREASE)) | (contours.kind == int(ContourKind.SMOOTH))
    return edge_ambiguity_px2(contours, index, edges, contours.kind == int(ContourKind.CREASE), close_px)[0]


@pytest.mark.parametrize("apart_px", [1.0, 2.0, 3.0])
def test_close_edges_are_taken_for_each_other_half_of_the_time_at_most(apart_px, dtype):
    actual = edge_ambiguity(*two_lines(apart_px, dtype))
    expected = 0.5 * math.exp(-((apart_px / 2.0) ** 2)) * apart_px**2
    torch.testing.assert_close(actual, torch.full_like(actual, expected))
    assert expected <= 0.5 * apart_px**2


@pytest.mark.parametrize("apart_px", [0.2, 5.0, 12.0])
def test_what_is_one_edge_or_far_from_the_next_is_not_mistaken(apart_px):
    assert (edge_ambiguity(*two_lines(apart_px)) == 0).all()


@pytest.mark.parametrize("apart_px", [0.2, 0.45, 1.0])
def test_sharp_edges_at_different_depths_share_what_is_seen_even_where_they_cover_each_other(apart_px):
    actual = edge_ambiguity(*two_depths(apart_px))[:-1]
    expected = 0.5 * math.exp(-((apart_px / 2.0) ** 2)) * (apart_px**2 + SORTED_PX2)
    torch.testing.assert_close(actual, torch.full_like(actual, expected), rtol=1e-12, atol=0)


def test_only_sharp_edges_and_only_where_they_are_far_apart_in_depth_cover_each_other():
    assert (edge_ambiguity(*two_depths(0.2, ContourKind.SMOOTH)) == 0).all()
    assert (edge_ambiguity(*two_depths(0.2, depth_m=1.01)) == 0).all()
    assert (edge_ambiguity(*two_depths(0.02)) == 0).all()


def test_print_and_edges_that_cross_are_not_mistaken():
    assert (edge_ambiguity(*two_lines(2.0, kind=ContourKind.TEXTURE)) == 0).all()
    level = torch.stack([torch.arange(60.0, 100.0), torch.full((40,), 70.0)], -1)[None].double()
    crossing = contours_at(level, normals=torch.tensor([0.0, 1.0]).expand_as(level), kind=ContourKind.CREASE)
    contours = joined(upright_line(80.0, kind=ContourKind.CREASE), crossing)
    assert (edge_ambiguity(contours, index_contours(contours, IMAGE_SIZE, 8, 1)) == 0).all()


def test_edges_that_are_hidden_are_not_mistaken_nor_mistake_others():
    contours, _ = two_lines(2.0)
    contours = replace(contours, mask=contours.mask & (contours.pixels[..., 0] < 81))
    assert (edge_ambiguity(contours, index_contours(contours, IMAGE_SIZE, 8, 1)) == 0).all()


def test_what_is_seen_between_close_edges_tells_less_where_that_counts():
    contours, index = two_lines(2.0)
    observations, still = seen(torch.tensor([[[79.8, 60.0], [82.1, 60.0]]]).double()), moving_objects((0.0, 0.0), 1, torch.float64)
    for close_px, expected in ((0.0, 0.0), (2.0, 2 * math.exp(-1))):
        table = contour_table(contours, index, close_px=close_px)
        matches, _ = match_nearest(observations, table, observations.pixels, still, 4.0, matching(concentration=True, polarity=True))
        torch.testing.assert_close(matches.edge_ambiguity_px2, torch.full((1, 2), expected, dtype=torch.float64))
