"""Events on their way through a simulated sensor: by flat pixel index, with their cause, and the delays of the readout."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchtrack.sim.sensor_profiles import EventCameraConfig


@dataclass(frozen=True)
class Fired:
    """Events in no particular order.

    Args:
        index: flat pixel index, row by row.
        t_us: time; since when, the holder says.
        polarity: whether it got brighter.
        is_noise: whether no change of the light caused it.
    """

    index: Int[Tensor, "n"]
    t_us: Int[Tensor, "n"]
    polarity: Bool[Tensor, "n"]
    is_noise: Bool[Tensor, "n"]

    @classmethod
    def none(cls, device: torch.device) -> "Fired":
        """No events."""
        index = torch.zeros(0, dtype=torch.int64, device=device)
        return cls(index, index, index.bool(), index.bool())

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, chosen: Tensor) -> "Fired":
        return Fired(self.index[chosen], self.t_us[chosen], self.polarity[chosen], self.is_noise[chosen])

    def later(self, delay_us: int | Int[Tensor, "n"]) -> "Fired":
        """The same events at later times."""
        return Fired(self.index, self.t_us + delay_us, self.polarity, self.is_noise)


def concatenate_fired(parts: Sequence[Fired], device: torch.device) -> Fired:
    """All parts after one another."""
    if not parts:
        return Fired.none(device)
    return Fired(*(torch.cat([getattr(part, item.name) for part in parts]) for item in fields(Fired)))


def read_out(pending: Fired, fired: Fired, t_us: int, config: EventCameraConfig, generator: torch.Generator) -> tuple[Fired, Fired]:
    """Events that leave the sensor by ``t_us``, and those that are still waiting; times since one start for all.

    Args:
        pending: fired before, not yet read out, at the times when they will be.
        fired: fired since.
        t_us: end of the interval.
        config: for the latency and the mean wait.
        generator: for the waits.
    """
    if not config.latency_us and not config.jitter_us:
        return fired, pending
    wait = torch.empty(len(fired), dtype=torch.float64)
    if config.jitter_us:
        wait.exponential_(1 / config.jitter_us, generator=generator)
    else:
        wait.zero_()
    delay_us = config.latency_us + wait.round().long()
    everything = concatenate_fired([pending, fired.later(delay_us.to(fired.t_us.device))], fired.t_us.device)
    ready = everything.t_us <= t_us
    return everything[ready], everything[~ready]
