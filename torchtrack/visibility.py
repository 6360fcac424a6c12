"""Hidden contours: a coarse depth buffer that all objects of a stream share."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchtrack.camera import MIN_DEPTH_M, project
from torchtrack.config.tracker import ContourConfig
from torchtrack.contours import Contours
from torchtrack.lie import transform_points


def depth_buffer(
    models: nn.ModuleList,
    members: Sequence[Int[Tensor, "g"]],
    T_cam_obj: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 4"],
    stream_index: Int[Tensor, "b"],
    buffer_shape: tuple[int, int, int],
    cell_px: int,
) -> Float[Tensor, "s h w"]:
    """Least depth (m) of any object's surface samples in each cell; infinite where there is none.

    Args:
        buffer_shape: streams, and rows and columns of cells; samples outside the image fall into the border cells.
    """
    _, rows, columns = buffer_shape
    cells, depths = [], []
    for model, index in zip(models, members, strict=True):
        points = transform_points(T_cam_obj[index], model.surface_points.expand(len(index), -1, -1))
        cell = _cell(project(points, intrinsics[index]), buffer_shape, cell_px)
        depth = points[..., 2]
        cells.append((cell + stream_index[index, None] * (rows * columns)).flatten())
        depths.append(torch.where(depth > MIN_DEPTH_M, depth, torch.inf).flatten())
    buffer = T_cam_obj.new_full((buffer_shape[0] * rows * columns,), torch.inf)
    return buffer.scatter_reduce(0, torch.cat(cells), torch.cat(depths), "amin").view(buffer_shape)


def _cell(pixels: Tensor, buffer_shape: tuple[int, int, int], cell_px: int) -> Tensor:
    """Flat index of the cell that each pixel falls into; one border cell on each side takes what lies outside."""
    _, rows, columns = buffer_shape
    # Clamped before the conversion: a far-off pixel does not fit an integer.
    u = (pixels[..., 0] / cell_px).round().clamp(-1, columns - 2).long() + 1
    v = (pixels[..., 1] / cell_px).round().clamp(-1, rows - 2).long() + 1
    return v * columns + u


def remove_hidden(
    contours: Contours,
    models: nn.ModuleList,
    members: Sequence[Int[Tensor, "g"]],
    T_cam_obj: Float[Tensor, "b 4 4"],
    intrinsics: Float[Tensor, "b 4"],
    stream_index: Int[Tensor, "b"],
    diameters_m: Float[Tensor, "b"],
    image_shape: tuple[int, int, int],
    config: ContourConfig,
) -> Contours:
    """Contours without the points that lie behind a surface of any object of their stream.

    Args:
        image_shape: streams, height and width of the image.
    """
    streams, height, width = image_shape
    cell_px = config.depth_cell_px
    shape = (streams, -(-height // cell_px) + 3, -(-width // cell_px) + 3)
    buffer = depth_buffer(models, members, T_cam_obj, intrinsics, stream_index, shape, cell_px)
    nearest = buffer.flatten(1)[stream_index].gather(1, _cell(contours.pixels, shape, cell_px))
    visible = contours.points_cam[..., 2] < nearest + config.depth_margin * diameters_m[:, None]
    return replace(contours, mask=contours.mask & visible)
