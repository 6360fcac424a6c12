"""Pictures of the events after a time: the soonest are the brightest, and a ruler says where they are."""

import numpy as np

from torchtrack.viz.event_picture import draw_events, soonest_event

SIZE = (120, 90)


def surface(pixels, t_us, at_us=1_000):
    return soonest_event(np.array(pixels), np.array(t_us, int), at_us, SIZE)


def test_the_soonest_event_of_a_pixel_counts():
    ahead = surface([(3, 5), (3, 5), (7, 8)], [1_100, 4_000, 2_000])
    assert (ahead[5, 3], ahead[8, 7]) == (900, 0)
    assert ahead[0, 0] < -1_000_000


def test_events_outside_the_image_are_left_out():
    assert (surface([(-1, 0), (120, 0), (0, 90)], [1_100] * 3) < -1_000_000).all()


def test_soon_events_are_brighter():
    image = draw_events(surface([(10, 10), (20, 20)], [1_100, 9_000]), 1_000)
    scale = image.shape[1] // SIZE[0]
    assert image.shape == (SIZE[1] * scale, SIZE[0] * scale, 3)
    soon, late = (int(image[int((v + 0.5) * scale), int((v + 0.5) * scale), 0]) for v in (10, 20))
    assert soon > late > 0


def test_the_ruler_has_lines_every_50_pixels():
    image = draw_events(surface(np.zeros((0, 2), int), []), 1_000)
    scale = image.shape[1] // SIZE[0]
    lines = np.flatnonzero(image[2, :, 0])
    assert np.abs(lines - (np.array([50, 100]) * scale + (scale - 1) / 2)).max() <= 0.5
