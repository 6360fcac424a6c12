"""Six views of a model: cameras before its sides, and the contours that show there."""

import numpy as np
import torch
import trimesh

from torchtrack.core.pose_checks import check_pose
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.contour_source import ContourKind
from torchtrack.viz.model_views import draw_model, view_contours, view_poses

RED, WHITE = (60, 60, 255), (255, 255, 255)


def shown(picture, colour):
    """How many pixels are of a colour, or nearly: lines are drawn softly."""
    return (np.abs(picture.astype(int) - colour).max(-1) < 110).sum()


def test_cameras_look_at_the_middle_from_each_side():
    model = ObjectModel.from_mesh(trimesh.creation.box((0.1, 0.2, 0.3)).apply_translation((0.5, 0, 0)))
    poses = view_poses(model)
    check_pose(poses.double())
    middle = (poses[:, :3, :3] @ model.centre + poses[:, :3, 3]).numpy()
    assert np.allclose(middle, [0, 0, 4 * model.diameter_m], atol=1e-5)
    # Where the camera is, seen from the middle: +x, +y, +z, -x, -y, -z.
    cameras = -(poses[:, :3, :3].mT @ poses[:, :3, 3:])[..., 0] - model.centre
    assert torch.allclose(cameras / (4 * model.diameter_m), torch.cat([torch.eye(3), -torch.eye(3)]), atol=1e-5)


def test_a_box_shows_the_four_creases_of_each_side():
    model = ObjectModel.from_mesh(trimesh.creation.box((0.1, 0.2, 0.3)))
    contours = view_contours(model, view_poses(model))
    assert bool((contours.kind[contours.mask] == int(ContourKind.CREASE)).all())
    for pixels, mask, size in zip(contours.pixels, contours.mask, ((0.2, 0.3), (0.1, 0.3), (0.1, 0.2)) * 2, strict=True):
        across, down = (pixels[mask].amax(0) - pixels[mask].amin(0)).tolist()
        assert abs(across / down - size[0] / size[1]) < 0.02


def test_the_picture_shows_creases_and_smooth_silhouettes():
    box, ball = trimesh.creation.box((0.1, 0.2, 0.3)), trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    for mesh, colour in ((box, WHITE), (ball, RED)):
        image = draw_model(ObjectModel.from_mesh(mesh))
        assert image.shape == (834, 1200, 3)
        for row in range(2):
            for column in range(3):
                tile = image[400 * row : 400 * (row + 1), 400 * column : 400 * (column + 1)]
                assert shown(tile, colour) > 200


def test_lines_alone_are_drawn():
    model = ObjectModel.from_polylines([[(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0)]])
    image = draw_model(model)
    assert shown(image[:400, 800:], (255, 160, 60)) > 100
