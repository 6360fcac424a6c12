"""Contour points become lines: along edges however far apart their points are, around curves, and not across gaps."""

import numpy as np
import pytest

from torchtrack.viz.contour_lines import contour_links


def line(start, end, count):
    """Points on a line, and their normals."""
    start, end = np.array(start, float), np.array(end, float)
    direction = (end - start) / np.linalg.norm(end - start)
    return np.linspace(start, end, count), np.tile([-direction[1], direction[0]], (count, 1))


def linked(*parts):
    pixels, normals = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    order = np.random.default_rng(0).permutation(len(pixels))
    links = contour_links(pixels[order], normals[order])
    return {tuple(sorted(pair)) for pair in order[links].tolist()}


@pytest.mark.parametrize("count", [3, 8, 200])
def test_points_of_an_edge_are_one_line(count):
    assert linked(line((10, 10), (110, 60), count)) == {(n, n + 1) for n in range(count - 1)}


@pytest.mark.parametrize("count", [16, 100])
def test_points_of_a_circle_are_closed(count):
    angle = 2 * np.pi * np.arange(count) / count
    outwards = np.stack([np.cos(angle), np.sin(angle)], 1)
    assert linked((50 * outwards, outwards)) == {tuple(sorted((n, (n + 1) % count))) for n in range(count)}


def test_a_gap_stays_open():
    links = linked(line((0, 0), (20, 0), 11), line((60, 0), (80, 0), 11))
    assert links == {(n, n + 1) for n in range(21) if n != 10}


def test_parallel_and_crossing_edges_are_apart():
    links = linked(line((0, 0), (30, 0), 11), line((0, 2), (30, 2), 11), line((15, -20), (15, 20), 14))
    assert links == {(n, n + 1) for n in range(35) if n not in (10, 21)}


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_points_have_no_links(count):
    assert contour_links(np.zeros((count, 2)), np.zeros((count, 2))).shape == (0, 2)


def test_one_point_twice():
    pixels = np.array([[5.0, 5.0], [5.0, 5.0], [8.0, 5.0]])
    assert {1} == {len(set(pair) & {2}) for pair in contour_links(pixels, np.tile([0.0, 1.0], (3, 1))).tolist()}
