import numpy as np
import pytest

from torchtrack.run.sinks.alignment import alignment


def line():
    """Contour points along v = 50 and their normals."""
    contour = np.stack([np.arange(100.0), np.full(100, 50.0)], 1)
    return contour, np.tile([0.0, 1.0], (100, 1))


@pytest.mark.parametrize("offset", [-3.0, 0.0, 2.5])
def test_distance_is_taken_along_the_normal(offset):
    contour, normals = line()
    events = contour[20:80] + np.array([0.3, offset])
    measured = alignment(events, contour, normals)
    assert measured.median_px == pytest.approx(abs(offset))
    assert measured.share_near == 1


def test_events_far_away_do_not_count():
    contour, normals = line()
    events = np.concatenate([contour[:30] + np.array([0, 1]), contour[:10] + np.array([0, 40])])
    measured = alignment(events, contour, normals)
    assert (measured.median_px, measured.share_near) == (1, 0.75)


@pytest.mark.parametrize("count", [0, 5])
def test_nothing_near(count):
    contour, normals = line()
    measured = alignment(np.full((count, 2), 500.0), contour, normals)
    assert np.isnan(measured.median_px)
    assert measured.share_near == 0
    assert np.isnan(alignment(np.zeros((3, 2)), contour[:0], normals[:0]).median_px)
