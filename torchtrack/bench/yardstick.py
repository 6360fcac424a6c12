"""The yardstick: a fixed piece of work that times are divided by, so that figures of two machines can be compared.

It is half memory and half arithmetic, as a step of the tracker is: a time surface of 640x480 pixels from 100,000 events, and one pose
refined from 200 points. It calls NumPy and OpenCV alone: nothing that makes the tracker faster makes the yardstick shorter.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import cv2
import numpy as np
import torch

from torchtrack.bench.clock import Clock
from torchtrack.bench.results import Result, time_result

MEANING = "a 640x480 time surface from 100,000 events and one solvePnPRefineLM of 200 points, on one thread of the CPU"
WIDTH, HEIGHT, EVENTS, POINTS = 640, 480, 100_000, 200
# Length of the window and time constant of the surface (µs).
_WINDOW_US, _TAU_US = 5000, 10_000.0
_FOCAL_PX, _ITERATIONS = 600.0, 10
_LEAST_REPEATS = 5
# How far off the pose begins: rotation (rad) and translation (m); and noise (px).
_OFF_RAD, _OFF_M, _NOISE_PX = 0.02, 0.004, 0.3


class Yardstick:
    """The work, with its inputs: the same on every machine."""

    def __init__(self) -> None:
        random = np.random.default_rng(0)
        self._pixel = random.integers(0, WIDTH * HEIGHT, EVENTS)
        self._t_us = np.sort(random.integers(1, _WINDOW_US + 1, EVENTS)).astype(np.float32)
        direction = random.normal(size=(POINTS, 3))
        self._points = 0.1 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        self._matrix = np.array([[_FOCAL_PX, 0, WIDTH / 2], [0, _FOCAL_PX, HEIGHT / 2], [0, 0, 1]])
        self.rotation, self.translation = np.array([0.4, -0.3, 0.2]), np.array([0.02, -0.01, 0.7])
        pixels, _ = cv2.projectPoints(self._points, self.rotation, self.translation, self._matrix, None)
        self._pixels = pixels[:, 0] + _NOISE_PX * random.normal(size=(POINTS, 2))

    def surface(self) -> np.ndarray:
        """The time surface ``[480, 640]`` at the window's end."""
        newest_us = np.full(WIDTH * HEIGHT, -16 * _TAU_US, dtype=np.float32)
        # Of repeated indices NumPy keeps the last: the newest, as events are in order.
        newest_us[self._pixel] = self._t_us
        surface: np.ndarray = np.exp((newest_us - np.float32(_WINDOW_US)) / np.float32(_TAU_US)).reshape(HEIGHT, WIDTH)
        return surface

    def pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation vector and translation (m), refined from a start that is a little off."""
        criteria = (cv2.TERM_CRITERIA_MAX_ITER, _ITERATIONS, 0.0)
        start = (self.rotation + _OFF_RAD)[:, None], (self.translation + _OFF_M)[:, None]
        rotation, translation = cv2.solvePnPRefineLM(self._points, self._pixels, self._matrix, None, *start, criteria)
        return rotation[:, 0], translation[:, 0]

    def __call__(self) -> None:
        """All of the work, once."""
        self.surface()
        self.pose()

    def time(self, repeats: int) -> Result:
        """Its time, as often as everything else is measured, and no less than a few times: it is short."""
        with _one_opencv_thread():
            return time_result(MEANING, Clock(torch.device("cpu")).seconds(self, max(repeats, _LEAST_REPEATS)))


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)
