"""Shifts in the image that are tried all at once: that the right one is found, and only what is allowed."""

import pytest
import torch
from both_ways import both_ways
from helpers import generator
from tracked_boxes import in_motion

from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.relocalization.correlation import NONE, SIDE, Square, highest, peaks, shifted
from torchtrack.tracking.relocalization.view_sphere import outlines_at

CONFIG = TrackerConfig(relocalization=RelocalizationConfig(rotations=24))


def events_at(prediction, shift_px, dtype):
    """Events on the contours of the box, all of them somewhere else."""
    contours = outlines_at(prediction, prediction.T_cam_obj, CONFIG)
    return contours.pixels + torch.tensor(shift_px, dtype=dtype), contours.mask


def turns(*rotations, dtype=torch.float32):
    return torch.nn.functional.pad(torch.tensor(rotations, dtype=dtype), (0, 3))


def moved_px(prediction, offsets):
    """How far offsets move the middle of the box in the image."""
    focal, depth = prediction.objects.intrinsics[0, :2], prediction.centre_cam[0, 2]
    centre = prediction.centre_cam[0] + offsets[:, 3:]
    return focal * (centre[:, :2] / centre[:, 2:] - prediction.centre_cam[0, :2] / depth)


def test_the_shift_of_the_events_is_found(dtype):
    _, prediction, _, _, _ = in_motion(dtype=dtype)
    for shift_px in ((0.0, 0.0), (17.0, -9.0), (-21.0, 14.0)):
        steps = turns((0.0, 0.0, 0.0), (0.9, 0.0, 0.0), (0.0, -0.8, 0.5), dtype=dtype)
        offsets, _ = shifted(prediction, steps, torch.tensor([0.06], dtype=dtype), events_at(prediction, shift_px, dtype), CONFIG)
        assert offsets.dtype == dtype
        # The best is of the right turn, and little more than a cell off.
        assert not offsets[0, :3].any()
        assert float((moved_px(prediction, offsets)[0] - torch.tensor(shift_px, dtype=dtype)).norm()) < 4


def test_the_way_towards_the_camera_is_taken_as_drawn_along_the_line_of_sight():
    _, prediction, _, _, _ = in_motion()
    steps = turns((0.0, 0.0, 0.0))
    steps[0, 3:] = torch.tensor([0.3, -0.2, 0.05])
    offsets, _ = shifted(prediction, steps, torch.tensor([0.05]), events_at(prediction, (0.0, 0.0), torch.float32), CONFIG)
    torch.testing.assert_close(offsets[:, 5], torch.full_like(offsets[:, 5], 0.05))
    assert float(moved_px(prediction, offsets)[0].norm()) < 6


def test_no_shift_goes_farther_than_is_likely():
    _, prediction, _, _, _ = in_motion()
    offsets, _ = shifted(prediction, turns((0.0, 0.0, 0.0)), torch.tensor([0.01]), events_at(prediction, (60.0, 0.0), torch.float32), CONFIG)
    assert float(offsets[0, 3:5].norm()) < 0.03


def test_as_many_are_kept_as_asked_for_and_three_of_each_turn_at_most():
    _, prediction, _, _, _ = in_motion()
    places = events_at(prediction, (5.0, 5.0), torch.float32)
    many = turns(*[(0.1 * k, 0.0, 0.0) for k in range(8)])
    for steps, count in ((many, 12), (many[:2], 6)):
        offsets, outlines = shifted(prediction, steps, torch.tensor([0.05]), places, CONFIG)
        assert offsets.shape == (count, 6) and len(outlines.mask) == count


def test_each_comes_with_its_own_outline():
    _, prediction, _, _, _ = in_motion()
    places, sigma = events_at(prediction, (5.0, 5.0), torch.float32), torch.tensor([0.05])
    # More turns than are correlated at once.
    many = turns(*[(0.02 * k, 0.0, 0.0) for k in range(40)])
    offsets, outlines = shifted(prediction, many, sigma, places, CONFIG)
    for number in (0, 5, 11):
        own = offsets[number, :3]
        _, alone = shifted(prediction, torch.nn.functional.pad(own, (0, 3))[None], sigma, places, CONFIG)
        assert torch.equal(outlines.points_obj[number], alone.points_obj[0]) and torch.equal(outlines.mask[number], alone.mask[0])


def test_events_that_are_nowhere_count_for_nothing():
    _, prediction, _, _, _ = in_motion()
    pixels, mask = events_at(prediction, (10.0, 0.0), torch.float32)
    nowhere = torch.tensor([[[torch.nan, 3.0], [1e12, -1e12], [torch.inf, 0.0], [50.0, 50.0]]])
    spoilt = torch.cat([pixels, nowhere], 1), torch.cat([mask, torch.tensor([[True, True, True, False]])], 1)
    steps, sigma = turns((0.0, 0.0, 0.0), (0.2, 0.2, 0.0)), torch.tensor([0.05])
    assert torch.equal(shifted(prediction, steps, sigma, spoilt, CONFIG)[0], shifted(prediction, steps, sigma, (pixels, mask), CONFIG)[0])
    none, _ = shifted(prediction, steps, sigma, (pixels, torch.zeros_like(mask)), CONFIG)
    assert torch.isfinite(none).all()


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 1.0])
def test_shifts_that_are_added_up_are_those_of_spectra(share, dtype):
    """Wherever points of outlines are, and whichever shifts are allowed."""
    count = 40
    square = Square(torch.tensor([[60.0, 50.0]], dtype=dtype), torch.tensor([1.3], dtype=dtype))
    pixels = 130 * torch.rand((count, 60, 2), generator=generator(), dtype=torch.float64).to(dtype)
    pixels[0, 0], pixels[1] = torch.nan, torch.inf
    mask = torch.rand((count, 60), generator=generator(1)) < 0.9
    denser = torch.randn((SIDE, SIDE), generator=generator(2), dtype=torch.float64).to(dtype)
    allowed = torch.rand((SIDE, SIDE), generator=generator(3)) < share
    (best, place), (others, other_place) = both_ways(lambda: highest(denser, pixels, mask, square, allowed))
    torch.testing.assert_close(best, others, rtol=0, atol=10 * torch.finfo(dtype).eps)
    there = best > NONE
    # What is nowhere fits nowhere, and everywhere alike.
    there[1] = False
    assert bool(there.any()) == (share > 0)
    if dtype == torch.float64:
        assert torch.equal(place[there], other_place[there])


def test_peaks_are_higher_than_all_around_them(dtype):
    fit, allowed = torch.zeros((1, 96, 96), dtype=dtype), torch.ones((96, 96), dtype=torch.bool)
    for row, column, height in ((10, 10, 5.0), (10, 12, 4.0), (10, 15, 3.0), (80, 95, 2.0), (40, 40, 9.0)):
        fit[0, row, column] = height
    allowed[40, 40] = False
    best, place = peaks(fit, allowed)
    # One next to a higher one is none, nor is one that is not allowed.
    assert best[0].tolist() == [5.0, 3.0, 2.0]
    assert place[0].tolist() == [10 * 96 + 10, 10 * 96 + 15, 80 * 96 + 95]
