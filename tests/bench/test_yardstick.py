"""The yardstick does its work: a time surface, and a pose that is refined to the true one."""

import cv2
import numpy as np
import pytest

from torchtrack.bench.yardstick import EVENTS, HEIGHT, WIDTH, Yardstick


def test_the_surface_is_newest_where_there_are_events():
    surface = Yardstick().surface()
    assert surface.shape == (HEIGHT, WIDTH) and surface.dtype == np.float32
    seen = surface > 0.5
    # So many pixels have an event of as many as there are, thrown at random.
    assert seen.mean() == pytest.approx(1 - np.exp(-EVENTS / (WIDTH * HEIGHT)), abs=0.01)
    assert surface.max() <= 1 and surface[~seen].max() < 1e-6


def test_the_pose_is_refined():
    yardstick = Yardstick()
    rotation, translation = yardstick.pose()
    np.testing.assert_allclose(rotation, yardstick.rotation, atol=1e-2)
    np.testing.assert_allclose(translation, yardstick.translation, atol=1e-3)


def test_it_is_timed_a_few_times_at_least_and_leaves_the_threads_of_opencv():
    before = cv2.getNumThreads()
    assert len(Yardstick().time(1).figures) == 5
    assert cv2.getNumThreads() == before
