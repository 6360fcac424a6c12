"""The depth buffer: which surface is nearest in each cell, and that surfaces have no holes, however large they are in the image."""

import numpy as np
import pytest
import torch
from both_ways import both_ways
from helpers import SMALL_CAMERA, box_model, generator, pose
from scipy.ndimage import maximum_filter, minimum_filter
from solid_models import ball

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import Camera
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.contour_source import group_by_model
from torchtrack.tracking.contours.depth_buffer import DEPTH_CELL_PX, MOST_CELLS, NOTHING, DepthGrid, Scene, closed, depth_buffer
from torchtrack.tracking.contours.sampling import mesh_contours
from torchtrack.tracking.contours.visibility import remove_hidden

CONFIG = ContourConfig()


def scene_of(models, T, camera, dtype=torch.float32):
    """Objects before one camera."""
    groups = [group.to(dtype) for group in group_by_model(models, CONFIG)]
    count, diameters = len(models), torch.tensor([model.diameter_m for model in models], dtype=dtype)
    streams, shape = torch.zeros(count, dtype=torch.int64), (1, camera.height, camera.width)
    return Scene(groups, T.to(dtype), camera.intrinsics(dtype).expand(count, 4), streams, diameters, shape, count > 1)


def test_the_depth_buffer_holds_the_nearest_surface_and_whose_it_is():
    models = [box_model((0.2, 0.2, 0.02)), box_model((0.06, 0.06, 0.02))]
    T = torch.stack([pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.61)), pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.41))])
    scene = scene_of(models, T, SMALL_CAMERA)
    grid = DepthGrid.whole(scene, 4)
    depth_m, owner = (values.view(grid.size) for values in depth_buffer(scene, grid))
    for (u, v), depth, who in (((100, 75), 0.4, 1), ((64, 75), 0.6, 0), ((130, 100), 0.6, 0)):
        assert float(depth_m[round(v / 4) + 1, round(u / 4) + 1]) == pytest.approx(depth, abs=1e-4)
        assert int(owner[round(v / 4) + 1, round(u / 4) + 1]) == who
    assert float(depth_m[2, 2]) > 1e6


@pytest.mark.parametrize("side", range(1, MOST_CELLS + 1))
def test_closing_is_that_of_a_library(side):
    depths = torch.randint(1, 1000, (2, 23, 31), generator=generator())
    depths[torch.rand(depths.shape, generator=generator(1)) < 0.4] = NOTHING
    for ours, given in zip(closed(depths, side), depths, strict=True):
        # A square that ends at each cell, and one that begins there.
        nearer = minimum_filter(given.numpy(), side, mode="constant", cval=NOTHING, origin=(side - 1) // 2)
        assert np.array_equal(ours.numpy(), maximum_filter(nearer, side, mode="constant", cval=0, origin=-(side // 2)))


def test_holes_are_closed_and_what_a_surface_ends_at_stays():
    surface = torch.full((1, 20, 20), NOTHING)
    surface[0, 4:14, 5:15] = 7
    pierced = surface.clone()
    pierced[0, 6, 7] = pierced[0, 9:11, 9:11] = NOTHING
    # Holes of one cell, and of two by two.
    assert int(closed(pierced, 2)[0, 6, 7]) == 7 and int(closed(pierced, 2)[0, 9, 9]) == NOTHING
    assert torch.equal(closed(pierced, 3), surface) and torch.equal(closed(surface, MOST_CELLS), surface)


@pytest.mark.parametrize("size_px", [100, 250, 500, 1000])
def test_a_surface_has_no_holes_however_large_it_is_in_the_image(size_px):
    """A plate that fills so much of a sensor of 1280x720 or less, straight before the camera."""
    camera = Camera(fx=1000.0, fy=1000.0, cx=639.5, cy=359.5, width=1280, height=720)
    model = box_model((0.3, 0.2, 0.01))
    depth_m = 1000.0 * float(model.diameter_m) / size_px
    scene = scene_of([model], pose((0.0, 0.0, 0.0), (0.0, 0.0, depth_m))[None], camera)
    grid = DepthGrid.whole(scene, DEPTH_CELL_PX)
    depths = depth_buffer(scene, grid)[0].view(grid.size)
    half_u, half_v = (int(1000.0 * side / 2 / depth_m / DEPTH_CELL_PX) - 1 for side in (0.3, 0.2))
    middle_v, middle_u = round(359.5 / DEPTH_CELL_PX) + 1, round(639.5 / DEPTH_CELL_PX) + 1
    inside = depths[max(middle_v - half_v, 3) : middle_v + half_v, max(middle_u - half_u, 3) : middle_u + half_u]
    assert float((inside > 2 * depth_m).double().mean()) < 0.02
    # Beyond its outline there is nothing, no nearer than before.
    assert bool((depths[:, : middle_u - half_u - 4] > 1e3).all()) and bool((depths[: max(middle_v - half_v - 4, 0)] > 1e3).all())


@pytest.mark.parametrize("depth_m", [0.9, 0.45, 0.25])
def test_kernels_close_the_same_holes(depth_m, dtype):
    camera = Camera(fx=600.0, fy=600.0, cx=319.5, cy=239.5, width=640, height=480)
    models = [ObjectModel.from_mesh([ball(0.05, (0, 0, -0.06), subdivisions=4), ball(0.03, (0, 0, 0.06))], name="balls"), box_model()]
    T = torch.stack([pose((0.2, 0.6, 0.1), (0.0, 0.0, depth_m)), pose((0.5, 0.4, 0.0), (0.03, 0.02, depth_m + 0.3))])
    scene = scene_of(models, T, camera, dtype)
    contours = mesh_contours(scene.models, scene.T_cam_obj, scene.intrinsics, CONFIG)
    ours, theirs = both_ways(lambda: remove_hidden(contours, scene))
    assert float((ours.mask != theirs.mask).double().mean()) < 2e-3
    assert 0 < int(theirs.mask.sum()) < int(contours.mask.sum())
