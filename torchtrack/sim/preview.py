"""A video of a simulated sequence: what the camera sees, its events, and the true contours."""

from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from numpy import ndarray

from torchtrack.sim.render import Frame
from torchtrack.sim.scenes import SceneConfig
from torchtrack.sim.simulation import SimulatedSequence, render_frames
from torchtrack.sim.surface import linear_to_srgb
from torchtrack.viz.video import OverlayWriter

_FRAMES_PER_SECOND = 30.0
_SLOW_MOTION = 4.0
# A step in depth of this share is a contour.
_JUMP = 0.03
# Events are shown for this long, µs.
_SHOWN_US = 5000
_ON, _OFF, _CONTOUR, _OCCLUDER = (255, 160, 60), (60, 60, 255), (80, 255, 80), (0, 200, 255)


def write_preview(sequence: SimulatedSequence, config: SceneConfig, path: Path) -> None:
    """Write the preview as MPEG-4, four times slower than life; the file appears whole or not at all.

    Grey is the image; red and blue the events of the last 5 ms that got darker and brighter; green the outlines of the
    objects, orange those of the occluders, both at their true poses.
    """
    end_us = int(sequence.trajectories[0].t_us[-1])
    t_us = np.arange(_SHOWN_US, end_us + 1, round(1e6 / (_FRAMES_PER_SECOND * _SLOW_MOTION)))
    with OverlayWriter(path, frames_per_second=_FRAMES_PER_SECOND, slow_motion=_SLOW_MOTION, stills=0) as writer:
        for at, frame in zip(t_us.tolist(), render_frames(config, t_us, sequence.models), strict=True):
            writer.add(at, _picture(frame, sequence, at))


def _picture(frame: Frame, sequence: SimulatedSequence, t_us: int) -> UInt8[ndarray, "h w 3"]:
    image = cv2.cvtColor((150 * linear_to_srgb(frame.luminance)).astype(np.uint8), cv2.COLOR_GRAY2BGR)
    first, end = torch.searchsorted(sequence.events.t_us, torch.tensor([t_us - _SHOWN_US, t_us]), right=True).tolist()
    events = sequence.events[first:end]
    image[events.y.numpy(), events.x.numpy()] = np.where(events.polarity.numpy()[:, None], _ON, _OFF)
    owner = frame.object_index
    edge = _contours(frame)
    objects = len(sequence.labels)
    image[edge & (owner >= 0) & (owner < objects)] = _CONTOUR
    image[edge & (owner >= objects)] = _OCCLUDER
    return image


def _contours(frame: Frame) -> Bool[ndarray, "h w"]:
    """Pixels beside a pixel of something else, or of the same object much nearer or further."""
    owner, nearness = frame.object_index, 1 / frame.depth
    edge = np.zeros(owner.shape, dtype=np.bool_)
    for first, second in (((slice(None), slice(1, None)), (slice(None), slice(None, -1))), ((slice(1, None),), (slice(None, -1),))):
        jump = np.abs(nearness[first] - nearness[second]) > _JUMP * np.maximum(nearness[first], nearness[second])
        differs = (owner[first] != owner[second]) | jump
        edge[first] |= differs
        edge[second] |= differs
    return edge
