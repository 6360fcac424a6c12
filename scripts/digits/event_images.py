"""Events of moving shapes, by numpy alone: every pixel casts a ray, and fires where its brightness has changed.

Nothing of torchtrack is used here, so that a change of its simulator changes no input. Conventions are the package's:
x right, y down, z forward; an integer pixel is the centre of that pixel; poses ``T_cam_obj [4, 4]`` in metres.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

STEP_US = 1_000
# Steps of log brightness that make an event; no pixel fires more often than this in one time step.
_CONTRAST, _MOST_AT_ONCE = 0.25, 2
_BACKGROUND = 0.12
# Noise events per second, on all of the sensor.
_NOISE_HZ = 4_000


@dataclass(frozen=True)
class Pinhole:
    """A camera without distortion: focal length and size in pixels, the principal point in the middle."""

    focal_px: float
    width: int
    height: int

    @property
    def centre(self) -> tuple[float, float]:
        """The principal point (px)."""
        return (self.width - 1) / 2, (self.height - 1) / 2


class Shape(Protocol):
    """What rays can meet."""

    radius_m: float

    def met(self, start: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth along each of ``rays [n, 3]`` from ``start [3]``, infinite where it misses, and the brightness there."""


@dataclass(frozen=True)
class Box:
    """A box about the origin, each side of a brightness of its own; the one towards -z may carry a picture ``[h, w]``."""

    extents_m: tuple[float, float, float]
    brightness: tuple[float, ...] = (0.25, 0.85, 0.45, 0.65, 0.95, 0.35)
    picture: np.ndarray | None = None

    @property
    def radius_m(self) -> float:
        """Of a ball around it."""
        return float(np.linalg.norm(self.extents_m)) / 2

    def met(self, start: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`Shape`."""
        half = np.asarray(self.extents_m) / 2
        safe = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
        near, far = -(start + np.sign(safe) * half) / safe, (-start + np.sign(safe) * half) / safe
        axis, enters = near.argmax(1), near.max(1)
        hits = (enters < far.min(1)) & (enters > 0)
        side = 2 * axis + (np.take_along_axis(rays, axis[:, None], 1)[:, 0] > 0)
        brightness = np.asarray(self.brightness)[side]
        if self.picture is not None:
            share = (start + rays * enters[:, None])[:, :2] / (2 * half[:2]) + 0.5
            rows, columns = self.picture.shape
            at = (share * (columns, rows)).clip(0, (columns - 1, rows - 1)).astype(int)
            brightness = np.where(side == 5, self.picture[at[:, 1], at[:, 0]], brightness)
        return np.where(hits, enters, np.inf), brightness


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid about the origin, of one brightness."""

    semi_axes_m: tuple[float, float, float]
    brightness: float = 0.7

    @property
    def radius_m(self) -> float:
        """Of a ball around it."""
        return max(self.semi_axes_m)

    def met(self, start: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`Shape`."""
        axes = np.asarray(self.semi_axes_m)
        start, rays = start / axes, rays / axes
        a, b, c = (rays**2).sum(1), rays @ start, start @ start - 1
        root = b**2 - a * c
        depth = np.where(root > 0, (-b - np.sqrt(root.clip(0))) / a, np.inf)
        return depth, np.full(len(rays), self.brightness)


@dataclass(frozen=True)
class Body:
    """A shape, and where it is: ``T_cam_obj(seconds)``, or None while it is not there at all."""

    shape: Shape
    T_cam_obj: Callable[[float], np.ndarray | None]


def rotation(vector: Sequence[float]) -> np.ndarray:
    """The rotation by a vector (rad), by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = np.asarray(vector, dtype=np.float64) / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def brightness_image(bodies: Sequence[Body], camera: Pinhole, seconds: float) -> np.ndarray:
    """What the camera sees, ``[h, w]``: of each pixel the nearest body."""
    depth = np.full((camera.height, camera.width), np.inf)
    image = np.full(depth.shape, _BACKGROUND)
    for body in bodies:
        T = body.T_cam_obj(seconds)
        if T is None:
            continue
        rows, columns = _window(T[:3, 3], body.shape.radius_m, camera)
        v, u = np.mgrid[rows, columns]
        if u.size == 0:
            continue
        rays = np.stack([(u - camera.centre[0]) / camera.focal_px, (v - camera.centre[1]) / camera.focal_px, np.ones(u.shape)], -1)
        own_depth, own = body.shape.met(-T[:3, :3].T @ T[:3, 3], rays.reshape(-1, 3) @ T[:3, :3])
        own_depth, own = own_depth.reshape(u.shape), own.reshape(u.shape)
        nearer = own_depth < depth[rows, columns]
        depth[rows, columns] = np.where(nearer, own_depth, depth[rows, columns])
        image[rows, columns] = np.where(nearer, own, image[rows, columns])
    return image


def _window(centre_cam: np.ndarray, radius_m: float, camera: Pinhole) -> tuple[slice, slice]:
    """Rows and columns that a ball can be seen in."""
    reach_px = 1 + camera.focal_px * radius_m * 1.5 / max(centre_cam[2] - radius_m, 1e-3)
    middle = camera.focal_px * centre_cam[:2] / centre_cam[2] + camera.centre
    low, high = np.floor(middle - reach_px).astype(int), np.ceil(middle + reach_px).astype(int) + 1
    return slice(max(low[1], 0), max(min(high[1], camera.height), 0)), slice(max(low[0], 0), max(min(high[0], camera.width), 0))


def fired(bodies: Sequence[Body], camera: Pinhole, duration_us: int, seed: int) -> dict[str, np.ndarray]:
    """Events ``x, y, t_us, polarity`` of one camera, sorted by time; the same numbers for the same ``seed``."""
    rng = np.random.default_rng(seed)
    level = np.log(brightness_image(bodies, camera, 0.0))
    parts = [_noise(camera, duration_us, rng)]
    for t_us in range(STEP_US, duration_us + 1, STEP_US):
        change = np.log(brightness_image(bodies, camera, 1e-6 * t_us)) - level
        times = np.floor(np.abs(change) / _CONTRAST).astype(int)
        level += np.sign(change) * times * _CONTRAST
        y, x = np.nonzero(times)
        repeats = times[y, x].clip(max=_MOST_AT_ONCE)
        x, y, brighter = (np.repeat(values, repeats) for values in (x, y, change[y, x] > 0))
        parts.append(np.stack([x, y, t_us - rng.integers(STEP_US, size=len(x)), brighter]))
    x, y, t_us, brighter = np.concatenate(parts, 1)
    order = np.argsort(t_us, kind="stable")
    return {"x": x[order], "y": y[order], "t_us": t_us[order], "polarity": brighter[order]}


def _noise(camera: Pinhole, duration_us: int, rng: np.random.Generator) -> np.ndarray:
    count = int(_NOISE_HZ * 1e-6 * duration_us)
    limits = (camera.width, camera.height, duration_us, 2)
    return np.stack([rng.integers(limit, size=count) for limit in limits]) + np.array([[0], [0], [1], [0]])
