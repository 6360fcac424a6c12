"""Lines that go on beyond the ends of the contours they explain: what they are told by, and what is left alone."""

from dataclasses import replace

import pytest
import torch

from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.relocalization import line_ends
from torchtrack.tracking.relocalization.acceptance import less_where_lines_run_on

IMAGE_SIZE = (240, 320)
TOP_LEFT, SIDE_PX = (100.0, 80.0), 60


def running_on(contours, places, image_size):
    """The ratio of poses of one object."""
    return line_ends.running_on(contours, torch.zeros_like(contours.kind[:, 0]), places, image_size)


def line(start, end, spacing_px=1.0):
    """Points from one place to another, and the normal there."""
    start, end = torch.tensor(start), torch.tensor(end)
    count = int((end - start).norm() / spacing_px) + 1
    along = (end - start) / (end - start).norm()
    return torch.lerp(start, end, torch.linspace(0, 1, count)[:, None]), along.flip(0) * torch.tensor([-1.0, 1.0])


def contours_of(*lines, device="cpu", dtype=torch.float32):
    """Contours of one object that shows these lines."""
    pixels = torch.cat([points for points, _ in lines]).to(device, dtype)[None]
    normals = torch.cat([normal.expand(len(points), 2) for points, normal in lines]).to(device, dtype)[None]
    shape, points = pixels.shape[:2], torch.zeros(*pixels.shape[:2], 3, device=device, dtype=dtype)
    kind, mask = torch.zeros(shape, dtype=torch.int64, device=device), torch.ones(shape, dtype=torch.bool, device=device)
    return Contours(points, points, kind, mask, points, pixels, normals, torch.ones_like(points[..., 0]))


def places_of(*lines, device="cpu", dtype=torch.float32):
    """An event on every point of some lines."""
    pixels = torch.cat([points for points, _ in lines]).to(device, dtype)[None]
    return pixels, torch.ones(pixels.shape[:2], dtype=torch.bool, device=device)


def square():
    """The four sides of a square."""
    (left, top), (right, bottom) = TOP_LEFT, (TOP_LEFT[0] + SIDE_PX, TOP_LEFT[1] + SIDE_PX)
    corners = (left, top), (right, top), (right, bottom), (left, bottom)
    return [line(start, end) for start, end in zip(corners, corners[1:] + corners[:1], strict=True)]


def bar():
    """The two edges of a bar that its left and right side lie on."""
    return [line((TOP_LEFT[0] + across, 20.0), (TOP_LEFT[0] + across, 220.0)) for across in (0, SIDE_PX)]


def test_lines_that_end_with_their_contours_do_not_run_on(device, dtype):
    ratio = running_on(contours_of(*square(), device=device, dtype=dtype), places_of(*square(), device=device, dtype=dtype), IMAGE_SIZE)
    assert ratio.dtype == dtype and ratio.device.type == device.type
    assert ratio.tolist() == [0.0]


def test_edges_of_a_bar_run_on_beyond_what_is_laid_along_them(device, dtype):
    sides = square()[1::2]
    ratio = running_on(contours_of(*sides, device=device, dtype=dtype), places_of(*bar(), device=device, dtype=dtype), IMAGE_SIZE)
    assert float(ratio) > 0.8


def test_a_bar_before_an_object_is_not_held_against_it():
    """Its edges cross contours, but do not carry them on."""
    across = line((20.0, 110.0), (300.0, 110.0)), line((20.0, 125.0), (300.0, 125.0))
    assert running_on(contours_of(*square()), places_of(*square(), *across), IMAGE_SIZE).tolist() == [0.0]


def test_what_is_round_has_no_ends():
    turns = torch.linspace(0, 2 * torch.pi, 400)[:-1]
    normals = torch.stack([turns.cos(), turns.sin()], -1)
    circle = contours_of((torch.tensor([160.0, 120.0]) + 50 * normals, torch.tensor([1.0, 0.0])))
    circle = replace(circle, normals=normals[None])
    everywhere = torch.cartesian_prod(torch.arange(0.0, 320, 2), torch.arange(0.0, 240, 2))[None]
    assert running_on(circle, (everywhere, torch.ones(everywhere.shape[:2], dtype=torch.bool)), IMAGE_SIZE).tolist() == [0.0]


@pytest.mark.parametrize("missing", ["events", "contours"])
def test_without_events_or_contours_nothing_runs_on(missing):
    contours, (pixels, mask) = contours_of(*square()), places_of(*bar())
    if missing == "events":
        mask = torch.zeros_like(mask)
    else:
        contours = replace(contours, mask=torch.zeros_like(contours.mask))
    assert running_on(contours, (pixels, mask), IMAGE_SIZE).tolist() == [0.0]


def both():
    """Contours of an object laid along a bar, and of one beside it, padded to as many points."""
    along = contours_of(*square()[1::2])
    return along, contours_of(*square()).widened(300), places_of(*square(), *bar())


def test_each_pose_is_told_as_if_it_were_alone():
    along, whole, places = both()
    along = along.widened(300)
    together = Contours(*(torch.cat([getattr(along, name), getattr(whole, name)]) for name in vars(along)))
    alone = torch.cat([running_on(contours, places, IMAGE_SIZE) for contours in (along, whole)])
    assert running_on(together, places, IMAGE_SIZE).tolist() == alone.tolist()
    assert running_on(together.rows(torch.tensor([1, 0])), places, IMAGE_SIZE).tolist() == alone.flip(0).tolist()


@pytest.mark.parametrize("concerned", [[True, False], [True, True], [False, False]])
def test_scores_of_poses_that_are_not_concerned_stay(concerned):
    along, _, places = both()
    together = along.rows(torch.tensor([0, 0]))
    score, asked = torch.tensor([0.9, 0.8]), torch.tensor(concerned)
    less = less_where_lines_run_on(score, asked, together, places, IMAGE_SIZE)
    ratio = running_on(together, places, IMAGE_SIZE)
    assert float(ratio.min()) > 0.5
    torch.testing.assert_close(less, torch.where(asked, score * (1 - ratio), score))
