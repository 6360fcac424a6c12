"""Windows with true poses, cut from sequences: by number in any order, or streamed from disk in the order of time.

A sequence is a file that the simulator or ``torchtrack convert`` writes (``.npz``, ``.h5``), or a
:class:`torchtrack.io.Sequence` put together from events of any format, a camera, model files and trajectories::

    recording = Sequence("mug", open_events("mug.raw"), camera, (SequenceObject("mug", Path("mug.obj"), None, read_trajectory("mug.tum")),))
    loader = DataLoader(WindowDataset([recording, "cube.npz"]), batch_size=4, collate_fn=collate, num_workers=2)
"""

import os
from collections.abc import Iterator
from collections.abc import Sequence as Many
from functools import lru_cache

import torch
from pydantic import Field
from torch.utils.data import Dataset, IterableDataset, Sampler, get_worker_info

from torchtrack.config.settings import Settings
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.lie import se3_inverse, se3_log
from torchtrack.core.windows import clipped, windows_by_time
from torchtrack.errors import EventDataError
from torchtrack.io import Sequence, Trajectory, read_sequence
from torchtrack.learn.augmentation import AugmentationConfig, augmented
from torchtrack.learn.samples import Sample

Source = str | os.PathLike[str] | Sequence

# Half the time over which true velocities are taken as differences (µs).
_HALF_STEP_US = 500


class ClipConfig(Settings):
    """How samples are cut from sequences."""

    window_us: int = Field(5_000, ge=100, le=1_000_000, description="Length of a window (µs).")
    windows: int = Field(1, ge=1, le=10_000, description="Windows in a row of each sample.")
    past_us: int = Field(30_000, ge=0, le=10_000_000, description="Events of so long before the first window are given too (µs).")
    every_us: int | None = Field(None, ge=100, description="A sample begins this long after the last (µs); by default where the last one ends.")

    @property
    def length_us(self) -> int:
        """How long the windows of a sample last together."""
        return self.window_us * self.windows

    @property
    def step_us(self) -> int:
        """From the start of one sample to that of the next."""
        return self.length_us if self.every_us is None else self.every_us


def opened(source: Source) -> Sequence:
    """A sequence with ground truth of every object.

    Raises:
        TorchtrackError: of the kind that fits, if a file is missing or wrong.
        EventDataError: if there is no ground truth.
    """
    sequence = source if isinstance(source, Sequence) else read_sequence(source)
    for obj in sequence.objects:
        if obj.ground_truth is None or len(obj.ground_truth) < 2:
            raise EventDataError(f"sequence '{sequence.name}' has no ground truth for '{obj.label}': learning needs true poses (poses, pose_t).")
    return sequence


def _truth(sequence: Sequence, number: int) -> Trajectory:
    truth = sequence.objects[number].ground_truth
    if truth is None:
        raise EventDataError(f"sequence '{sequence.name}' has no ground truth for '{sequence.objects[number].label}'.")
    return truth


def _starts_us(truth: Trajectory, config: ClipConfig) -> range:
    """Where samples begin: as long as the truth is known to their ends."""
    return range(int(truth.t_us[0]), int(truth.t_us[-1]) - config.length_us + 1, config.step_us)


def _velocity(truth: Trajectory, t_us: torch.Tensor) -> torch.Tensor:
    """True velocities ``[k, 6]``: ``dT/dt = ξ^ T``."""
    limits = truth.t_us[0], truth.t_us[-1]
    before, after = (t_us - _HALF_STEP_US).clamp(*limits), (t_us + _HALF_STEP_US).clamp(*limits)
    return se3_log(truth.at(after) @ se3_inverse(truth.at(before))) / (1e-6 * (after - before).double())[:, None]


class _Recordings:
    """What both ways to draw samples share: the sequences, and how samples are cut from them and varied."""

    def __init__(self, sources: Many[Source], config: ClipConfig | None, augmentation: AugmentationConfig | None, seed: int) -> None:
        self.sequences = [opened(source) for source in sources]
        self.config, self.augmentation, self.seed, self.epoch = config or ClipConfig(), augmentation, seed, 0

    def set_epoch(self, epoch: int) -> None:
        """Draw and vary samples otherwise than in other epochs; before workers are started."""
        self.epoch = epoch

    def _sample(self, number: int, obj: int, events: EventBatch, start_us: int, generator: torch.Generator) -> Sample:
        """The sample of one object that begins at a time, of events around it."""
        sequence, config = self.sequences[number], self.config
        truth = _truth(sequence, obj)
        t_us = start_us + config.window_us * torch.arange(config.windows + 1)
        T_cam_obj = truth.at(t_us)
        inside = events.slice_time(start_us - config.past_us, start_us + config.length_us)
        sample = Sample(number, obj, inside, t_us, T_cam_obj, _velocity(truth, t_us), T_cam_obj[0].clone())
        if self.augmentation is None:
            return sample
        return augmented(sample, self.augmentation, sequence.camera.width, sequence.camera.height, generator)


class WindowDataset(_Recordings, Dataset[Sample]):
    """Samples of all objects of all sequences, by number.

    The events of the last few sequences that were asked for are held in memory, in each worker: draw batches from one
    sequence (:class:`SequenceBatches`), or use :class:`WindowStream` for long recordings.

    Args:
        sources: files, or sequences.
        config: how samples are cut.
        augmentation: how they are varied: in the same way for the same ``seed``, :meth:`set_epoch` and number.
        held: sequences whose events are held.

    Raises:
        EventDataError: if a sequence has no ground truth, or none is long enough for a sample.
    """

    def __init__(
        self,
        sources: Many[Source],
        config: ClipConfig | None = None,
        augmentation: AugmentationConfig | None = None,
        *,
        seed: int = 0,
        held: int = 1,
    ) -> None:
        super().__init__(sources, config, augmentation, seed)
        self.held = held
        self.places = [
            (number, obj, start_us)
            for number, sequence in enumerate(self.sequences)
            for obj in range(len(sequence.objects))
            for start_us in _starts_us(_truth(sequence, obj), self.config)
        ]
        _check_any(len(self.places), self.config)
        self._events = lru_cache(held)(self._read)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "_events"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._events = lru_cache(self.held)(self._read)

    def _read(self, number: int) -> EventBatch:
        return concatenate(self.sequences[number].events.chunks())

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> Sample:
        number, obj, start_us = self.places[index]
        return self._sample(number, obj, self._events(number), start_us, _generator(self.seed, self.epoch, index))


class SequenceBatches(Sampler[list[int]]):
    """Batches of numbers, each of one object of one sequence, in random order (for ``DataLoader(batch_sampler=...)``).

    The sequences are gone through one after the other, so that few have to be held in memory. What remains of an object
    after its last full batch is left out: trackers of one size will do.

    Args:
        dataset: whose samples are drawn.
        batch_size: samples of a batch.
        seed: another order for another seed, and for another epoch of the dataset.
    """

    def __init__(self, dataset: WindowDataset, batch_size: int, seed: int = 0) -> None:
        if batch_size < 1:
            raise ValueError(f"batch_size must be at least 1, got {batch_size}.")
        self.dataset, self.batch_size, self.seed = dataset, batch_size, seed
        self._of_object: dict[tuple[int, int], list[int]] = {}
        for index, (number, obj, _) in enumerate(dataset.places):
            self._of_object.setdefault((number, obj), []).append(index)

    def __len__(self) -> int:
        return sum(len(indices) // self.batch_size for indices in self._of_object.values())

    def __iter__(self) -> Iterator[list[int]]:
        generator = _generator(self.seed, self.dataset.epoch)
        members = list(self._of_object.values())
        for place in torch.randperm(len(members), generator=generator).tolist():
            indices = members[place]
            order = torch.randperm(len(indices), generator=generator).tolist()
            for first in range(0, len(indices) - self.batch_size + 1, self.batch_size):
                yield [indices[k] for k in order[first : first + self.batch_size]]


class WindowStream(_Recordings, IterableDataset[Sample]):
    """Samples in the order of time, streamed from disk in constant memory; each worker reads sequences of its own.

    Args:
        sources: files, or sequences.
        config: how samples are cut; ``every_us`` is not for streams.
        augmentation: how they are varied.
        seed: of the order of the sequences and of what is varied, anew in each epoch (:meth:`set_epoch`).
        shuffle: draw the sequences in random order; their samples stay in the order of time.

    Raises:
        EventDataError: if a sequence has no ground truth, or none is long enough for a sample.
        ValueError: if ``every_us`` is given.
    """

    def __init__(
        self,
        sources: Many[Source],
        config: ClipConfig | None = None,
        augmentation: AugmentationConfig | None = None,
        *,
        seed: int = 0,
        shuffle: bool = False,
    ) -> None:
        super().__init__(sources, config, augmentation, seed)
        self.shuffle = shuffle
        if self.config.every_us is not None:
            raise ValueError("every_us: a stream gives every window once; use WindowDataset for samples that overlap or leave gaps.")
        truths = [_truth(sequence, obj) for sequence in self.sequences for obj in range(len(sequence.objects))]
        _check_any(sum(len(_starts_us(truth, self.config)) for truth in truths), self.config)

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        first, step = (worker.id, worker.num_workers) if worker else (0, 1)
        order = list(range(len(self.sequences)))
        if self.shuffle:
            order = torch.randperm(len(order), generator=_generator(self.seed, self.epoch)).tolist()
        for number in order[first::step]:
            yield from self._samples(number)

    def _samples(self, number: int) -> Iterator[Sample]:
        """The samples of one sequence, all objects of a window one after the other."""
        sequence, config = self.sequences[number], self.config
        truths = [_truth(sequence, obj) for obj in range(len(sequence.objects))]
        start_us = min(int(truth.t_us[0]) for truth in truths)
        generator = _generator(self.seed, self.epoch, number)
        past = EventBatch.empty()
        for window in windows_by_time(clipped(sequence.events.chunks(), start_us), config.length_us, start_us):
            events = concatenate([past, window.events])
            for obj, truth in enumerate(truths):
                if truth.t_us[0] <= window.t_start_us and window.t_end_us <= truth.t_us[-1]:
                    yield self._sample(number, obj, events, window.t_start_us, generator)
            past = events.slice_time(window.t_end_us - config.past_us, window.t_end_us)


def _check_any(count: int, config: ClipConfig) -> None:
    """Raise :class:`EventDataError` unless there are samples."""
    if count == 0:
        length_s = 1e-6 * config.length_us
        raise EventDataError(f"no sequence has a sample of {length_s:g} s ({config.windows} windows of {config.window_us} µs) with ground truth.")


def _generator(*numbers: int) -> torch.Generator:
    """Chance that hangs on some numbers alone."""
    # A tuple's hash is the same in every process: integers are not salted.
    return torch.Generator().manual_seed(hash(numbers) % 2**63)
