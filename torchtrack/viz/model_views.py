"""A picture of a model from its six sides, with the contours that the tracker would use there.

In goes an :class:`ObjectModel`, out comes one BGR image of two rows of three views. Smooth silhouettes are red, creases white, texture
edges yellow, and segments of polylines blue; the axes of the object's frame are red, green and blue, at its origin.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import MIN_DEPTH_M, project
from torchtrack.core.lie import transform_points
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.contour_source import ContourKind, group_by_model
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.contours.points import Contours

_SIDE_PX, _LEGEND_PX = 400, 34
# The diameter is this share of a view, where it lies across; the camera is so many diameters away.
_FILLED, _DISTANCE = 1.1, 4.0
_STROKE_PX, _FRACTION_BITS = 2.0, 4
_BACKGROUND, _TEXT, _GRID = (40, 36, 32), (230, 230, 230), (70, 66, 62)
_COLOURS = {
    ContourKind.SMOOTH: ("smooth silhouette", (60, 60, 255)),
    ContourKind.CREASE: ("crease", (255, 255, 255)),
    ContourKind.TEXTURE: ("texture", (0, 220, 255)),
    ContourKind.SEGMENT: ("segment", (255, 160, 60)),
}
_AXES = ((60, 60, 255), (80, 255, 80), (255, 120, 40))


@dataclass(frozen=True)
class _View:
    """One side: its name, and where the image's right and down point in the object's frame."""

    name: str
    right: tuple[int, int, int]
    down: tuple[int, int, int]


_VIEWS = (
    _View("from +x", (0, 1, 0), (0, 0, -1)),
    _View("from +y", (-1, 0, 0), (0, 0, -1)),
    _View("from +z", (1, 0, 0), (0, -1, 0)),
    _View("from -x", (0, -1, 0), (0, 0, -1)),
    _View("from -y", (1, 0, 0), (0, 0, -1)),
    _View("from -z", (-1, 0, 0), (0, -1, 0)),
)


def view_poses(model: ObjectModel) -> Float[Tensor, "6 4 4"]:
    """``T_cam_obj`` of a camera before each side of the model, its middle on the optical axis (float32)."""
    poses = torch.eye(4).repeat(len(_VIEWS), 1, 1)
    for pose, view in zip(poses, _VIEWS, strict=True):
        right, down = torch.tensor(view.right, dtype=torch.float32), torch.tensor(view.down, dtype=torch.float32)
        pose[:3, :3] = torch.stack([right, down, torch.linalg.cross(right, down)])
        pose[:3, 3] = torch.tensor([0.0, 0.0, _DISTANCE * model.diameter_m]) - pose[:3, :3] @ model.centre
    return poses


def view_contours(model: ObjectModel, T_cam_obj: Float[Tensor, "v 4 4"]) -> Contours:
    """Contours that the tracker would use at each pose, hidden ones left out."""
    count, config = len(T_cam_obj), ContourConfig()
    batch = ObjectBatch(
        group_by_model([model] * count, config),
        _intrinsics().expand(count, 4),
        model.centre.expand(count, 3),
        model.half_extent.expand(count, 3),
        torch.full((count,), model.diameter_m),
        torch.arange(count),
        torch.full((count, 2), _SIDE_PX),
        (count, _SIDE_PX, _SIDE_PX),
        False,
    )
    with torch.inference_mode():
        return batch.contours(T_cam_obj, config)


def draw_model(model: ObjectModel) -> UInt8[np.ndarray, "h w 3"]:
    """The picture (BGR) of the six views, with a legend below."""
    poses = view_poses(model)
    contours = view_contours(model, poses)
    tiles = [_tile(model, contours, number, poses[number]) for number in range(len(_VIEWS))]
    rows = [np.concatenate(tiles[start : start + 3], 1) for start in (0, 3)]
    return np.concatenate([*rows, _legend(contours, model, 3 * _SIDE_PX)])


def _intrinsics() -> Float[Tensor, "4"]:
    focal = _FILLED * _SIDE_PX * _DISTANCE
    return torch.tensor([focal, focal, (_SIDE_PX - 1) / 2, (_SIDE_PX - 1) / 2])


def _tile(model: ObjectModel, contours: Contours, number: int, T_cam_obj: Float[Tensor, "4 4"]) -> np.ndarray:
    image = np.full((_SIDE_PX, _SIDE_PX, 3), _BACKGROUND, dtype=np.uint8)
    cv2.rectangle(image, (0, 0), (_SIDE_PX - 1, _SIDE_PX - 1), _GRID, 1)
    # Creases on top: where a silhouette is one, too, it is a crease.
    for kind in (ContourKind.TEXTURE, ContourKind.SMOOTH, ContourKind.SEGMENT, ContourKind.CREASE):
        shown = contours.mask[number] & (contours.kind[number] == int(kind))
        _draw_strokes(image, contours.pixels[number][shown].numpy(), contours.normals[number][shown].numpy(), _COLOURS[kind][1])
    _draw_axes(image, model, T_cam_obj)
    cv2.putText(image, _VIEWS[number].name, (10, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
    return image


def _draw_strokes(image: np.ndarray, pixels: Float[np.ndarray, "m 2"], normals: Float[np.ndarray, "m 2"], colour: tuple[int, int, int]) -> None:
    """A short line along the contour at each of its points: together they are lines, where points alone would be scattered dots."""
    along = _STROKE_PX * np.stack([normals[:, 1], -normals[:, 0]], 1)
    ends = np.stack([pixels - along, pixels + along], 1) * (1 << _FRACTION_BITS)
    cv2.polylines(image, list(np.round(ends).astype(np.int32)), False, colour, 1, cv2.LINE_AA, _FRACTION_BITS)


def _draw_axes(image: np.ndarray, model: ObjectModel, T_cam_obj: Float[Tensor, "4 4"]) -> None:
    """The axes of the object's frame, where its origin is in the picture."""
    tips = torch.cat([torch.zeros(1, 3), 0.2 * model.diameter_m * torch.eye(3)])
    points = transform_points(T_cam_obj, tips)
    if bool((points[:, 2] <= MIN_DEPTH_M).any()):
        return
    pixels = project(points[None], _intrinsics()[None])[0]
    if bool((pixels.abs() > 10 * _SIDE_PX).any()):
        return
    origin, *ends = ((round(u), round(v)) for u, v in pixels.tolist())
    for end, colour in zip(ends, _AXES, strict=True):
        cv2.line(image, origin, end, colour, 1, cv2.LINE_AA)


def _legend(contours: Contours, model: ObjectModel, width: int) -> np.ndarray:
    image = np.full((_LEGEND_PX, width, 3), _BACKGROUND, dtype=np.uint8)
    left = 10
    for kind, (name, colour) in _COLOURS.items():
        text = f"{name} {int((contours.mask & (contours.kind == int(kind))).sum())}"
        cv2.putText(image, text, (left, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, 1, cv2.LINE_AA)
        left += 190
    x, y, z = (1000 * 2 * model.half_extent).tolist()
    cv2.putText(image, f"{x:.1f} x {y:.1f} x {z:.1f} mm", (left, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _TEXT, 1, cv2.LINE_AA)
    return image
