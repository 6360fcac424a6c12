"""Where a first pose is looked for, if nobody says it: the box around what moves most."""

import numpy as np
import pytest
import torch

from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError
from torchtrack.object_model import ObjectModel
from torchtrack.run.first_pose.start import Start, box_of_events

CAMERA = Camera(fx=300.0, fy=300.0, cx=159.5, cy=119.5, width=320, height=240)


def start(*pixels):
    """A start with events at these pixels ``[e, 2]``."""
    at = np.concatenate(pixels).round().astype(np.int64)
    batch = EventBatch.from_numpy(at[:, 0], at[:, 1], np.arange(len(at)), np.ones(len(at), bool))
    marker = ObjectModel.from_polylines([[[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0, 0]]])
    return Start(marker, CAMERA, batch, torch.from_numpy(at).float(), 0)


def patch(left, top, width, height, count, seed=0):
    return np.random.default_rng(seed).uniform((left, top), (left + width, top + height), (count, 2))


@pytest.mark.parametrize("noise", [0, 1_000, 8_000])
def test_noise_all_over_the_image_is_not_taken_for_the_object(noise):
    begun = start(patch(96, 64, 80, 56, 8_000), patch(0, 0, 319, 239, noise, seed=1))
    box = box_of_events(begun, 100_000)
    sides = np.array([box.u0, box.v0, box.u1, box.v1])
    assert np.abs(sides - [96, 64, 176, 120]).max() <= 16


def test_noise_alone_has_no_box():
    with pytest.raises(EventDataError, match="scattered all over"):
        box_of_events(start(patch(0, 0, 319, 239, 30)), 100_000)
