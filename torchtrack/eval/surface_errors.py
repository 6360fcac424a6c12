"""Errors of poses as distances of the object's points, by the formulas of bop_toolkit; poses in metres, so errors in metres.

- ADD, ADD-S: Hinterstoisser et al., "Model based training, detection and pose estimation of texture-less 3D objects in heavily
  cluttered scenes" (ACCV 2012). bop_toolkit calls them ``add`` and ``adi``.
- MSSD, MSPD: Hodan et al., "BOP challenge 2020 on 6D object localization" (ECCVW 2020).
- AUC: Xiang et al., "PoseCNN" (RSS 2018).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from torchtrack.core.lie import transform_points
from torchtrack.errors import PoseError
from torchtrack.object_model import ObjectModel

# AUC counts errors up to 10 cm, as on YCB-Video.
AUC_LIMIT_M = 0.1
# Recall counts errors below a tenth of the diameter, as on LINEMOD.
RECALL_DIAMETERS = 0.1
# So many points stand for the surface.
_MOST_POINTS = 1000


def model_points(model: ObjectModel) -> Float[Tensor, "n 3"]:
    """Points that stand for an object's surface (float64): its uniform samples, or the ends of its lines; at most 1,000."""
    points = model.extent_points
    return points[:: -(-len(points) // _MOST_POINTS)].double()


def add_m(T_cam_obj: Float[Tensor, "p 4 4"], T_true: Float[Tensor, "p 4 4"], points_obj: Float[Tensor, "n 3"]) -> Float[Tensor, "p"]:
    """ADD: mean distance of each point from where it truly is."""
    return (_moved(T_cam_obj, points_obj) - _moved(T_true, points_obj)).norm(dim=-1).mean(-1)


def adds_m(T_cam_obj: Float[Tensor, "p 4 4"], T_true: Float[Tensor, "p 4 4"], points_obj: Float[Tensor, "n 3"]) -> Float[Tensor, "p"]:
    """ADD-S: mean distance from where each point truly is to the nearest of all points; for objects that look the same from several sides."""
    pairs = zip(_moved(T_cam_obj, points_obj).numpy(), _moved(T_true, points_obj).numpy(), strict=True)
    return torch.tensor([cKDTree(estimated).query(true)[0].mean() for estimated, true in pairs], dtype=torch.float64)


def mssd_m(
    T_cam_obj: Float[Tensor, "p 4 4"], T_true: Float[Tensor, "p 4 4"], points_obj: Float[Tensor, "n 3"], symmetries: Float[Tensor, "s 4 4"]
) -> Float[Tensor, "p"]:
    """MSSD: largest distance of a point from where it truly is, for that of the ``symmetries`` of the object (with identity) that fits best."""
    estimated = _moved(T_cam_obj, points_obj)
    errors = [(estimated - _moved(T_true @ symmetry, points_obj)).norm(dim=-1).amax(-1) for symmetry in symmetries.double()]
    return torch.stack(errors).amin(0)


def mspd_px(
    T_cam_obj: Float[Tensor, "p 4 4"],
    T_true: Float[Tensor, "p 4 4"],
    points_obj: Float[Tensor, "n 3"],
    symmetries: Float[Tensor, "s 4 4"],
    K: Float[Tensor, "3 3"],
) -> Float[Tensor, "p"]:
    """MSPD: as :func:`mssd_m`, with distances in the image of a camera with the matrix ``K`` (px)."""

    def pixels(T: Tensor) -> Tensor:
        projected = _moved(T, points_obj) @ K.double().mT
        return projected[..., :2] / projected[..., 2:]

    estimated = pixels(T_cam_obj)
    errors = [(estimated - pixels(T_true @ symmetry)).norm(dim=-1).amax(-1) for symmetry in symmetries.double()]
    return torch.stack(errors).amin(0)


def auc(errors_m: Float[Tensor, "p"], limit_m: float = AUC_LIMIT_M) -> float:
    """Area under the curve of the share of errors within a threshold, over thresholds up to a limit; 0 to 1, as YCB-Video's toolbox has it.

    Where no error is within the limit, it is 0 (some ports of that toolbox say NaN there). NaN without errors.
    """
    if len(errors_m) == 0:
        return float("nan")
    within = np.sort(errors_m.numpy()[errors_m.numpy() <= limit_m])
    if len(within) == 0:
        return 0.0
    shares = np.arange(1, len(within) + 1) / len(errors_m)
    # Up to each error counts the share that it makes; after the last one nothing is added.
    return float(np.diff([0.0, *within, limit_m]) @ [*shares, shares[-1]] / limit_m)


@dataclass(frozen=True)
class SurfaceErrors:
    """ADD and ADD-S of one object over a sequence; NaN where no window has a truth.

    Args:
        mean_add_mm, mean_adds_mm: over all windows.
        auc_add, auc_adds: up to 10 cm.
        recall_add: share of windows with an ADD under a tenth of the diameter.
    """

    mean_add_mm: float
    mean_adds_mm: float
    auc_add: float
    auc_adds: float
    recall_add: float


def surface_errors(T_cam_obj: Float[Tensor, "p 4 4"], T_true: Float[Tensor, "p 4 4"], model: ObjectModel) -> SurfaceErrors:
    """ADD and ADD-S of estimated poses against true ones."""
    if len(T_cam_obj) == 0:
        return SurfaceErrors(*[float("nan")] * 5)
    points = model_points(model)
    add, adds = add_m(T_cam_obj, T_true, points), adds_m(T_cam_obj, T_true, points)
    recall = float((add < RECALL_DIAMETERS * model.diameter_m).double().mean())
    return SurfaceErrors(1e3 * float(add.mean()), 1e3 * float(adds.mean()), auc(add), auc(adds), recall)


def symmetries_of(matrices: Sequence[Sequence[Sequence[float]]] = ()) -> Float[Tensor, "s 4 4"]:
    """The identity and further symmetries ``T_obj_obj``, such as ``symmetries_discrete`` of BOP's ``models_info.json`` in metres.

    Raises:
        PoseError: if one is no 4x4 matrix.
    """
    identity = torch.eye(4, dtype=torch.float64)[None]
    if not len(matrices):
        return identity
    further = torch.as_tensor(np.asarray(matrices), dtype=torch.float64)
    if further.shape[1:] != (4, 4):
        raise PoseError(f"symmetries are matrices of shape [s, 4, 4], got {list(further.shape)}.")
    return torch.cat([identity, further])


def _moved(T: Float[Tensor, "p 4 4"], points_obj: Float[Tensor, "n 3"]) -> Float[Tensor, "p n 3"]:
    return transform_points(T.double(), points_obj.double().expand(len(T), -1, 3))
