"""A run in the Rerun viewer, on one time line: what the camera sees, where objects are, and how sure the tracker is.

The world is the camera's frame. Logged per window: the events as an image; of each object its contours, the events near them with their
distance to the contour, its pose and recent path, the true pose where it is known, status, quality, standard deviations and errors; and how
long the tracker's step, each of its stages and all else took.
"""

import re
import time
from collections import deque
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from scipy.spatial import cKDTree

from torchtrack.core.atomic import check_writable, writing
from torchtrack.core.camera import distort, project, undistortion_table
from torchtrack.core.events import EventBatch
from torchtrack.core.lie import transform_points
from torchtrack.errors import ConfigError
from torchtrack.io.extras import optional
from torchtrack.object_model.symmetry import revolution_axis
from torchtrack.run.metrics import pose_errors
from torchtrack.run.session import Session
from torchtrack.run.sinks.moment import Moment, ObjectMoment, VisibleContour, moment_of
from torchtrack.run.stepping import Step
from torchtrack.tracking.validation.status import Status
from torchtrack.viz.contour_lines import contour_links

LIVE = "live"
# Of the viewer: the package, the extra that brings it, and what it is for.
_PACKAGE = ("rerun-sdk", "viz", "showing a run in Rerun")
# Darker and brighter events in the image.
_OFF, _ON = 110, 230
# Events are compared with contours up to this distance (px), and so many of them are drawn of each object.
_NEAR_PX, _MOST_SHOWN = 4.0, 400
# Windows of the path that is drawn behind an object.
_PATH_WINDOWS = 200
_RED, _GREEN, _YELLOW = (255, 40, 40), (80, 255, 80), (255, 220, 0)


def check_target(target: str) -> None:
    """Raise where a run cannot be shown: :class:`ConfigError` for a wrong name, OutputError, or MissingExtraError."""
    optional("rerun", *_PACKAGE)
    if target != LIVE:
        if Path(target).suffix != ".rrd":
            raise ConfigError(f"rerun: '{target}' is neither 'live', which opens the viewer, nor a file that ends in .rrd.")
        check_writable(target)


class RerunLog:
    """Logs the steps of a run.

    Args:
        target: ``live`` opens the viewer; else the file to write, which ends in ``.rrd``.
        session: what is tracked.

    Raises:
        ConfigError, OutputError, MissingExtraError: as :func:`check_target`.
    """

    def __init__(self, target: str, session: Session) -> None:
        check_target(target)
        self._rr: Any = optional("rerun", *_PACKAGE)
        self._session = session
        self._table = undistortion_table(session.camera).double().numpy()
        self._paths: list[deque[list[float]]] = [deque(maxlen=_PATH_WINDOWS) for _ in session.labels]
        # Turns that nothing shows are no errors, as in the summary.
        self._axes = [revolution_axis(model) for model in session.models]
        self._status: dict[str, int] = {}
        self._newest_s = time.perf_counter()
        self._recording = self._rr.RecordingStream(f"torchtrack: {session.name}")
        blueprint = self._blueprint()
        if target == LIVE:
            self._recording.spawn(default_blueprint=blueprint)
        else:
            with writing(target):
                self._recording.save(target, default_blueprint=blueprint)
        self._log_scene()

    def _blueprint(self) -> Any:
        """Camera and scene above, curves and status below."""
        views = optional("rerun.blueprint", *_PACKAGE)
        curves = [
            views.TimeSeriesView(origin=f"plots/{name}", name=name) for name in ("quality", "status", "error", "std", "residual", "time", "stages")
        ]
        above = views.Horizontal(views.Spatial2DView(origin="camera", name="camera"), views.Spatial3DView(origin="/", name="scene"))
        return views.Blueprint(views.Vertical(above, views.Horizontal(*curves, views.TextLogView(origin="status", name="status")), row_shares=[3, 1]))

    def _log_scene(self) -> None:
        """What stays as it is: camera and models."""
        camera, rr = self._session.camera, self._rr
        self._log("/", rr.ViewCoordinates.RDF, static=True)
        pinhole = rr.Pinhole(image_from_camera=camera.matrix, width=camera.width, height=camera.height, camera_xyz=rr.ViewCoordinates.RDF)
        self._log("camera", pinhole, static=True)
        for label, model, truth in zip(self._session.labels, self._session.models, self._session.ground_truth, strict=True):
            if model.mesh is None:
                continue
            for place, colour in (("objects", (200, 205, 215, 255)), *((("truth", (*_GREEN, 70)),) if truth is not None else ())):
                mesh = rr.Mesh3D(vertex_positions=model.mesh.vertices, triangle_indices=model.mesh.faces, albedo_factor=colour)
                self._log(f"{place}/{label}", mesh, static=True)

    def _log(self, path: str, what: Any, *, static: bool = False) -> None:
        self._recording.log(path, what, static=static)

    def add(self, step: Step) -> None:
        """Log one step of a run."""
        now_s = time.perf_counter()
        times_ms = {"time/step": 1e3 * step.seconds, "time/all_else": max(1e3 * (now_s - self._newest_s - step.seconds), 0.0)}
        times_ms |= {f"stages/{path_of(stage)}": 1e3 * seconds for stage, seconds in step.stages.items()}
        self.show(moment_of(step, times_ms))
        self._newest_s = time.perf_counter()

    def show(self, moment: Moment) -> None:
        """Log what is to be shown of one window."""
        rr, events = self._rr, moment.events
        self._recording.set_time("time", duration=1e-6 * moment.t_us)
        image = event_png(events, self._session.camera.width, self._session.camera.height)
        self._log("camera/events", rr.EncodedImage(contents=image, media_type="image/png"))
        for name, value_ms in moment.times_ms.items():
            self._log(f"plots/{name}_ms", rr.Scalars(value_ms))
        seen = self._table[events.y.cpu().numpy(), events.x.cpu().numpy()]
        for index, (label, of_object) in enumerate(zip(self._session.labels, moment.objects, strict=True)):
            self._log_pose(label, index, of_object)
            self._log_truth(moment.t_us, index, of_object)
            self._log_contour(label, of_object.contour, seen)
            self._log_scalars(label, "std", dict(zip(("rotation_deg", "position_cm"), of_object.std, strict=True)))

    def _log_pose(self, label: str, index: int, of_object: ObjectMoment) -> None:
        rr, T, status = self._rr, of_object.T_cam_obj, of_object.status
        self._log(f"objects/{label}", rr.Transform3D(translation=T[:3, 3].numpy(), mat3x3=T[:3, :3].numpy()))
        self._paths[index].append(T[:3, 3].tolist())
        self._log(f"paths/{label}", rr.LineStrips3D([list(self._paths[index])], colors=[_RED]))
        if self._status.get(label) != status:
            self._status[label] = status
            level = rr.TextLogLevel.INFO if status == Status.TRACKING else rr.TextLogLevel.WARN
            self._log(f"status/{label}", rr.TextLog(f"{label}: {Status(status).name}", level=level))
        self._log(f"plots/status/{label}", rr.Scalars(status))
        self._log(f"plots/quality/{label}", rr.Scalars(of_object.quality))

    def _log_truth(self, t_us: int, index: int, of_object: ObjectMoment) -> None:
        """The true pose, its contour and the errors, where it is known."""
        rr, label, truth, at_us = self._rr, self._session.labels[index], self._session.ground_truth[index], torch.tensor([t_us])
        if truth is None or not bool(truth.covers(at_us)[0]):
            return
        true, camera, contour = truth.at(at_us)[0], self._session.camera, of_object.contour
        self._log(f"truth/{label}", rr.Transform3D(translation=true[:3, 3].numpy(), mat3x3=true[:3, :3].numpy()))
        errors = pose_errors(at_us, of_object.T_cam_obj[None], truth, self._axes[index])
        self._log_scalars(label, "error", {"rotation_deg": float(errors.rotation_deg[0]), "position_cm": float(errors.translation_cm[0])})
        points_cam = transform_points(true, torch.from_numpy(contour.points_obj))
        links = contour_links(contour.pixels, contour.normals)
        lines = distort(project(points_cam, camera.intrinsics(torch.float64)).numpy(), camera)[links]
        self._log(f"camera/truth/{label}", rr.LineStrips2D(lines, colors=[_GREEN], radii=[0.4]))

    def _log_contour(self, label: str, contour: VisibleContour, events: Float[np.ndarray, "e 2"]) -> None:
        """The contour, and the events near it, each with a line to its contour point."""
        rr, camera, pixels, normals = self._rr, self._session.camera, contour.pixels, contour.normals
        self._log(f"camera/contours/{label}", rr.LineStrips2D(distort(pixels, camera)[contour_links(pixels, normals)], colors=[_RED], radii=[0.6]))
        near, feet, residual_px = observed_near(events, pixels, normals)
        chosen = slice(None, None, max(-(-len(near) // _MOST_SHOWN), 1))
        lines = np.stack([distort(near[chosen], camera), distort(feet[chosen], camera)], 1)
        self._log(f"camera/observations/{label}", rr.LineStrips2D(lines, colors=[_YELLOW], radii=[0.25]))
        if len(residual_px):
            self._log(f"plots/residual/{label}/median_px", rr.Scalars(float(np.median(np.abs(residual_px)))))

    def _log_scalars(self, label: str, kind: str, values: dict[str, float]) -> None:
        for name, value in values.items():
            self._log(f"plots/{kind}/{label}/{name}", self._rr.Scalars(value))

    def close(self) -> None:
        """Hand over what is left."""
        self._recording.flush()
        self._recording.disconnect()


def path_of(name: str) -> str:
    """A name as a part of a path in the viewer."""
    return re.sub(r"\W+", "_", name)


def observed_near(
    events: Float[np.ndarray, "e 2"], pixels: Float[np.ndarray, "m 2"], normals: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
    """Events within 4 px of a contour, their feet on its nearest point's tangent, and their distances along its normal (ideal pixels)."""
    if len(events) == 0 or len(pixels) == 0:
        return np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)
    distance, nearest = cKDTree(pixels).query(events, distance_upper_bound=_NEAR_PX)
    is_near = np.isfinite(distance)
    near, normal = events[is_near], normals[nearest[is_near]]
    residual_px = ((near - pixels[nearest[is_near]]) * normal).sum(1)
    return near, near - residual_px[:, None] * normal, residual_px


def event_png(events: EventBatch, width: int, height: int) -> bytes:
    """The events of a window as a grey PNG: black none, grey darker, white brighter; the newest one of a pixel counts."""
    image: UInt8[np.ndarray, "h w"] = np.zeros((height, width), dtype=np.uint8)
    image[events.y.cpu().numpy(), events.x.cpu().numpy()] = np.where(events.polarity.cpu().numpy() > 0, _ON, _OFF)
    return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
