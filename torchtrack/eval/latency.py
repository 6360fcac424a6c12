"""How late a camera's time stamps are against the clock of the ground truth.

Events lie on the contours that caused them, where these were when they did. Against the contours at the time of the stamp
they lag behind by (normal velocity) x (latency), so the latency is the slope of a line: offset normal to the contour over
normal velocity of the contour, found by iteratively reweighted least squares. It starts at the best of a coarse grid. It can
be told from a lag in pixels only where speeds differ.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.camera import project, undistortion_table
from torchtrack.core.lie import transform_points
from torchtrack.errors import EventDataError
from torchtrack.object_model.contour_source import group_by_model
from torchtrack.run.session import Session
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.contours.sampling import mesh_contours

# Latencies that are tried first, µs.
_GRID_US = np.arange(-10_000, 50_001, 1500)
# The stream is looked at this often, for so long (µs), and at no more than so many events each time.
_LOOKS, _LOOK_US, _EVENTS_PER_LOOK = 100, 1000, 300
# One look in so many is enough to find where to start.
_EVERY_COARSE = 8
# An event further from every contour than this (px) was not caused by one.
_GATE_PX = 4.0
_ROUNDS = 6
# Velocities are differences over this time, µs.
_STEP_US = 500
# Offsets are weighted down beyond about this (px): Tukey's biweight.
_TUKEY_PX = 2.0
# How far events lie behind their contours at any speed, and how much that differs from scene to scene, px.
_USUAL_LAG_PX, _LAG_DEVIATION_PX = 0.1, 0.1
_LEAST_EVENTS = 200
_LEAST_SPEED_PX_S = 20.0


@dataclass(frozen=True)
class LatencyEstimate:
    """What was found.

    Args:
        latency_us: how much later events are stamped than they happened; ``sensor_latency_us`` takes it off.
        deviation_us: its standard deviation, by the scatter of the events and by what is not known of their lag in pixels.
        lag_px: how far events lie behind their contours at any speed: half a threshold's worth of blurred edge.
        before_px, after_px: median distance of the events from the contours, without and with the latency taken off.
        events: how many took part.
    """

    latency_us: float
    deviation_us: float
    lag_px: float
    before_px: float
    after_px: float
    events: int


@dataclass(frozen=True)
class _Look:
    """Some events of one short time: ideal pixels, and times."""

    pixels: Float[ndarray, "e 2"]
    t_us: Float[ndarray, "e"]


class _Truth:
    """The objects whose poses are known, and their contours."""

    def __init__(self, session: Session) -> None:
        known = [number for number, truth in enumerate(session.ground_truth) if truth is not None]
        self.trajectories = [truth for truth in session.ground_truth if truth is not None]
        self._models = group_by_model([session.models[number] for number in known], ContourConfig())
        self._intrinsics = session.camera.intrinsics(torch.float64).expand(len(known), -1)

    def poses(self, t_us: list[int]) -> Float[Tensor, "q o 4 4"]:
        """Poses of all objects at some times."""
        return torch.stack([truth.at(torch.tensor(t_us)) for truth in self.trajectories], 1)

    def contours(self, t_us: int) -> Contours:
        """Contours of all objects at one time; models are float32."""
        return mesh_contours(self._models, self.poses([t_us])[0].float(), self._intrinsics.float(), ContourConfig())

    def seen(self, contours: Contours, T_cam_obj: Float[Tensor, "o 4 4"]) -> Float[ndarray, "m 2"]:
        """The contours' pixels at other poses nearby."""
        return project(transform_points(T_cam_obj, contours.points_obj.double()), self._intrinsics)[contours.mask].numpy()


def estimate_latency(session: Session) -> LatencyEstimate:
    """The latency of a sequence with ground truth.

    Raises:
        EventDataError: if no object has ground truth, or too few events lie near moving contours.
    """
    if all(truth is None for truth in session.ground_truth):
        raise EventDataError(f"'{session.name}' has no ground truth to find the latency by.")
    truth, looks = _Truth(session), list(_looks(session))
    latency_us, deviation_us, lag_px, count = _coarse_latency_us(truth, looks[::_EVERY_COARSE]), float("nan"), 0.0, 0
    contours = [truth.contours(round(float(look.t_us.mean()) - latency_us)) for look in looks]
    for _ in range(_ROUNDS):
        offset, speed = _offsets(truth, looks, contours, latency_us)
        moving = np.abs(speed) > _LEAST_SPEED_PX_S
        offset, speed = offset[moving], speed[moving]
        if len(offset) < _LEAST_EVENTS:
            raise EventDataError(f"'{session.name}': only {len(offset)} events lie near moving contours; {_LEAST_EVENTS} are needed.")
        # Beside the latency there is a lag in pixels: the light must pass a threshold before a pixel fires, at any speed.
        design = -np.column_stack([1e-6 * speed, np.sign(speed)])
        weight = np.clip(1 - (offset - lag_px * design[:, 1]) ** 2 / (2 * _TUKEY_PX) ** 2, 0, None) ** 2
        # Where speeds hardly differ the two cannot be told apart: then the lag is the usual one.
        information = design.T @ (weight[:, None] * design) + np.diag([0.0, weight.sum()])
        target = design.T @ (weight * offset) + [0.0, weight.sum() * _USUAL_LAG_PX]
        (change_us, lag_px), count = np.linalg.solve(information, target), len(offset)
        scatter = weight * (offset - design @ [change_us, lag_px])
        of_scatter = np.linalg.norm((np.linalg.inv(information) @ (design * scatter[:, None]).T)[0])
        of_lag = 1e6 * _LAG_DEVIATION_PX / np.sqrt((weight * speed**2).sum() / weight.sum())
        deviation_us = float(np.hypot(of_scatter, of_lag))
        latency_us += float(change_us)
    before, after = (float(np.median(np.abs(_offsets(truth, looks, contours, at)[0]))) for at in (0.0, latency_us))
    return LatencyEstimate(latency_us, deviation_us, float(lag_px), before, after, count)


def _looks(session: Session) -> Iterator[_Look]:
    """Short pieces of the stream, spread evenly over the time that has ground truth, with room for every latency at both ends."""
    table = undistortion_table(session.camera).double().numpy()
    spans = [(int(truth.t_us[0]), int(truth.t_us[-1])) for truth in session.ground_truth if truth is not None]
    room_us = min(20_000, (spans[0][1] - spans[0][0]) // 10)
    starts = np.linspace(max(a for a, _ in spans) + room_us, min(b for _, b in spans) - room_us, _LOOKS).astype(np.int64)
    held = [np.zeros((0, 3)) for _ in starts]
    for chunk in session.chunks():
        t_us = chunk.t_us.numpy()
        for number, start in enumerate(starts):
            first, end = np.searchsorted(t_us, [start, start + _LOOK_US])
            chosen = np.unique(np.linspace(first, end - 1, min(_EVENTS_PER_LOOK, end - first)).astype(int)) if end > first else np.zeros(0, int)
            new = np.column_stack([chunk.x.numpy()[chosen], chunk.y.numpy()[chosen], t_us[chosen]])
            held[number] = np.concatenate([held[number], new])[:_EVENTS_PER_LOOK]
    for of_look in held:
        if len(of_look):
            x, y = of_look[:, 0].astype(int), of_look[:, 1].astype(int)
            yield _Look(table[y, x], of_look[:, 2])


def _coarse_latency_us(truth: _Truth, looks: list[_Look]) -> float:
    """The latency of the grid with which most events lie near contours, the nearer the better."""
    contours = [truth.contours(round(float(look.t_us.mean()))) for look in looks]

    def score(latency_us: float) -> float:
        offset, _ = _offsets(truth, looks, contours, latency_us)
        return float((1 - (offset / (2 * _GATE_PX)) ** 2).clip(0).sum())

    return max(_GRID_US.astype(float).tolist(), key=score)


def _offsets(truth: _Truth, looks: list[_Look], contours: list[Contours], latency_us: float) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """Of all events near a contour: distance along its normal (px), and the contour's velocity along its normal (px/s)."""
    parts = [_offsets_of_look(truth, look, of_look, latency_us) for look, of_look in zip(looks, contours, strict=True)]
    return np.concatenate([offset for offset, _ in parts]), np.concatenate([speed for _, speed in parts])


def _offsets_of_look(truth: _Truth, look: _Look, contours: Contours, latency_us: float) -> tuple[Float[ndarray, "n"], Float[ndarray, "n"]]:
    """:func:`_offsets` of one look; each event is carried to the middle of the look by the velocity of its contour."""
    middle_us = round(float(look.t_us.mean()) - latency_us)
    pixels, before, after = (truth.seen(contours, T) for T in truth.poses([middle_us, middle_us - _STEP_US, middle_us + _STEP_US]))
    normals = contours.normals[contours.mask].double().numpy()
    if not len(pixels):
        return np.zeros(0), np.zeros(0)
    distance, nearest = cKDTree(pixels).query(look.pixels, distance_upper_bound=_GATE_PX)
    near = np.isfinite(distance)
    nearest = nearest[near]
    speed = ((after - before)[nearest] * normals[nearest]).sum(1) / (2e-6 * _STEP_US)
    offset = ((look.pixels[near] - pixels[nearest]) * normals[nearest]).sum(1)
    return offset - speed * 1e-6 * (look.t_us[near] - latency_us - middle_us), speed
