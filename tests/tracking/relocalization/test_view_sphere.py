"""Outlines from all around: how views are spread, and that what is moved from them lies where the contours are."""

import pytest
import torch
from helpers import generator
from tracked_boxes import in_motion

from torchtrack.config.tracker import TrackerConfig
from torchtrack.tracking.relocalization.view_sphere import outlines_at, outlines_by_view, thinned, view_directions


def test_directions_are_spread_evenly_over_the_sphere():
    directions = view_directions(200)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(200, dtype=torch.float64))
    nearest_deg = torch.rad2deg((directions @ directions.T - 3 * torch.eye(200)).max(1).values.acos())
    assert 10 < float(nearest_deg.min()) < float(nearest_deg.max()) < 16
    anywhere = torch.nn.functional.normalize(torch.randn((2000, 3), generator=generator(0), dtype=torch.float64), dim=1)
    assert float(torch.rad2deg((anywhere @ directions.T).max(1).values.acos()).max()) < 12


def turned_poses(prediction, count, seed=0):
    """Poses of the box, turned anyhow where it is."""
    steps = torch.zeros(count, 6)
    steps[:, :3] = 2 * torch.randn((count, 3), generator=generator(seed))
    return prediction.poses_at(steps.to(prediction.T_cam_obj))


def test_outlines_of_views_lie_near_the_contours(dtype):
    _, prediction, _, _, _ = in_motion(dtype=dtype)
    poses = turned_poses(prediction, 40)
    moved, own = outlines_by_view(prediction, poses, TrackerConfig()), outlines_at(prediction, poses, TrackerConfig())
    assert moved.pixels.dtype == dtype
    for number in range(40):
        ours, theirs = moved.pixels[number][moved.mask[number]], own.pixels[number][own.mask[number]]
        away_px = torch.cdist(ours, theirs)
        assert len(ours) > 50
        # A few edges that come into view, or go out of it, between the two.
        assert float(away_px.min(1).values.quantile(0.7)) < 2
        assert float(away_px.min(0).values.quantile(0.7)) < 2


@pytest.mark.parametrize("outlines", [outlines_at, outlines_by_view])
def test_a_pose_has_its_own_outline_whatever_others_there_are(outlines):
    _, prediction, _, _, _ = in_motion()
    poses = turned_poses(prediction, 6)
    together = outlines(prediction, poses, TrackerConfig())
    for number in range(6):
        alone = outlines(prediction, poses[number : number + 1], TrackerConfig())
        assert torch.equal(alone.mask[0], together.mask[number])
        torch.testing.assert_close(alone.points_obj[0], together.points_obj[number])
        torch.testing.assert_close(alone.pixels[0][alone.mask[0]], together.pixels[number][together.mask[number]], atol=1e-3, rtol=0)


def test_thinned_contours_are_some_of_the_visible_ones():
    _, _, _, actual, _ = in_motion()
    contours, few = actual.fit.contours, thinned(actual.fit.contours)
    assert few.mask.sum() == min(int(contours.mask.sum()), 200)
    visible = {tuple(row) for row in contours.pixels[contours.mask].tolist()}
    assert {tuple(row) for row in few.pixels[few.mask].tolist()} <= visible


@pytest.mark.parametrize("axis", range(3))
def test_views_along_the_axes_of_an_object_are_views_like_others(axis):
    _, prediction, _, _, _ = in_motion()
    poses = torch.eye(4).repeat(2, 1, 1)
    # The axis towards the camera, and away from it.
    order = [(axis + 1) % 3, (axis + 2) % 3, axis]
    poses[:, :3, :3] = torch.eye(3)[order]
    poses[1, 1:3] *= -1
    poses[:, :3, 3] = prediction.centre_cam[0]
    assert (outlines_by_view(prediction, poses, TrackerConfig()).mask.sum(1) > 50).all()
