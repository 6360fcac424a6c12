"""One picture of one stream: events, and on them what the tracker believes.

Grey is the time surface. Per object: the contours at the estimated pose in red, those at the true pose, where it is
known, in thin green on top; corners in yellow with an arrow along their flow; and its axes (x red, y green, z blue).

Everything of the tracker is in ideal pixels and is distorted here to where the sensor sees it. Small sensors are drawn
enlarged: sensor pixel (u, v) becomes a block of ``scale`` x ``scale``, its centre at ``scale (u + 1/2) - 1/2``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchtrack.core.camera import MIN_DEPTH_M, Camera, distort, project
from torchtrack.core.lie import transform_points
from torchtrack.object_model import ObjectModel
from torchtrack.tracking.state import StepResult
from torchtrack.tracking.validation.status import Status
from torchtrack.viz.contour_lines import contour_links
from torchtrack.viz.lettering import Colour, write, write_lines

# Sensors are enlarged by a whole number until they are at least this wide.
_LEAST_WIDTH_PX = 900
# Grey of the newest event: below white, so that the drawing stands out.
_BRIGHTEST_EVENT = 190
# Arrows show how far a corner goes in this time.
_ARROW_S = 0.04
_AXIS_FRACTION = 0.3
_FRACTION_BITS = 4

_RED, _GREEN, _BLUE, _YELLOW, _ORANGE, _WHITE = (40, 40, 255), (80, 255, 80), (255, 120, 40), (0, 220, 255), (0, 140, 255), (255, 255, 255)


@dataclass(frozen=True)
class OverlayObject:
    """What is drawn of one object, in ideal pixels.

    Args:
        name: shown beside its status.
        status: what the tracker says of it.
        quality: between 0 and 1.
        contour: points of its contours at the estimated pose.
        links: pairs of points that follow each other along a contour; they are drawn as lines, other points as dots.
        truth: the same points at the true pose, NaN behind the camera; None where it is not known.
        corners: corners of its region.
        flow: their velocity (px/s); zero where there is none.
        axes: the object's centre and the tips of its axes; none where it is behind the camera.
    """

    name: str
    status: Status
    quality: float
    contour: Float[np.ndarray, "m 2"]
    links: Int[np.ndarray, "l 2"]
    truth: Float[np.ndarray, "m 2"] | None
    corners: Float[np.ndarray, "n 2"]
    flow: Float[np.ndarray, "n 2"]
    axes: Float[np.ndarray, "4 2"] | None


def overlay_objects(
    result: StepResult,
    models: Sequence[ObjectModel],
    camera: Camera,
    *,
    names: Sequence[str] | None = None,
    true_poses: Sequence[Tensor | None] | None = None,
    stream_index: Sequence[int] | None = None,
    stream: int = 0,
) -> list[OverlayObject]:
    """What to draw of the objects that are seen in one stream.

    Args:
        result: of :meth:`torchtrack.tracking.tracker.Tracker.step`.
        models: one per object of the tracker.
        camera: the stream's.
        names: one per object; the models' when not given.
        true_poses: one ``T_cam_obj [4, 4]`` per object, ``None`` where it is not known.
        stream_index: the stream of each object; the first for all when not given.
        stream: the stream to draw.
    """
    names = names or [model.name for model in models]
    truth = true_poses or [None] * len(models)
    streams = stream_index or [0] * len(models)
    return [_overlay_object(result, b, models[b], camera, names[b], truth[b]) for b in range(len(models)) if streams[b] == stream]


def _overlay_object(result: StepResult, b: int, model: ObjectModel, camera: Camera, name: str, true_pose: Tensor | None) -> OverlayObject:
    contours, corners = result.contours, result.corners
    seen = contours.mask[b]
    flow = torch.where(corners.has_flow[b][:, None], corners.flow[b], 0.0)[corners.mask[b]]
    pixels = _array(contours.pixels[b][seen])
    return OverlayObject(
        name=name,
        status=Status(int(result.status[b])),
        quality=float(result.quality[b]),
        contour=pixels,
        links=contour_links(pixels, _array(contours.normals[b][seen])),
        truth=None if true_pose is None else _pixels(contours.points_obj[b][seen], true_pose, camera),
        corners=_array(corners.pixels[b][corners.mask[b]]),
        flow=_array(flow),
        axes=_axes(result.T_cam_obj[b], model, camera),
    )


def _array(values: Tensor) -> np.ndarray:
    return values.detach().cpu().double().numpy()


def _pixels(points_obj: Tensor, T_cam_obj: Tensor, camera: Camera) -> np.ndarray:
    """Ideal pixels of points; NaN behind the camera."""
    points = transform_points(T_cam_obj.cpu().double(), points_obj.detach().cpu().double())
    pixels = project(points, camera.intrinsics(torch.float64))
    return _array(torch.where(points[:, 2:] > MIN_DEPTH_M, pixels, torch.nan))


def _axes(T_cam_obj: Tensor, model: ObjectModel, camera: Camera) -> np.ndarray | None:
    """The object's centre and the tips of its axes, if all are in front of the camera."""
    tips = torch.cat([torch.zeros(1, 3), torch.eye(3)]) * _AXIS_FRACTION * model.diameter_m
    pixels = _pixels(model.centre + tips, T_cam_obj, camera)
    return pixels if np.isfinite(pixels).all() else None


def draw_overlay(
    last_event_us: Int[np.ndarray, "h w"] | Int[Tensor, "h w"],
    t_us: int,
    camera: Camera,
    objects: Sequence[OverlayObject],
    *,
    decay_s: float = 0.03,
    scale: int | None = None,
    note: str | None = None,
) -> UInt8[np.ndarray, "hs ws 3"]:
    """The picture (BGR) of a stream at ``t_us``.

    Args:
        last_event_us: time of the newest event of every sensor pixel, ``TrackerState.last_event_us[stream]``.
        t_us: the time shown.
        camera: the stream's, of which the lens is drawn and the size cut out.
        objects: from :func:`overlay_objects`.
        decay_s: time constant of the time surface.
        scale: enlargement; by default as much as the sensor needs to be 900 pixels wide.
        note: a further line of text.
    """
    newest = last_event_us.cpu().numpy() if isinstance(last_event_us, Tensor) else last_event_us
    scale = scale or enlargement(camera.width)
    canvas = _Canvas(grey_events(newest[: camera.height, : camera.width], t_us, decay_s, scale), camera, scale)
    for thing in objects:
        canvas.lines(thing.contour, thing.links, _RED, width=min(scale + 1, 4))
    for thing in objects:
        if thing.truth is not None:
            canvas.lines(thing.truth, thing.links, _GREEN, width=1)
    for thing in objects:
        canvas.arrows(thing.corners, thing.corners + thing.flow * _ARROW_S, _YELLOW)
        if thing.axes is not None:
            canvas.axes(thing.axes, thing.name)
    notes = [] if note is None else [(note, _YELLOW)]
    write_lines(canvas.image, [(f"t = {t_us * 1e-6:.4f} s", _WHITE), *(_legend_line(thing) for thing in objects), *notes])
    return canvas.image


def enlargement(width: int) -> int:
    """How many times a sensor of some width (px) is enlarged, to be seen well."""
    return -(-_LEAST_WIDTH_PX // width)


def grey_events(last_event_us: Int[np.ndarray, "h w"], t_us: int, decay_s: float, scale: int) -> UInt8[np.ndarray, "hs ws 3"]:
    """The exponentially decayed time surface, enlarged, as grey."""
    # Before float32: the difference is exact and small, the times are neither.
    age_s = (t_us - last_event_us).clip(0, 10_000_000).astype(np.float32) * 1e-6
    grey = np.round(_BRIGHTEST_EVENT * np.exp(-age_s / decay_s)).astype(np.uint8)
    return cv2.cvtColor(cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST), cv2.COLOR_GRAY2BGR)


def _legend_line(thing: OverlayObject) -> tuple[str, Colour]:
    colour = {Status.TRACKING: _GREEN, Status.UNCERTAIN: _ORANGE}.get(thing.status, _RED)
    return f"{thing.name}: {thing.status.name.lower().replace('_', ' ')}, quality {thing.quality:.2f}", colour


class _Canvas:
    """A picture that is drawn on in ideal pixels."""

    def __init__(self, image: np.ndarray, camera: Camera, scale: int) -> None:
        self.image = image
        self.camera = camera
        self.scale = scale

    def lines(self, ideal: np.ndarray, links: np.ndarray, colour: Colour, width: int) -> None:
        """A line along each link, and a square dot at each point that has none."""
        placed, near = self._place(ideal)
        drawn = links[near[links].all(1)]
        ends = np.round(placed[drawn] * (1 << _FRACTION_BITS)).astype(np.int32)
        # Smoothed, a line of one pixel between two would be two faint ones.
        cv2.polylines(self.image, list(ends), False, colour, width, cv2.LINE_AA if width > 1 else cv2.LINE_8, _FRACTION_BITS)
        alone = near.copy()
        alone[drawn] = False
        self._dots(placed[alone], colour, width)

    def _dots(self, placed: np.ndarray, colour: Colour, width: int) -> None:
        height, width_px = self.image.shape[:2]
        offset = np.arange(width) - (width - 1) // 2
        square = np.stack(np.meshgrid(offset, offset), -1).reshape(1, -1, 2)
        at = (np.round(placed).astype(np.int64)[:, None] + square).reshape(-1, 2)
        u, v = at[((at >= 0) & (at < [width_px, height])).all(1)].T
        self.image[v, u] = colour

    def arrows(self, start: np.ndarray, end: np.ndarray, colour: Colour) -> None:
        """A small circle at each start, and a line to the end with a tip."""
        (tail, tail_ok), (tip, tip_ok) = self._place(start), self._place(end)
        for a, b in zip(_fixed(tail[tail_ok & tip_ok]), _fixed(tip[tail_ok & tip_ok]), strict=True):
            cv2.circle(self.image, a, 3 << _FRACTION_BITS, colour, 1, cv2.LINE_AA, _FRACTION_BITS)
            cv2.arrowedLine(self.image, a, b, colour, 1, cv2.LINE_AA, _FRACTION_BITS, 0.25)

    def axes(self, ideal: np.ndarray, name: str) -> None:
        """Three lines from the first point, and the name beside it."""
        placed, ok = self._place(ideal)
        if not ok.all():
            return
        centre, *tips = _fixed(placed)
        for tip, colour in zip(tips, (_RED, _GREEN, _BLUE), strict=True):
            cv2.line(self.image, centre, tip, colour, 2, cv2.LINE_AA, _FRACTION_BITS)
        write(self.image, name, (int(placed[0, 0]) + 6, int(placed[0, 1]) - 6), _WHITE)

    def _place(self, ideal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where ideal pixels lie in the picture, and which are near enough to it to be drawn."""
        size = np.array([self.camera.width, self.camera.height])
        # Far outside the image, a lens model may fold back into it.
        near = np.asarray((np.abs(ideal - size / 2) < 1.5 * size).all(1))
        sensor = distort(np.where(near[:, None], ideal, -size), self.camera)
        placed = self.scale * (sensor + 0.5) - 0.5
        near &= np.asarray((np.abs(sensor - size / 2) < 2 * size).all(1))
        return np.where(near[:, None], placed, -1e4), near


def _fixed(pixels: np.ndarray) -> list[tuple[int, int]]:
    """Pixels as OpenCV's fixed-point numbers."""
    return [(int(u), int(v)) for u, v in np.round(pixels * (1 << _FRACTION_BITS))]
