"""Alignment of events and contours over a run, at the tracked pose and at the one that it started from."""

from array import array
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import cKDTree

from torchtrack.core.camera import undistortion_table
from torchtrack.run.session import Session
from torchtrack.run.stepping import Step
from torchtrack.tracking.contours.points import reproject


class AlignmentRecord:
    """Measures every window; what it found is in :meth:`facts`."""

    def __init__(self, session: Session) -> None:
        self._labels = session.labels
        self._initial = session.T_cam_obj
        self._table = undistortion_table(session.camera).double().numpy()
        self._intrinsics = session.camera.intrinsics(torch.float64).expand(len(session.labels), 4)
        self._median_px = {name: [array("d") for _ in session.labels] for name in ("tracked", "initial")}
        self._share = {name: [array("d") for _ in session.labels] for name in ("tracked", "initial")}

    def add(self, step: Step) -> None:
        """Measure one window."""
        events = step.window.events
        pixels = self._table[events.y.cpu().numpy(), events.x.cpu().numpy()]
        tracked = step.result.contours
        as_stored = replace(tracked, points_obj=tracked.points_obj.cpu().double(), tangents_obj=tracked.tangents_obj.cpu().double())
        initial = reproject(as_stored, self._initial, self._intrinsics)
        for name, contours in (("tracked", tracked), ("initial", initial)):
            for index in range(len(self._labels)):
                seen = tracked.mask[index].cpu()
                aligned = alignment(pixels, contours.pixels[index].cpu()[seen].double().numpy(), contours.normals[index].cpu()[seen].double().numpy())
                self._median_px[name][index].append(aligned.median_px)
                self._share[name][index].append(aligned.share_near)

    def close(self) -> None:
        """Nothing is open."""

    def facts(self) -> dict[str, dict[str, Any]]:
        """By label: medians over the windows at the tracked and at the initial pose."""
        return {label: {"alignment": {name: self._of(name, index) for name in self._median_px}} for index, label in enumerate(self._labels)}

    def _of(self, name: str, index: int) -> dict[str, float]:
        medians, shares = np.array(self._median_px[name][index]), np.array(self._share[name][index])
        return {"median_px": _median(medians[np.isfinite(medians)]), "share_near": _median(shares)}


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")


# Events further from every contour point say nothing about an object.
GATE_PX = 10.0


@dataclass(frozen=True)
class Alignment:
    """Events and the contours of one object.

    Args:
        median_px: median distance of the events near the contours, normal to them; NaN where there is none.
        share_near: share of all events that are near the contours.
    """

    median_px: float
    share_near: float


def alignment(events: Float[ndarray, "e 2"], contour: Float[ndarray, "m 2"], normals: Float[ndarray, "m 2"]) -> Alignment:
    """Alignment of events with contour points, all in ideal pixels; an event counts towards its nearest point."""
    if len(events) == 0 or len(contour) == 0:
        return Alignment(float("nan"), 0.0)
    distance, nearest = cKDTree(contour).query(events, distance_upper_bound=GATE_PX)
    near = np.isfinite(distance)
    if not near.any():
        return Alignment(float("nan"), 0.0)
    offsets = events[near] - contour[nearest[near]]
    normal_px = np.abs((offsets * normals[nearest[near]]).sum(1))
    return Alignment(float(np.median(normal_px)), float(near.mean()))
