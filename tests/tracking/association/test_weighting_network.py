"""What describes observations, and the network that believes them or not."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, edge_events, generator, pose
from torch import nn
from tracked_boxes import assert_same, merged, moving_box, started, windows

from torchtrack import EventBatch, Tracker, preset
from torchtrack.core.lie import se3_inverse, se3_log
from torchtrack.errors import UnknownFormatError
from torchtrack.learn.labels import true_distance
from torchtrack.learn.samples import state_velocity
from torchtrack.tracking.association.weighting_features import FEATURES, trust_features
from torchtrack.tracking.association.weighting_network import TrustNetwork


class Watching(nn.Module):
    """Believes everything, and keeps what it saw."""

    def forward(self, inputs):
        self.inputs = inputs
        return torch.ones_like(inputs.observations.age_s)


def clutter(count, start_us, duration_us, seed=1):
    """Events anywhere in the image."""
    rng = generator(seed)
    x, y = (torch.randint(size, (count,), generator=rng).numpy() for size in (SMALL_CAMERA.width, SMALL_CAMERA.height))
    t_us = start_us + 1 + torch.randint(duration_us, (count,), generator=rng).sort().values
    return EventBatch.from_numpy(x, y, t_us.numpy(), torch.randint(2, (count,), generator=rng).numpy())


def inputs_of(objects=1, dtype=torch.float32, noise=400, polarity=None):
    """What a weighting network sees of a box in motion among noise; with its tracker and the truth."""
    trajectory, events = moving_box(pose(), 6)
    watching = Watching()
    tracker = Tracker([box_model()] * objects, SMALL_CAMERA, dtype=dtype, weighting_network=watching)
    state = tracker.init(pose().expand(objects, 4, 4), 0)
    for batch, end_us in windows(merged(events, clutter(6 * noise, 0, 30_000)), 6):
        batch = batch if polarity is None else replace(batch, polarity=torch.full_like(batch.polarity, polarity))
        state, _ = tracker.step(state, batch, end_us)
    return watching.inputs, tracker, trajectory


def truth_at(trajectory, tracker, t_us=30_000):
    """True pose, and the velocity as the tracker's state has it."""
    before, T, after = trajectory.at(torch.tensor([t_us - 250, t_us, t_us]))[:, None]
    twist = se3_log(after @ se3_inverse(before)) / 250e-6
    return T, state_velocity(twist, T, tracker.centre_obj.double())


# ---- labels


def test_events_of_the_contour_lie_on_the_true_one_and_noise_does_not(dtype):
    inputs, tracker, trajectory = inputs_of(dtype=dtype, noise=0)
    distance = true_distance(tracker, inputs, *truth_at(trajectory, tracker))
    mask = inputs.observations.mask
    assert (distance[mask] < 1.0).float().mean() > 0.9 and torch.isinf(distance[~mask]).all()
    inputs, tracker, trajectory = inputs_of(dtype=dtype, noise=2000)
    distance = true_distance(tracker, inputs, *truth_at(trajectory, tracker))[inputs.observations.mask]
    assert 0.1 < (distance > 2.0).float().mean() < 0.9


# ---- features


def features_of(inputs):
    """Features of the observations of one object that there are."""
    return trust_features(inputs)[0][inputs.observations.mask[0]]


def test_features_are_numbers_of_about_unit_size(dtype):
    inputs, _, _ = inputs_of(dtype=dtype)
    features = trust_features(inputs)
    assert features.shape == (*inputs.observations.age_s.shape, FEATURES) and features.dtype == dtype
    assert torch.isfinite(features).all() and features.abs().max() < 8


def test_features_do_not_hang_on_other_objects():
    alone, both = inputs_of()[0], inputs_of(objects=2)[0]
    torch.testing.assert_close(trust_features(both)[:1], trust_features(alone), atol=3e-4, rtol=0)
    torch.testing.assert_close(trust_features(both)[1:], trust_features(alone), atol=3e-4, rtol=0)


def test_events_around_are_counted_by_polarity():
    ours, others = (features_of(inputs_of(polarity=value)[0]) for value in (True, False))
    same, opposite = ours[:, :27], ours[:, 27:54]
    # All events are of one polarity: none is found of the other but by corners, which have none.
    assert (same.amax(1) > 0.4).float().mean() > 0.95 and (opposite == 0).all()
    events = others[:, -3] == 1
    assert (others[events, 27:54] == 0).all() and (others[events, :27].amax(1) > 0.4).float().mean() > 0.95


def test_events_of_the_contour_look_otherwise_than_noise():
    inputs, tracker, trajectory = inputs_of(noise=2000)
    distance = true_distance(tracker, inputs, *truth_at(trajectory, tracker))
    mask = inputs.observations.mask
    counts = trust_features(inputs)[..., :54].sum(-1)
    assert counts[mask & (distance < 1)].mean() > 1.2 * counts[mask & (distance > 2)].mean()


def test_observations_without_a_contour_or_on_no_sensor_are_told_as_such():
    inputs, _, _ = inputs_of()
    far = replace(inputs.observations, pixels=torch.full_like(inputs.observations.pixels, 1e6))
    features = trust_features(replace(inputs, observations=far))
    assert torch.isfinite(features).all() and (features[..., -1] == 0).all()


# ---- the network


def test_the_network_is_small():
    network = TrustNetwork.shipped()
    assert sum(value.numel() for value in network.parameters()) <= 100_000 and len(network.as_bytes()) < 1_000_000
    assert not any(value.requires_grad for value in network.parameters())


def test_weights_are_kept_and_read_again():
    network = TrustNetwork()
    again = TrustNetwork.from_bytes(network.as_bytes())
    inputs = inputs_of()[0]
    trust = network(inputs)
    assert torch.equal(again(inputs), trust) and ((trust >= 0) & (trust <= 1)).all() and trust.requires_grad


@pytest.mark.parametrize("content", [b"", b"nothing of the kind", TrustNetwork((8, 8)).as_bytes()])
def test_other_files_are_refused(content):
    with pytest.raises(UnknownFormatError, match="not the weights of this network"):
        TrustNetwork.from_bytes(content)


def test_the_shipped_network_tells_the_contour_from_noise():
    inputs, tracker, trajectory = inputs_of(noise=2000)
    distance = true_distance(tracker, inputs, *truth_at(trajectory, tracker))
    trust, mask = TrustNetwork.shipped()(inputs), inputs.observations.mask
    assert trust[mask & (distance < 1)].mean() > 0.3 + trust[mask & (distance > 2)].mean()


# ---- as a preset


def test_the_preset_brings_the_network_and_a_weigher_of_ones_own_replaces_it(dtype):
    tracker = Tracker([box_model()], SMALL_CAMERA, preset("learned"), dtype=dtype)
    assert isinstance(tracker.weighting_network, TrustNetwork) and {value.dtype for value in tracker.weighting_network.parameters()} == {dtype}
    own = Watching()
    assert Tracker([box_model()], SMALL_CAMERA, preset("learned"), weighting_network=own).weighting_network is own
    assert Tracker([box_model()], SMALL_CAMERA).weighting_network is None


def test_the_preset_is_the_default_but_for_the_network():
    plain, state, _, window, _ = started()
    learned = Tracker([box_model()], SMALL_CAMERA, preset("learned"))
    with torch.no_grad():
        first, second = learned.step(state, *window), learned.step(state, *window)
        assert_same(first, second)
        assert not torch.equal(first[0].T_cam_obj, plain.step(state, *window)[0].T_cam_obj)
    # Nothing is recorded for a network that is not to be trained.
    assert not learned.step(state, *window)[0].T_cam_obj.requires_grad


def test_edges_alone_are_still_followed():
    trajectory, events = moving_box(pose(), 8)
    tracker = Tracker([box_model()], SMALL_CAMERA, preset("learned"), dtype=torch.float64)
    state = tracker.init(pose()[None], 0)
    for batch, end_us in windows(events, 8):
        state, result = tracker.step(state, batch, end_us)
    assert int(result.status[0]) == 0 and edge_events(trajectory).t_us.numel() == len(events)
    assert (state.T_cam_obj - trajectory.T_cam_obj[-1]).abs().max() < 0.01
