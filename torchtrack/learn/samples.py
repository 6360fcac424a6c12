"""What a dataset gives: a few windows of one object with the truth, and batches of them with one stream each."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchtrack.core.events import EventBatch, concatenate
from torchtrack.tracking.frontend.time_surface import update_last_event
from torchtrack.tracking.initialization import check_poses, first_state
from torchtrack.tracking.motion.model import initial_covariance
from torchtrack.tracking.state import TrackerState
from torchtrack.tracking.tracker import Tracker


@dataclass(frozen=True)
class Sample:
    """Some windows in a row of one object, and the events of a while before them.

    Args:
        sequence, object: numbers of the sequence in its dataset, and of the object in its sequence.
        events: of one stream, in the order of time.
        t_us: where windows begin and end: window ``k`` is ``t_us[k] < t <= t_us[k + 1]``; earlier events are the past.
        T_cam_obj: true poses there (float64).
        velocity: true velocities there: ``dT/dt = ξ^ T`` with ``ξ = [φ, ρ]`` in rad/s and m/s (float64).
        T_start: pose to start from: the first true one, unless it was moved.
    """

    sequence: int
    object: int
    events: EventBatch
    t_us: Int[Tensor, "k"]
    T_cam_obj: Float[Tensor, "k 4 4"]
    velocity: Float[Tensor, "k 6"]
    T_start: Float[Tensor, "4 4"]


@dataclass(frozen=True)
class Batch:
    """Samples as one batch: stream ``b`` of the events is that of sample ``b``. Fields are those of :class:`Sample`."""

    sequence: Int[Tensor, "b"]
    object: Int[Tensor, "b"]
    events: EventBatch
    t_us: Int[Tensor, "b k"]
    T_cam_obj: Float[Tensor, "b k 4 4"]
    velocity: Float[Tensor, "b k 6"]
    T_start: Float[Tensor, "b 4 4"]

    @property
    def windows(self) -> int:
        """How many windows each sample has."""
        return self.t_us.shape[1] - 1

    def past(self) -> EventBatch:
        """The events before the first window."""
        return self.events[self.events.t_us <= self.t_us[self.events.stream_index, 0]]

    def window(self, number: int) -> tuple[EventBatch, Int[Tensor, "b"]]:
        """The events of a window, and when it ends in each stream (µs)."""
        since, until = self.t_us[self.events.stream_index, number], self.t_us[self.events.stream_index, number + 1]
        return self.events[(self.events.t_us > since) & (self.events.t_us <= until)], self.t_us[:, number + 1]

    def to(self, device: torch.device | str) -> "Batch":
        """The same batch on another device."""
        return Batch(**{name: value.to(device) for name, value in vars(self).items()})


def collate(samples: Sequence[Sample]) -> Batch:
    """One batch of samples that have equally many windows; events stay ragged (for ``DataLoader(collate_fn=collate)``).

    Raises:
        ValueError: if there is no sample, or the numbers of windows differ.
    """
    counts = {len(sample.t_us) - 1 for sample in samples}
    if len(counts) != 1:
        raise ValueError(f"samples of one batch must have equally many windows, got {sorted(counts) or 'no sample'}.")
    events = concatenate(sample.events.of_stream(stream) for stream, sample in enumerate(samples))
    tensors = {name: torch.stack([getattr(sample, name) for sample in samples]) for name in ("t_us", "T_cam_obj", "velocity", "T_start")}
    numbers = {name: torch.tensor([getattr(sample, name) for sample in samples]) for name in ("sequence", "object")}
    return Batch(**numbers, events=events, **tensors)


def start_state(tracker: Tracker, batch: Batch, speed_sigma_m_s: float | None = None) -> TrackerState:
    """The tracker's state before the first window of a batch, with the past in its time surface.

    Args:
        tracker: with one object and one stream for each sample, in their order.
        batch: the samples.
        speed_sigma_m_s: start with the true velocity, uncertain by this; by default the velocity is not known.

    Raises:
        ValueError: if the tracker is not for such a batch.
        PoseError: if a pose to start from is none, or lies behind the camera.
    """
    if tracker.stream_index.tolist() != list(range(len(batch.t_us))) or tracker.streams != len(batch.t_us):
        raise ValueError(
            f"the tracker needs one object and one stream for each of the {len(batch.t_us)} samples: "
            f"Tracker([model] * {len(batch.t_us)}, [camera] * {len(batch.t_us)}, stream_index=range({len(batch.t_us)}))."
        )
    # Objects of samples may be anywhere before the camera.
    check_poses(batch.T_start, tracker.centre_obj, tracker.object_names)
    state = first_state(tracker, batch.T_start.double(), batch.t_us[:, 0])
    maps = replace(state.maps, last_event_us=update_last_event(state.maps.last_event_us, batch.past()))
    state = replace(state, maps=maps)
    if speed_sigma_m_s is None:
        return state
    motion = tracker.config.motion.model_copy(update={"initial_speed_m_s": speed_sigma_m_s})
    velocity = state_velocity(batch.velocity[:, 0], batch.T_cam_obj[:, 0], tracker.centre_obj.double())
    covariance = initial_covariance(tracker.diameter_m, motion)
    return replace(state, motion=replace(state.motion, velocity=velocity.to(state.velocity), covariance=covariance))


def state_velocity(twist: Float[Tensor, "b 6"], T_cam_obj: Float[Tensor, "b 4 4"], centre_obj: Float[Tensor, "b 3"]) -> Float[Tensor, "b 6"]:
    """Velocities as the tracker's state has them, rotation and velocity of the centre, from ``ξ`` with ``dT/dt = ξ^ T``."""
    centre_cam = (T_cam_obj[:, :3, :3] @ centre_obj[..., None])[..., 0] + T_cam_obj[:, :3, 3]
    return torch.cat([twist[:, :3], twist[:, 3:] + torch.linalg.cross(twist[:, :3], centre_cam)], -1)
