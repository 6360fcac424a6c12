"""Refining poses from points and pixels: ours for all poses at once, SciPy and OpenCV one after the other, PyPose and Theseus.

Every pose has 100 points of which both coordinates are seen: the 200 residuals are the same for all, and so is the optimum.
Ours always takes ten iterations; others take at most so many, and may stop when they have converged.
PyPose's batched solver works on one dense system for all poses, which takes far longer than one pose after the other: the
latter is what is measured.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from torchtrack.bench.peers.comparison import Comparison, Work
from torchtrack.bench.plots import Plot
from torchtrack.bench.results import Result
from torchtrack.bench.solver import CAMERA, ITERATIONS, poses_of_points
from torchtrack.config.tracker import SolverConfig
from torchtrack.tracking.estimation.levenberg_marquardt import solve_pose

COUNTS = (1, 8, 32, 128, 1024)
# A peer that would take longer than this for one run is not measured at this size (s).
MOST_S = 3.0
# Ours is to be ahead of these, of OpenCV from so many poses on.
_TO_LEAD, _LEAD_OPENCV_FROM = ("PyPose", "Theseus", "OpenCV"), 32
# Poses that are so near are the same: ours are float32.
_SAME_DEG, _SAME_MM = 0.02, 0.1
_FOCAL, _CENTRE = np.array([CAMERA.fx, CAMERA.fy]), np.array([CAMERA.cx, CAMERA.cy])
_CONFIG = SolverConfig(iterations=ITERATIONS, loss="none")


@dataclass(frozen=True)
class PointPoses:
    """Points, their pixels and first poses, as every library takes them."""

    points: Float[ndarray, "b n 3"]
    pixels: Float[ndarray, "b n 2"]
    T_start: Float[ndarray, "b 4 4"]


@dataclass(frozen=True)
class Ours:
    """What torchtrack made of so many poses."""

    given: PointPoses
    T_found: Float[ndarray, "b 4 4"]
    result: Result


def compare(comparison: Comparison) -> None:
    """Measure all that are here, at growing numbers of poses."""
    ours = {count: _ours(comparison, count) for count in COUNTS}
    series = {"torchtrack": tuple((float(count), our.result.median) for count, our in ours.items())}
    for name, (package, make) in PEERS.items():
        points = tuple(_of_peer(comparison, name, package, make, ours))
        series |= {name: points} if points else {}
    comparison.plots.append(Plot("poses", "Refining poses", "poses at once", "ms", series))


def _ours(comparison: Comparison, count: int) -> Ours:
    given = poses_of_points(count, comparison.setup.device)

    def solve() -> torch.Tensor:
        with torch.inference_mode():
            return solve_pose(given.problem, given.T_start, _CONFIG).T_cam_obj

    result = comparison.time(f"B={count}: torchtrack", solve)
    # Every point is there twice, once for each coordinate.
    arrays = (value[:, ::2] for value in (given.problem.points_obj, given.problem.targets))
    plain = PointPoses(*(value.cpu().double().numpy().copy() for value in (*arrays, given.T_start)))
    return Ours(plain, solve().cpu().double().numpy(), result)


def _of_peer(
    comparison: Comparison, name: str, package: str, make: Callable[[PointPoses], Work], ours: dict[int, Ours]
) -> Iterator[tuple[float, float]]:
    """Number of poses and time (ms), as far as one run stays short."""
    each_s = 0.0
    for count, our in ours.items():
        if each_s * count > MOST_S:
            comparison.notes.append(f"{name}: not measured from B={count} on, where one run would take {each_s * count:.0f} s")
            return
        work = comparison.prepare(name, package, partial(make, our.given))
        if work is None:
            return
        timing = comparison.time(f"B={count}: {name}", work)
        each_s = 1e-3 * timing.median / count
        must_lead = name != "OpenCV" or count >= _LEAD_OPENCV_FROM
        comparison.ahead(timing, our.result, 1.0 if name in _TO_LEAD and must_lead else None)
        _compare_poses(comparison, timing.name, our.T_found, np.asarray(work()))
        yield float(count), timing.median


def _compare_poses(comparison: Comparison, name: str, ours: Float[ndarray, "b 4 4"], theirs: Float[ndarray, "b 4 4"]) -> None:
    """Note how far the poses are from ours."""
    turned_deg = np.degrees(Rotation.from_matrix(ours[:, :3, :3].swapaxes(1, 2) @ theirs[:, :3, :3]).magnitude())
    moved_mm = 1e3 * np.linalg.norm((ours - theirs)[:, :3, 3], axis=-1)
    same = "the same poses as ours" if turned_deg.max() < _SAME_DEG and moved_mm.max() < _SAME_MM else "other poses than ours"
    comparison.notes.append(f"{name}: {same}, to {turned_deg.max():.4f}° and {moved_mm.max():.4f} mm")


def _scipy(given: PointPoses) -> Work:
    """Least squares with the exact Jacobian, one pose after the other."""

    def solve_one(points: ndarray, pixels: ndarray, T_start: ndarray) -> ndarray:
        turned, start = points @ T_start[:3, :3].T, T_start[:3, 3]

        def moved(step: ndarray) -> ndarray:
            return turned @ Rotation.from_rotvec(step[:3]).as_matrix().T + start + step[3:]

        def residuals(step: ndarray) -> ndarray:
            p = moved(step)
            return (p[:, :2] / p[:, 2:] * _FOCAL + _CENTRE - pixels).ravel()

        def jacobian(step: ndarray) -> ndarray:
            p = moved(step)
            inverse = 1 / p[:, 2]
            d = np.zeros((len(p), 2, 3))
            d[:, 0, 0], d[:, 1, 1] = _FOCAL[0] * inverse, _FOCAL[1] * inverse
            d[:, :, 2] = -_FOCAL * p[:, :2] * (inverse**2)[:, None]
            # To first order in the rotation, which stays small: d(R p) = -[p]x dφ.
            q = p - start - step[3:]
            turning = np.stack([np.cross(q, d[:, row]) for row in range(2)], 1)
            return np.concatenate([turning, d], -1).reshape(-1, 6)

        step = least_squares(residuals, np.zeros(6), jacobian, method="lm", max_nfev=ITERATIONS).x
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(step[:3]).as_matrix() @ T_start[:3, :3], start + step[3:]
        return T

    return lambda: np.stack([solve_one(*problem) for problem in zip(given.points, given.pixels, given.T_start, strict=True)])


def _opencv(given: PointPoses) -> Work:
    """``solvePnPRefineLM``, one pose after the other."""
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, ITERATIONS, 0.0)
    matrix = CAMERA.intrinsics(torch.float64)
    K = np.array([[matrix[0], 0, matrix[2]], [0, matrix[1], matrix[3]], [0, 0, 1]])

    def solve_one(points: ndarray, pixels: ndarray, T_start: ndarray) -> ndarray:
        rotation, _ = cv2.Rodrigues(T_start[:3, :3])
        rotation, translation = cv2.solvePnPRefineLM(points, pixels, K, None, rotation, T_start[:3, 3:].copy(), criteria)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        return T

    return lambda: np.stack([solve_one(*problem) for problem in zip(given.points, given.pixels, given.T_start, strict=True)])


def _pypose(given: PointPoses) -> Work:
    """``optim.LM`` with its Jacobian by automatic differentiation, one pose after the other."""
    import pypose

    focal, centre = torch.from_numpy(_FOCAL), torch.from_numpy(_CENTRE)

    class Model(torch.nn.Module):
        def __init__(self, T_start: torch.Tensor) -> None:
            super().__init__()
            self.pose = pypose.Parameter(pypose.mat2SE3(T_start))

        def forward(self, points: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
            p = self.pose.Act(points)
            return p[:, :2] / p[:, 2:] * focal + centre - pixels

    def solve_one(points: torch.Tensor, pixels: torch.Tensor, T_start: torch.Tensor) -> ndarray:
        model = Model(T_start)
        optimiser = pypose.optim.LM(model, strategy=pypose.optim.strategy.Adaptive(damping=1e-6))
        for _ in range(ITERATIONS):
            optimiser.step((points, pixels))
        return model.pose.matrix().detach().numpy()

    tensors = [torch.from_numpy(value) for value in (given.points, given.pixels, given.T_start)]
    return lambda: np.stack([solve_one(*problem) for problem in zip(*tensors, strict=True)])


def _theseus(given: PointPoses) -> Work:
    """Its Levenberg-Marquardt, for all poses at once, with the Jacobian by automatic differentiation."""
    import theseus

    points, pixels, T_start = (torch.from_numpy(value) for value in (given.points, given.pixels, given.T_start))
    focal, centre = torch.from_numpy(_FOCAL), torch.from_numpy(_CENTRE)

    def residuals(optim_vars: Any, aux_vars: Any) -> torch.Tensor:
        (pose,), (seen, at) = optim_vars, aux_vars
        matrix = pose.tensor
        p = seen.tensor.unflatten(1, (-1, 3)) @ matrix[:, :, :3].transpose(1, 2) + matrix[:, None, :, 3]
        return (p[..., :2] / p[..., 2:] * focal + centre - at.tensor.unflatten(1, (-1, 2))).flatten(1)

    pose = theseus.SE3(tensor=T_start[:, :3].clone(), name="pose", strict_checks=False)
    given_vars = [theseus.Variable(value.flatten(1), name=name) for name, value in (("points", points), ("pixels", pixels))]
    objective = theseus.Objective(dtype=torch.float64)
    weight = theseus.ScaleCostWeight(torch.ones(1, 1, dtype=torch.float64))
    cost = theseus.AutoDiffCostFunction([pose], residuals, 2 * points.shape[1], cost_weight=weight, aux_vars=given_vars, autograd_mode="vmap")
    objective.add(cost)
    layer = theseus.TheseusLayer(theseus.LevenbergMarquardt(objective, max_iterations=ITERATIONS, abs_err_tolerance=0, rel_err_tolerance=0))

    def solve() -> ndarray:
        with torch.no_grad():
            solved, _ = layer.forward({"pose": T_start[:, :3]}, optimizer_kwargs={"damping": 1e-6})
        last = torch.tensor([[[0.0, 0.0, 0.0, 1.0]]], dtype=torch.float64).expand(len(T_start), 1, 4)
        return torch.cat([solved["pose"], last], 1).numpy()

    return solve


PEERS: dict[str, tuple[str, Callable[[PointPoses], Work]]] = {
    "SciPy": ("scipy", _scipy),
    "OpenCV": ("opencv-python-headless", _opencv),
    "PyPose": ("pypose", _pypose),
    "Theseus": ("theseus-ai", _theseus),
}
"""How pip calls each, and what makes its work."""
