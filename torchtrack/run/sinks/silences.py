"""Times without events, for the summary of a run."""

from dataclasses import dataclass

import torch

from torchtrack.run.stepping import Step

# Shorter ones are usual of slow objects; a fast one moves on by tens of pixels in this time.
_SHORTEST_US = 50_000
_MOST = 20


@dataclass(frozen=True)
class Silence:
    """A time without events: from the event before it, for so long (µs)."""

    start_us: int
    duration_us: int


class Silences:
    """Counts the times of 50 ms and more without events, and keeps the longest.

    Attributes:
        count: how many there were.
    """

    def __init__(self) -> None:
        self.count = 0
        self._longest: list[Silence] = []
        self._last_us: int | None = None

    def add(self, step: Step) -> None:
        """Take one step."""
        t_us = step.window.events.t_us
        before_us = step.window.t_start_us if self._last_us is None else self._last_us
        self._last_us = before_us
        if len(t_us) == 0:
            return
        self._last_us = int(t_us[-1])
        if self._last_us - before_us < _SHORTEST_US:
            return
        steps = torch.diff(t_us, prepend=t_us.new_tensor([before_us]))
        for at in torch.nonzero(steps >= _SHORTEST_US)[:, 0].tolist():
            self.count += 1
            self._longest.append(Silence(int(t_us[at] - steps[at]), int(steps[at])))
        self._longest = sorted(self._longest, key=lambda silence: -silence.duration_us)[:_MOST]

    @property
    def longest(self) -> tuple[Silence, ...]:
        """The longest ones, in order of time."""
        return tuple(sorted(self._longest, key=lambda silence: silence.start_us))
