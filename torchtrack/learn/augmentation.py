"""Changes of a sample that leave its truth true: one pure function each, with a generator where chance plays a part."""

import math
from dataclasses import replace
from typing import Any

import torch
from pydantic import Field, field_validator
from torch import Generator

from torchtrack.config.settings import Settings
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.core.lie import se3_exp, se3_inverse
from torchtrack.learn.samples import Sample

_Range = tuple[float, float]


class AugmentationConfig(Settings):
    """How samples are varied; by default not at all."""

    flip_polarity: float = Field(0.0, ge=0, le=1, description="Probability that brighter becomes darker, and darker brighter.")
    drop_events: float = Field(0.0, ge=0, lt=1, description="Share of the events that is left out, at most.")
    noise_hz: float = Field(0.0, ge=0, le=1e4, description="Rate of noise that is added to each pixel (1/s), at most.")
    stretch_time: _Range = Field((1.0, 1.0), description="Range of factors that all times are stretched by: at 2 everything takes twice as long.")
    jitter_rotation_deg: float = Field(0.0, ge=0, le=180, description="Standard deviation of the pose to start from, about each axis (°).")
    jitter_translation_m: float = Field(0.0, ge=0, le=10, description="Standard deviation of the pose to start from, along each axis (m).")

    @field_validator("stretch_time")
    @classmethod
    def _positive(cls, factors: _Range) -> Any:
        if not 0.01 <= factors[0] <= factors[1] <= 100:
            raise ValueError(f"give the smaller factor first, both between 0.01 and 100; got {list(factors)}")
        return factors


def flip_polarity(sample: Sample) -> Sample:
    """Brighter becomes darker, and darker brighter: as if object and background had changed their brightness."""
    return replace(sample, events=replace(sample.events, polarity=~sample.events.polarity))


def drop_events(sample: Sample, share: float, generator: Generator) -> Sample:
    """Leave each event out with the probability ``share``."""
    return replace(sample, events=sample.events[torch.rand(len(sample.events), generator=generator) >= share])


def add_noise(sample: Sample, rate_hz: float, width: int, height: int, generator: Generator) -> Sample:
    """Events at random pixels and times between the sample's first event and its end, ``rate_hz`` of each pixel."""
    first_us = min([int(sample.t_us[0]), *sample.events.t_us[:1].tolist()])
    last_us = int(sample.t_us[-1])
    count = round(rate_hz * 1e-6 * (last_us - first_us) * width * height)

    def drawn(limit: int, dtype: torch.dtype = torch.int32) -> torch.Tensor:
        return torch.randint(limit, (count,), generator=generator).to(dtype)

    t_us = first_us + 1 + drawn(max(last_us - first_us, 1), torch.int64)
    noise = EventBatch(drawn(width), drawn(height), t_us, drawn(2).bool(), torch.zeros(count, dtype=torch.int64))
    both = concatenate([sample.events.of_stream(0), noise])
    return replace(sample, events=both[both.t_us.sort(stable=True).indices])


def stretch_time(sample: Sample, factor: float) -> Sample:
    """Let everything take ``factor`` times as long, from the start of the first window on: windows last longer, motions are slower."""
    origin_us = sample.t_us[0]

    def stretched(t_us: torch.Tensor) -> torch.Tensor:
        return origin_us + ((t_us - origin_us).double() * factor).round().long()

    events = replace(sample.events, t_us=stretched(sample.events.t_us))
    return replace(sample, events=events, t_us=stretched(sample.t_us), velocity=sample.velocity / factor)


def jitter_pose(sample: Sample, rotation_deg: float, translation_m: float, generator: Generator) -> Sample:
    """Start from a pose beside the true one: turned about the object's origin and moved, both by normal deviates."""
    sigma = torch.tensor([math.radians(rotation_deg)] * 3 + [translation_m] * 3, dtype=torch.float64)
    offset = se3_exp(torch.randn(6, generator=generator, dtype=torch.float64) * sigma)
    to_origin = torch.eye(4, dtype=torch.float64)
    to_origin[:3, 3] = sample.T_start[:3, 3]
    return replace(sample, T_start=to_origin @ offset @ se3_inverse(to_origin) @ sample.T_start)


def augmented(sample: Sample, config: AugmentationConfig, width: int, height: int, generator: Generator) -> Sample:
    """A sample varied as configured, by lots that ``generator`` draws."""
    lots = torch.rand(4, generator=generator).tolist()
    if lots[0] < config.flip_polarity:
        sample = flip_polarity(sample)
    if config.drop_events:
        sample = drop_events(sample, lots[1] * config.drop_events, generator)
    if config.noise_hz:
        sample = add_noise(sample, lots[2] * config.noise_hz, width, height, generator)
    low, high = config.stretch_time
    if (low, high) != (1.0, 1.0):
        sample = stretch_time(sample, low * (high / low) ** lots[3])
    if config.jitter_rotation_deg or config.jitter_translation_m:
        sample = jitter_pose(sample, config.jitter_rotation_deg, config.jitter_translation_m, generator)
    return sample
