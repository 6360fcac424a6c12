"""Cells of an object's part of the image, and lines among points in them."""

import math

import pytest
import torch
from helpers import generator

from torchtrack.tracking.adaptation.cell_grid import CellGrid, fit_lines, is_near, point_sums, tallied

MIDDLE = torch.tensor([[[320.0, 240.0]]], dtype=torch.float64)


def grid_of(diameter_px):
    return CellGrid.around(MIDDLE, torch.tensor([diameter_px], dtype=torch.float64))


@pytest.mark.parametrize(("diameter_px", "cell_px"), [(50.0, 1.0), (240.0, 1.0), (480.0, 2.0)])
def test_cells_are_pixels_or_as_large_as_the_object_needs(diameter_px, cell_px):
    grid = grid_of(diameter_px)
    assert float(grid.cell_px) == cell_px
    pixels = MIDDLE + torch.randn(1, 20, 2, generator=generator(), dtype=torch.float64) * diameter_px / 6
    places = grid.place(pixels)
    torch.testing.assert_close(grid.pixels(places), pixels)
    assert bool(((places >= 0) & (places < 256)).all())


def test_sums_are_by_cell():
    places = torch.tensor([[[10.2, 20.0], [9.8, 20.4], [30.0, 5.0]]])
    sums = tallied(places, torch.tensor([[[1.0, 2.0, 4.0]]]))[0, 0]
    assert sums[20 * 256 + 10] == 3
    assert sums[5 * 256 + 30] == 4
    assert sums.sum() == 7


@pytest.mark.parametrize("place", [(-1e9, 3.0), (1e9, 1e9), (math.nan, math.inf)])
def test_what_lies_outside_is_no_harm(place):
    assert tallied(torch.tensor([[place]]), torch.ones(1, 1, 1)).sum() == 1


def test_near_is_within_a_radius():
    marked = tallied(torch.tensor([[[100.0, 100.0]]]), torch.ones(1, 1, 1))[:, 0]
    places = torch.tensor([[[100.0, 102.0], [102.0, 101.0], [102.0, 102.0], [103.0, 100.0]]])
    assert is_near(marked, places, 2).tolist() == [[True, True, False, False]]


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 45.0, 90.0, 130.0])
def test_a_line_is_found_to_a_tenth_of_a_cell(angle_deg):
    angle = math.radians(angle_deg)
    direction = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    normal = torch.tensor([-direction[1], direction[0]])
    along = torch.linspace(-20, 20, 200, dtype=torch.float64)
    points = (torch.tensor([128.3, 127.6], dtype=torch.float64) + along[:, None] * direction)[None]
    sums = point_sums(points, torch.ones(1, 200, dtype=torch.bool))
    lines = fit_lines(sums, points[:, 100:101] + 0.8 * normal, 3)
    assert abs(float(((lines.places - points[:, :1]) * normal).sum())) < 0.1
    assert abs(float((lines.directions * direction).sum())) > 0.995
    assert float(lines.thickness) < 0.15
    assert float(lines.length) > 10 * float(lines.thickness)


def test_a_heap_is_no_line():
    points = 128 + 6 * torch.rand(1, 400, 2, generator=generator())
    lines = fit_lines(point_sums(points, torch.ones(1, 400, dtype=torch.bool)), torch.full((1, 1, 2), 131.0), 3)
    assert float(lines.thickness) > 0.5 * float(lines.length)


def test_where_nothing_is_everything_is_finite():
    sums = point_sums(torch.full((1, 3, 2), 50.0), torch.zeros(1, 3, dtype=torch.bool))
    lines = fit_lines(sums, torch.tensor([[[50.0, 50.0], [math.nan, 1.0]]]), 3)
    assert lines.count.tolist() == [[0.0, 0.0]]
    assert all(bool(torch.isfinite(value).all()) for value in vars(lines).values())
