import cv2
import numpy as np
import pytest
import torch

from torchtrack.cli.outline import outline_dark_shapes, read_grey_image, write_polylines
from torchtrack.core.camera import Camera, distort
from torchtrack.errors import MissingFileError, ModelError, UnknownFormatError
from torchtrack.object_model import ObjectModel

PINHOLE = Camera(fx=100.0, fy=110.0, cx=59.5, cy=39.5, width=120, height=80)
FISHEYE = Camera(fx=100.0, fy=110.0, cx=59.5, cy=39.5, width=120, height=80, distortion_model="fisheye", distortion=(0.05, 0.01, 0.0, 0.0))


def picture(*boxes):
    """A bright picture with dark boxes (u0, v0, u1, v1), the last pixel included."""
    image = np.full((80, 120), 200, np.uint8)
    for u0, v0, u1, v1 in boxes:
        image[v0 : v1 + 1, u0 : u1 + 1] = 10
    return image


def pixels_of(line, camera, distance_m):
    return distort(line[:, :2] / distance_m * [camera.fx, camera.fy] + [camera.cx, camera.cy], camera)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("distance_m", [0.5, 2.0])
def test_the_outline_of_a_box_lies_between_its_pixels_and_the_ground(camera, distance_m):
    (line,) = outline_dark_shapes(picture((30, 20, 59, 49)), camera, distance_m)
    assert np.array_equal(line[0], line[-1])
    assert (line[:, 2] == 0).all()
    pixels = pixels_of(line, camera, distance_m)
    assert pixels.min(0) == pytest.approx([29.5, 19.5], abs=0.15)
    assert pixels.max(0) == pytest.approx([59.5, 49.5], abs=0.15)


def test_every_shape_has_an_outline_and_specks_have_none():
    lines = outline_dark_shapes(picture((20, 20, 39, 39), (60, 30, 79, 49), (100, 10, 102, 12)), PINHOLE, 1.0)
    assert len(lines) == 2


def test_a_shape_cut_off_by_the_border_has_no_edge_there():
    lines = outline_dark_shapes(picture((90, 20, 119, 49)), PINHOLE, 1.0)
    pixels = np.concatenate([pixels_of(line, PINHOLE, 1.0) for line in lines])
    assert pixels[:, 0].min() == pytest.approx(89.5, abs=0.15)
    for line in lines:
        right = pixels_of(line, PINHOLE, 1.0)[:, 0] > 110
        assert not (right[:-1] & right[1:]).any()


def test_a_picture_without_shapes_or_of_another_size():
    with pytest.raises(ModelError, match="no dark shape"):
        outline_dark_shapes(picture((50, 50, 52, 52)), PINHOLE, 1.0)
    with pytest.raises(ModelError, match="64x48 pixels, the camera 120x80"):
        outline_dark_shapes(np.zeros((48, 64), np.uint8), PINHOLE, 1.0)


def test_pictures_that_cannot_be_read(tmp_path):
    with pytest.raises(MissingFileError, match="nowhere"):
        read_grey_image(tmp_path / "nowhere.png")
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(UnknownFormatError, match=r"text\.png"):
        read_grey_image(tmp_path / "text.png")


def test_what_is_written_is_a_model(tmp_path):
    cv2.imwrite(str(tmp_path / "picture.png"), picture((30, 20, 59, 49)))
    lines = outline_dark_shapes(read_grey_image(tmp_path / "picture.png"), PINHOLE, 1.0)
    write_polylines(tmp_path / "model.json", lines)
    model = ObjectModel.from_polylines(tmp_path / "model.json")
    assert len(model.segments) == len(lines[0]) - 1
    assert torch.allclose(model.segments[0, 0], torch.tensor(lines[0][0], dtype=torch.float32), atol=1e-6)
