"""Samples cut from sequences: their truth, their order, batches, workers, and what can be wrong."""

import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_sequence import CAMERA, true_poses, write_tiny_sequence
from torch.utils.data import DataLoader
from tracked_boxes import assert_same

from torchtrack import ObjectModel, Tracker, read_sequence
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core.events import concatenate
from torchtrack.core.lie import rotation_angle_deg, se3_exp
from torchtrack.errors import EventDataError, MissingFileError
from torchtrack.io import Sequence, SequenceObject, Trajectory, open_events
from torchtrack.io.convert import convert
from torchtrack.learn.augmentation import AugmentationConfig
from torchtrack.learn.dataset import ClipConfig, SequenceBatches, WindowDataset, WindowStream, opened
from torchtrack.learn.samples import collate, start_state
from torchtrack.tracking.expectation import predicted_after

# Workers are tested on small machines too, and forked: a fresh process would take seconds to import everything.
pytestmark = [pytest.mark.filterwarnings("ignore:This DataLoader will create"), pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")]
VARIED = AugmentationConfig(flip_polarity=0.5, drop_events=0.5, noise_hz=50.0, stretch_time=(0.5, 2.0), jitter_rotation_deg=1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two sequences of 60 ms, the second with two objects."""
    path = tmp_path_factory.mktemp("sequences")
    write_tiny_sequence(path, "one")
    write_tiny_sequence(path, "two", ("box", "other"))
    return path


def paths(folder):
    return [folder / "one.npz", folder / "two.npz"]


def assert_equal(ours, theirs):
    assert (ours.sequence, ours.object) == (theirs.sequence, theirs.object)
    assert_same(ours, theirs)


# ---- by number


def test_samples_have_their_events_and_their_truth(folder):
    data = WindowDataset([folder / "one.npz"], ClipConfig(window_us=5_000, windows=3, past_us=7_000))
    assert len(data) == 4
    sample, events = data[1], concatenate(read_sequence(folder / "one.npz").events.chunks())
    assert sample.t_us.tolist() == [15_000, 20_000, 25_000, 30_000]
    expected = events.slice_time(8_000, 30_000)
    assert torch.equal(sample.events.t_us, expected.t_us) and torch.equal(sample.events.x, expected.x)
    torch.testing.assert_close(sample.T_cam_obj, true_poses(60_000).at(sample.t_us), atol=1e-9, rtol=0)
    assert torch.equal(sample.T_start, sample.T_cam_obj[0])


def test_true_velocities_carry_poses_on(folder):
    sample = WindowDataset([folder / "one.npz"], ClipConfig(windows=5))[1]
    later = se3_exp(0.005 * sample.velocity[:-1]) @ sample.T_cam_obj[:-1]
    torch.testing.assert_close(later, sample.T_cam_obj[1:], atol=1e-7, rtol=0)


@pytest.mark.parametrize(("every_us", "count"), [(None, 12), (2_000, 28), (20_000, 3)])
def test_samples_may_overlap_and_leave_gaps(folder, every_us, count):
    data = WindowDataset([folder / "one.npz"], ClipConfig(every_us=every_us))
    starts = [int(sample.t_us[0]) for sample in data]
    assert len(data) == len(starts) == count and starts == list(range(0, 55_001, every_us or 5_000))


def test_every_object_of_every_sequence_has_samples(folder):
    data = WindowDataset(paths(folder), ClipConfig(windows=6))
    assert [place[:2] for place in data.places] == [(0, 0)] * 2 + [(1, 0)] * 2 + [(1, 1)] * 2
    assert [(sample.sequence, sample.object) for sample in data] == [place[:2] for place in data.places]


@pytest.mark.parametrize("workers", [0, 2])
def test_samples_are_the_same_whoever_reads_them(folder, workers):
    data = WindowDataset(paths(folder), augmentation=VARIED, seed=3)
    loader = DataLoader(data, batch_size=None, num_workers=workers, multiprocessing_context="fork" if workers else None)
    for ours, theirs in zip(loader, WindowDataset(paths(folder), augmentation=VARIED, seed=3), strict=True):
        assert_equal(ours, theirs)


def test_seed_and_epoch_decide_how_samples_vary(folder):
    data = WindowDataset(paths(folder), augmentation=VARIED)
    first, again = data[3], data[3]
    assert_equal(first, again)
    data.set_epoch(1)
    other = WindowDataset(paths(folder), augmentation=VARIED, seed=1)[3]
    for changed in (data[3], other):
        assert not torch.equal(changed.T_start, first.T_start)


def test_a_dataset_can_be_pickled(folder):
    data = WindowDataset(paths(folder))
    first = data[0]
    assert_equal(pickle.loads(pickle.dumps(data))[0], first)


@pytest.mark.parametrize("suffix", [".h5", ".raw"])
def test_events_of_other_formats_do_as_well(folder, tmp_path, suffix):
    sequence = read_sequence(folder / "one.npz")
    path = tmp_path / f"one{suffix}"
    convert(sequence.events.path, path, "sequence" if suffix == ".h5" else "evt3")
    source = path
    if suffix == ".raw":
        source = Sequence("one", open_events(path, CAMERA.width, CAMERA.height), CAMERA, sequence.objects)
    for ours, theirs in zip(WindowStream([source]), WindowStream([folder / "one.npz"]), strict=True):
        assert torch.equal(ours.events.t_us, theirs.events.t_us) and torch.equal(ours.T_cam_obj, theirs.T_cam_obj)


# ---- streamed


@pytest.mark.parametrize("config", [ClipConfig(), ClipConfig(windows=4, past_us=6_000), ClipConfig(windows=2, past_us=0)])
def test_a_stream_gives_the_samples_of_the_dataset(folder, config):
    streamed = sorted(WindowStream(paths(folder), config), key=lambda sample: (sample.sequence, sample.object, int(sample.t_us[0])))
    data = list(WindowDataset(paths(folder), config))
    # The last window is complete only once an event after it was seen, or the stream ends in it.
    assert len(data) - len(streamed) <= 3
    by_place = {(sample.sequence, sample.object, int(sample.t_us[0])): sample for sample in data}
    for sample in streamed:
        theirs = by_place[sample.sequence, sample.object, int(sample.t_us[0])]
        assert_equal(sample, theirs)


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_workers_share_the_sequences_out(folder, workers):
    stream = WindowStream(paths(folder), augmentation=VARIED, shuffle=True)
    loader = DataLoader(stream, batch_size=None, num_workers=workers, multiprocessing_context="fork")
    place = lambda sample: (sample.sequence, sample.object, sample.events.t_us.tolist())  # noqa: E731
    assert sorted(map(place, loader)) == sorted(map(place, stream))


def test_epochs_shuffle_the_sequences(folder):
    stream = WindowStream(paths(folder) * 4, ClipConfig(windows=12), shuffle=True)
    orders = []
    for epoch in (0, 0, 1):
        stream.set_epoch(epoch)
        orders.append([sample.sequence for sample in stream])
    assert orders[0] == orders[1] != orders[2] and sorted(orders[0]) == sorted(orders[2])


# ---- batches


def test_batches_have_a_stream_for_each_sample(folder):
    data = WindowDataset(paths(folder), ClipConfig(windows=2))
    samples = [data[number] for number in (1, 8, 3)]
    batch = collate(samples)
    assert batch.windows == 2 and batch.t_us.shape == (3, 3) and batch.sequence.tolist() == [0, 1, 0]
    pieces = [batch.past(), *(batch.window(number)[0] for number in range(2))]
    assert sum(map(len, pieces)) == len(batch.events) == sum(len(sample.events) for sample in samples)
    for stream, sample in enumerate(samples):
        own = pieces[1].stream_index == stream
        assert torch.equal(pieces[1].t_us[own], sample.events.slice_time(*sample.t_us[:2].tolist()).t_us)
    assert batch.window(1)[1].tolist() == [int(sample.t_us[2]) for sample in samples]
    assert_same(batch.to("cpu"), batch)


def test_batches_are_of_one_object_each_and_leave_remainders_out(folder):
    data = WindowDataset(paths(folder))
    batches = SequenceBatches(data, 5, seed=2)
    drawn = list(batches)
    assert len(drawn) == len(batches) == 6 and list(batches) == drawn
    assert all(len({data.places[index][:2] for index in batch}) == 1 for batch in drawn)
    assert len({index for batch in drawn for index in batch}) == 30
    data.set_epoch(1)
    assert list(batches) != drawn
    (loaded, *_) = DataLoader(data, batch_sampler=batches, collate_fn=collate)
    assert loaded.t_us.shape == (5, 2)


def test_a_tracker_follows_a_batch_from_its_start(folder):
    data = WindowDataset([folder / "one.npz"], ClipConfig(windows=3), AugmentationConfig(stretch_time=(0.8, 1.2)))
    batch = collate([data[number] for number in range(3)])
    model = ObjectModel.from_file(data.sequences[0].objects[0].model_path())
    tracker = Tracker([model] * 3, [CAMERA] * 3, TrackerConfig(disabled=frozenset({Component.TURNS_FADE})), range(3), torch.float64)
    state = start_state(tracker, batch, speed_sigma_m_s=0.05)
    assert torch.equal(state.t_us, batch.t_us[:, 0]) and (state.maps.last_event_us <= batch.t_us[:, 0, None, None]).all()
    for number in range(batch.windows):
        predicted = predicted_after(tracker, state, (batch.t_us[:, number + 1] - state.t_us) * 1e-6).T_cam_obj
        if number == 0:
            torch.testing.assert_close(predicted, batch.T_cam_obj[:, 1], atol=2e-5, rtol=0)
        state, _ = tracker(batch.window(number)[0], state, batch.window(number)[1])
    assert (rotation_angle_deg(state.T_cam_obj[:, :3, :3], batch.T_cam_obj[:, -1, :3, :3]) < 1.0).all()
    assert (start_state(tracker, batch).velocity == 0).all()


# ---- what can be wrong


def test_missing_files_are_told(tmp_path):
    with pytest.raises(MissingFileError, match="nowhere"):
        WindowDataset([tmp_path / "nowhere.npz"])


@pytest.mark.parametrize("kind", [WindowDataset, WindowStream])
@pytest.mark.parametrize("truth", [None, 1])
def test_truth_is_needed(folder, kind, truth):
    sequence = read_sequence(folder / "one.npz")
    poses = None if truth is None else Trajectory(torch.tensor([0]), torch.eye(4)[None])
    bare = replace(sequence, objects=(replace(sequence.objects[0], ground_truth=poses),))
    with pytest.raises(EventDataError, match="'one' has no ground truth for 'box'"):
        kind([bare])


@pytest.mark.parametrize("kind", [WindowDataset, WindowStream])
def test_sequences_may_be_too_short(folder, kind):
    with pytest.raises(EventDataError, match=r"sample of 0.065 s \(13 windows of 5000 µs\)"):
        kind(paths(folder), ClipConfig(windows=13))


def test_streams_do_not_overlap(folder):
    with pytest.raises(ValueError, match="use WindowDataset"):
        WindowStream(paths(folder), ClipConfig(every_us=1000))


def test_batches_need_samples_of_one_length(folder):
    with pytest.raises(ValueError, match="at least 1, got 0"):
        SequenceBatches(WindowDataset(paths(folder)), 0)
    with pytest.raises(ValueError, match=r"got \[1, 2\]"):
        collate([WindowDataset(paths(folder), ClipConfig(windows=count))[0] for count in (1, 2)])
    with pytest.raises(ValueError, match="got no sample"):
        collate([])


def test_the_tracker_must_fit_the_batch(folder):
    data = WindowDataset([folder / "one.npz"])
    model = ObjectModel.from_file(data.sequences[0].objects[0].model_path())
    with pytest.raises(ValueError, match=r"one object and one stream for each of the 2 samples"):
        start_state(Tracker([model] * 2, CAMERA), collate([data[0], data[1]]))


def test_what_is_opened_already_is_taken_as_it_is(folder):
    sequence = read_sequence(folder / "one.npz")
    assert opened(sequence) is sequence and isinstance(sequence.objects[0], SequenceObject) and isinstance(sequence.objects[0].mesh_path, Path)
