"""Events without a cause in the scene: shot noise and hot pixels, as Poisson processes. Sources: :mod:`torchtrack.sim.event_camera`."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchtrack.sim.fired import Fired
from torchtrack.sim.sensor_profiles import EventCameraConfig

# Shot noise at white, as a share of that in the dark (v2e).
_BRIGHT_NOISE_SHARE = 0.25


def shot_noise(log_level: Float[Tensor, "h w"], config: EventCameraConfig, duration_us: int, generator: torch.Generator) -> Fired:
    """Noise of one interval, ON and OFF alike; less often where it is bright. Times are µs since the interval's start."""
    pixels = log_level.numel()
    count = _count(config.shot_noise_rate_hz * 1e-6 * duration_us * pixels, generator)
    where, when, sign, luck = torch.rand((4, count), generator=generator, dtype=torch.float64).to(log_level.device)
    index, t_us = (where * pixels).long(), 1 + (when * duration_us).long()
    brightness = (log_level.view(-1)[index].exp() - config.dark_level).clamp(0, 1)
    kept = luck < 1 - (1 - _BRIGHT_NOISE_SHARE) * brightness
    return Fired(index, t_us, sign < 0.5, torch.ones_like(kept))[kept]


class HotPixels:
    """The pixels of a sensor that fire all the time.

    Args:
        config: for their share and mean rate.
        pixels: of the sensor.
        generator: for where they are and how fast they fire.
        device: where events are made.
    """

    def __init__(self, config: EventCameraConfig, pixels: int, generator: torch.Generator, device: torch.device) -> None:
        count = round(config.hot_pixel_share * pixels)
        self.index = torch.randperm(pixels, generator=generator)[:count] if count else torch.zeros(0, dtype=torch.int64)
        self.rate_hz = torch.empty(count, dtype=torch.float64)
        if count:
            self.rate_hz.exponential_(1 / max(config.hot_pixel_rate_hz, 1e-9), generator=generator)
        self._device = device

    def fire(self, duration_us: int, generator: torch.Generator) -> Fired:
        """Events of one interval; times are µs since its start."""
        if not len(self.index):
            return Fired.none(self._device)
        counts = torch.poisson(self.rate_hz * (1e-6 * duration_us), generator=generator).long()
        index = self.index.repeat_interleave(counts).to(self._device)
        when = torch.rand(len(index), generator=generator, dtype=torch.float64).to(self._device)
        yes = torch.ones(len(index), dtype=torch.bool, device=self._device)
        return Fired(index, 1 + (when * duration_us).long(), yes, yes)


def rested(noise: Fired, last_event_us: Int[Tensor, "h w"], start_us: int, refractory_us: int) -> Bool[Tensor, "n"]:
    """Which events meet a pixel that is not in reset by its last event before them (two in one interval may still be close)."""
    return start_us + noise.t_us >= last_event_us.view(-1)[noise.index] + refractory_us


def _count(expected: float, generator: torch.Generator) -> int:
    return int(torch.poisson(torch.tensor(expected, dtype=torch.float64), generator=generator))
