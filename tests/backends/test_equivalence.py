"""Every operation that the backend accelerates, beside its reference, on what whole steps of the tracker ask of it."""

from functools import partial

import numpy as np
import pytest
import torch
from helpers import SMALL_CAMERA, bevelled_model, box_model, pose, random_events
from states import changed
from tracked_boxes import follow, moving_box, one_box_scene, scene_of_one_stream, scene_of_streams, tensors_of, tracker_of, windows

from torchtrack import Tracker, preset
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch
from torchtrack.tracking.association.matches import Matches
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.contours.index import ContourIndex
from torchtrack.tracking.contours.points import Contours
from torchtrack.tracking.frontend.corners import Corners
from torchtrack.tracking.frontend.window_events import SharedEvents, WindowEvents

pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
from torchtrack.backends.numba import operations  # noqa: F401 - it registers all that is accelerated

# Of each operation, so many calls of each scene are looked at.
CALLS = 2
# A solver's steps multiply roundings.
TOLERANCE = 1e-6
NAMES = sorted(name for name, operation in dispatch.OPERATIONS.items() if "cpu" in operation.bodies)


def lost_box():
    """A box of which hardly anything is known: it is searched for far and wide."""
    _, events = moving_box(pose(), 6)
    tracker = tracker_of(dtype=torch.float64)
    state, _ = follow(tracker, tracker.init(pose()[None], 0), windows(events, 3))
    unknown = torch.eye(12, dtype=torch.float64).expand_as(state.motion.covariance)
    follow(tracker, changed(state, covariance=unknown), windows(events, 6)[3:])


def smooth_box():
    _, events = moving_box(pose(), 3)
    tracker = Tracker([bevelled_model()], SMALL_CAMERA, dtype=torch.float64)
    follow(tracker, tracker.init(pose()[None], 0), windows(events, 3))


def boxes(scene):
    starts, streams, cameras, of_windows = scene(3)
    tracker = Tracker([bevelled_model()] * len(starts), cameras, TrackerConfig(), streams, torch.float64)
    follow(tracker, tracker.init(torch.stack(starts), 0), of_windows)


def solved_again():
    """Rounds that take several steps each go by the solver alone."""
    _, events = moving_box(pose(), 3)
    tracker = tracker_of(config=TrackerConfig.model_validate({"solver": {"iterations": 2}}), dtype=torch.float64)
    follow(tracker, tracker.init(pose()[None], 0), windows(events, 3))


def guided_box():
    """Corners are looked for, and flow is."""
    _, events = moving_box(pose(), 3)
    tracker = tracker_of(config=preset("guided"), dtype=torch.float64)
    follow(tracker, tracker.init(pose()[None], 0), windows(events, 3))


def many_events():
    """A start among so many events that its window is taken in parts."""
    tracker = tracker_of(dtype=torch.float64)
    follow(tracker, tracker.init(pose()[None], 0), [(random_events(20_000, width=200, height=150, duration_us=5_000), 5_000)])


def box_behind_another():
    starts = torch.stack([pose(), pose(translation=(0.03, 0.0, 0.7))])
    _, events = moving_box(pose(), 2)
    tracker = tracker_of(2, dtype=torch.float64)
    follow(tracker, tracker.init(starts, 0), windows(events, 2))


def box_beside_a_lost_one():
    """What one explains is taken from the other's events."""
    starts = torch.stack([pose(), pose(translation=(0.02, 0.0, 0.7))])
    _, events = moving_box(pose(), 6)
    tracker = tracker_of(2, dtype=torch.float64)
    state, _ = follow(tracker, tracker.init(starts, 0), windows(events, 5))
    follow(tracker, changed(state, time_since_validated_s=torch.tensor([0.0, 0.1], dtype=torch.float64)), windows(events, 6)[5:])


def long_window():
    """Of longer windows, events near objects are kept before they are looked at."""
    _, events = moving_box(pose(), 10)
    tracker = tracker_of(dtype=torch.float64)
    follow(tracker, tracker.init(pose()[None], 0), [(events, 50_000)])


class Trusting(torch.nn.Module):
    """Believes every observation."""

    def forward(self, inputs):
        return torch.ones_like(inputs.observations.age_s)


def own_network():
    """A weighting network of one's own is shown all events."""
    _, events = moving_box(pose(), 2)
    tracker = Tracker([box_model()], SMALL_CAMERA, dtype=torch.float64, weighting_network=Trusting())
    follow(tracker, tracker.init(pose()[None], 0), windows(events, 2))


SCENES = (
    own_network,
    lost_box,
    smooth_box,
    solved_again,
    long_window,
    guided_box,
    many_events,
    box_behind_another,
    box_beside_a_lost_one,
    *(partial(boxes, scene) for scene in (one_box_scene, scene_of_one_stream, scene_of_streams)),
)


@pytest.fixture(scope="module")
def samples():
    """By operation, the arguments that some scenes call it with."""
    actual = {name: [] for name in NAMES}

    def recorded(name, accelerated, calls):
        def call(*args, **kwargs):
            if len(calls) < CALLS:
                calls.append((args, kwargs))
            return accelerated(*args, **kwargs)

        return call

    with pytest.MonkeyPatch.context() as patch, torch.inference_mode():
        for scene in SCENES:
            calls = {name: [] for name in NAMES}
            with patch.context() as own:
                for name in NAMES:
                    body = dispatch.OPERATIONS[name].bodies["cpu"]
                    own.setattr(body, "accelerated", recorded(name, body.accelerated, calls[name]))
                scene()
            for name in NAMES:
                actual[name] += calls[name]
    return actual


@pytest.mark.parametrize("name", NAMES)
def test_what_is_accelerated_gives_what_its_reference_gives(name, samples):
    assert samples[name], f"no scene here calls {name}: add one that does"
    operation = dispatch.OPERATIONS[name]
    for args, kwargs in samples[name]:
        with torch.inference_mode():
            ours = operation.bodies["cpu"].accelerated(*args, **kwargs)
            with dispatch.backend(wanted=False):
                theirs = operation.reference(*args, **kwargs)
        assert_alike(stated(name, ours, args), stated(name, theirs, args))


def stated(name, value, args):
    """What counts of a result: of padding, nothing does."""
    operation = name.rpartition(".")[2]
    if operation == "mesh_points":
        points, tangents, kind, mask, resolved = value
        return [points[mask], tangents[mask], kind[mask], resolved[mask]]
    if operation in ("hidden_by_self", "hidden_in_buffer"):
        return [value[args[1].mask]]
    if operation == "contour_table":
        return [value.rows.transpose(1, 2)[args[0].mask], value.not_plain]
    if operation == "highest":
        # Which of several equal shifts is named is chance, and so is whether one beside an equal one is another.
        return [value[0][:, :1]]
    if operation == "strongest_along_normals":
        # So it is which of several places with as many events.
        return [value[1]]
    if operation == "silhouette_features":
        features, is_smooth, objects = value
        own = is_smooth[objects]
        # The reference tells of all objects, a kernel of those with smooth silhouettes.
        return [is_smooth, features[own]]
    return [tensor for part in (value if isinstance(value, tuple) else (value,)) for tensor in _of(part)]


def _of(value):
    if isinstance(value, np.ndarray):
        return [torch.from_numpy(value)]
    if isinstance(value, SharedEvents):
        value = value.rows()
    if isinstance(value, WindowEvents):
        # Kept ones may be numbered as of all events, or among themselves.
        return [value.mask.sum(-1), *(tensor[value.mask] for tensor in (value.pixels, value.age_s, value.polarity))]
    if isinstance(value, ContourIndex):
        # The cells that it is laid out in are its own.
        v, u = torch.meshgrid(torch.arange(0.0, 150, 7), torch.arange(0.0, 320, 7), indexing="ij")
        return [value.look_up(torch.stack([u, v], -1).flatten(0, 1).to(value.pixels).expand(len(value.pixels), -1, -1))]
    if isinstance(value, Corners):
        # Which comes first does not matter.
        rows = torch.cat([value.sensor_pixels, value.pixels, value.age_s[..., None], value.polarity[..., None]], -1)
        return [value.mask.sum(-1), *(torch.tensor(sorted(of_object[mask].tolist())) for of_object, mask in zip(rows, value.mask, strict=True))]
    if isinstance(value, Contours | Matches | Observations):
        of_points = [tensor for tensor in tensors_of(value) if tensor.shape[:2] == value.mask.shape]
        return [value.mask, *(tensor[value.mask] for tensor in of_points)]
    return tensors_of(value)


def assert_alike(ours, theirs):
    assert len(ours) == len(theirs) > 0
    for mine, other in zip(ours, theirs, strict=True):
        if mine.is_floating_point():
            torch.testing.assert_close(mine, other.to(mine.dtype), rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True)
        else:
            assert torch.equal(mine.to(other.dtype), other)
