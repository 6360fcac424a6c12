"""The default's trust in observations of smooth silhouettes: what it judges, both ways that it is computed, and what it needs."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, bevelled_model, box_model, pose
from states import changed
from tracked_boxes import follow, merged, moving_box, tensors_of, windows

from torchtrack import Tracker, preset
from torchtrack.config.tracker import AssociationConfig, TrackerConfig
from torchtrack.core.dispatch import backend
from torchtrack.core.events import concatenate
from torchtrack.tracking.association.weighting_features import silhouette_features
from torchtrack.tracking.association.weighting_network import SilhouetteTrust, TrustNetwork

BOX, SMOOTH = box_model(), bevelled_model()
COUNT = 6


class Watching(SilhouetteTrust):
    """Judges, and keeps what it saw."""

    def forward(self, inputs):
        self.inputs = inputs
        return super().forward(inputs)


def inputs_of(models=(SMOOTH,), dtype=torch.float32):
    """What a weighting network sees of objects in one place, all of the same events."""
    weighting_network = Watching(TrustNetwork.shipped())
    tracker = Tracker(list(models), SMALL_CAMERA, dtype=dtype, weighting_network=weighting_network)
    with torch.no_grad():
        follow(tracker, tracker.init(pose().expand(len(models), 4, 4), 0), windows(moving_box(pose(), COUNT)[1], COUNT))
    return weighting_network.inputs, weighting_network


def tracked(models, starts, streams=None, spoilt=None):
    """The last state of boxes that move alike, each in a stream of its own."""
    parts = [moving_box(start, COUNT, seed=number, stream=number)[1] for number, start in enumerate(starts)]
    if spoilt is not None:
        parts[spoilt] = replace(parts[spoilt], x=parts[spoilt].x * 0 + 3, y=parts[spoilt].y * 0 + 3)
    count = len(starts)
    tracker = Tracker([models] * count, [SMALL_CAMERA] * count, stream_index=list(range(count)), dtype=torch.float64)
    cut = [(concatenate([window[0] for window in step]), step[0][1]) for step in zip(*(windows(part, COUNT) for part in parts), strict=True)]
    with torch.no_grad():
        return follow(tracker, tracker.init(torch.stack(starts), 0), cut)[0].T_cam_obj


# ---- what it judges


def test_sharp_edges_are_believed_in_full(dtype):
    inputs, weighting_network = inputs_of((BOX, SMOOTH), dtype)
    for wanted in (False, True):
        with torch.no_grad(), backend(wanted=wanted):
            trust = weighting_network(inputs)
        assert (trust[0] == 1).all()
        of_smooth = trust[1][inputs.observations.mask[1]]
        assert ((of_smooth >= 0) & (of_smooth <= 1)).all() and (of_smooth < 1).float().mean() > 0.9


def test_smooth_silhouettes_are_judged_as_the_network_judges_them(dtype):
    inputs, weighting_network = inputs_of(dtype=dtype)
    trust, of_all, (_, is_smooth, _) = weighting_network(inputs), weighting_network.network(inputs), silhouette_features(inputs)
    assert torch.equal(trust[is_smooth], of_all[is_smooth]) and (trust[~is_smooth] == 1).all() and is_smooth.any()


# ---- by a kernel


def test_smooth_silhouettes_are_described_the_same_by_a_kernel(dtype):
    pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
    inputs, _ = inputs_of((SMOOTH, BOX, SMOOTH), dtype)
    with torch.no_grad():
        features, is_smooth, objects = silhouette_features(inputs)
        with backend(wanted=False):
            expected, wanted, every = silhouette_features(inputs)
    # Of the box there is nothing to describe.
    assert objects.tolist() == [0, 2] and every.tolist() == [0, 1, 2]
    assert torch.equal(is_smooth, wanted) and not is_smooth[1].any()
    expected, is_smooth = expected[objects], is_smooth[objects]
    assert is_smooth.sum() > 200 and (features[~is_smooth] == 0).all()
    # What lies halfway between two pixels is counted at one or the other.
    assert ((features - expected)[is_smooth].abs() < 1e-4).all(-1).double().mean() > 0.99


def test_where_there_is_no_smooth_silhouette_there_is_nothing_to_describe():
    pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
    inputs, weighting_network = inputs_of((BOX,))
    with torch.no_grad():
        features, is_smooth, objects = silhouette_features(inputs)
        assert not len(objects) and not features.any() and not is_smooth.any() and (weighting_network(inputs) == 1).all()


# ---- in the tracker


def test_it_is_in_the_default_where_an_object_has_smooth_silhouettes():
    assert isinstance(Tracker([BOX, SMOOTH], SMALL_CAMERA).weighting_network, SilhouetteTrust)
    assert Tracker([BOX], SMALL_CAMERA).weighting_network is None
    assert Tracker([SMOOTH], SMALL_CAMERA, TrackerConfig(association=AssociationConfig(weighting_network="none"))).weighting_network is None
    assert Tracker([SMOOTH], SMALL_CAMERA, preset("paper")).weighting_network is None
    own = SilhouetteTrust(TrustNetwork())
    assert Tracker([BOX], SMALL_CAMERA, weighting_network=own).weighting_network is own


def test_it_needs_no_events_from_elsewhere_but_those_before_the_window():
    tracker = Tracker([SMOOTH], SMALL_CAMERA)
    assert tracker.looks_back and not tracker.shows_all
    assert Tracker([SMOOTH], SMALL_CAMERA, weighting_network=torch.nn.Identity()).shows_all
    assert not Tracker([BOX], SMALL_CAMERA).looks_back


def test_it_changes_the_poses_of_what_is_smooth_and_of_nothing_else():
    events = windows(moving_box(pose(), COUNT)[1], COUNT)
    for model in (BOX, SMOOTH):
        actual = []
        for trust in ("silhouettes", "none"):
            tracker = Tracker([model], SMALL_CAMERA, TrackerConfig(association=AssociationConfig(weighting_network=trust)))
            with torch.no_grad():
                actual.append(follow(tracker, tracker.init(pose()[None], 0), events)[0].T_cam_obj)
        assert torch.equal(*actual) == (model is BOX)


def test_smooth_objects_are_followed_among_noise():
    trajectory, events = moving_box(pose(), COUNT)
    from_elsewhere = moving_box(pose((0.1, 0.2, 0.3), (0.01, 0.02, 0.5)), COUNT, seed=5)[1]
    tracker = Tracker([SMOOTH], SMALL_CAMERA, dtype=torch.float64)
    with torch.no_grad():
        state, results = follow(tracker, tracker.init(pose()[None], 0), windows(merged(events, from_elsewhere[::4]), COUNT))
    assert int(results[-1].status[0]) == 0 and (state.T_cam_obj[0] - trajectory.T_cam_obj[-1]).abs().max() < 0.01


def test_a_batch_is_what_each_is_alone_and_one_that_fails_changes_nothing():
    starts = [pose(), pose((0.3, -0.5, 0.2)), pose((-0.4, 0.3, 0.0))]
    together, spoilt = tracked(SMOOTH, starts), tracked(SMOOTH, starts, spoilt=1)
    assert torch.equal(together[[0, 2]], spoilt[[0, 2]])
    alone = moving_box(starts[0], COUNT)[1]
    tracker = Tracker([SMOOTH], SMALL_CAMERA, dtype=torch.float64)
    with torch.no_grad():
        state, _ = follow(tracker, tracker.init(starts[0][None], 0), windows(alone, COUNT))
    torch.testing.assert_close(state.T_cam_obj[0], together[0], rtol=0, atol=1e-9)


def test_gradients_pass_beside_the_network():
    tracker = Tracker([SMOOTH], SMALL_CAMERA, dtype=torch.float64)
    (events, end_us), *_ = windows(moving_box(pose(), 1)[1], 1)
    state = tracker.init(pose()[None], 0)
    start = state.T_cam_obj.clone().requires_grad_()
    next_state, _ = tracker.step(changed(state, T_cam_obj=start), events, end_us)
    (gradient,) = torch.autograd.grad(next_state.T_cam_obj.sum(), start)
    assert gradient.isfinite().all() and gradient.abs().sum() > 0
    assert all(value is not None for value in tensors_of(next_state))
