"""Variations of samples: what changes, what stays, and that the truth stays true."""

import pytest
import torch
from helpers import generator, random_events, random_pose
from pydantic import ValidationError
from tracked_boxes import tensors_of

from torchtrack.core.events import EventBatch, check_events
from torchtrack.core.lie import rotation_angle_deg, se3_exp
from torchtrack.learn.augmentation import AugmentationConfig, add_noise, augmented, drop_events, flip_polarity, jitter_pose, stretch_time
from torchtrack.learn.samples import Sample

SIZE = (64, 48)


def a_sample(count=2000):
    velocity = torch.tensor([0.5, -1.0, 0.3, 0.1, 0.2, -0.1], dtype=torch.float64)
    t_us = torch.tensor([4_000, 7_000, 10_000])
    T_cam_obj = se3_exp((t_us - 4_000)[:, None] * 1e-6 * velocity) @ random_pose(1)
    return Sample(2, 1, random_events(count), t_us, T_cam_obj, velocity.repeat(3, 1), T_cam_obj[0])


def changed(before, after):
    """Names of the fields that differ."""
    names = set()
    for name, value in vars(before).items():
        other = getattr(after, name)
        pairs = zip(tensors_of(value), tensors_of(other), strict=True) if isinstance(value, EventBatch) else [(value, other)]
        if not all(torch.equal(torch.as_tensor(a), torch.as_tensor(b)) for a, b in pairs):
            names.add(name)
    return names


def test_flipped_polarity_is_the_other_one():
    sample = a_sample()
    flipped = flip_polarity(sample)
    assert changed(sample, flipped) == {"events"} and torch.equal(flipped.events.polarity, ~sample.events.polarity)
    assert changed(sample, flip_polarity(flipped)) == set()


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_events_are_dropped_at_random(share):
    sample = a_sample()
    fewer = drop_events(sample, share, generator())
    assert changed(sample, fewer) <= {"events"}
    assert len(fewer.events) == pytest.approx(2000 * (1 - share), abs=80)
    check_events(fewer.events, *SIZE)


@pytest.mark.parametrize("count", [2000, 0])
def test_noise_is_spread_over_sensor_and_time(count):
    sample = a_sample(count)
    noisy = add_noise(sample, 200.0, *SIZE, generator())
    duration_us = 10_000 - int(min([4_000, *sample.events.t_us[:1].tolist()]))
    assert len(noisy.events) - count == round(200e-6 * duration_us * SIZE[0] * SIZE[1])
    check_events(noisy.events, *SIZE)
    assert noisy.events.t_us[-1] <= 10_000 and changed(sample, noisy) == {"events"}
    assert (noisy.events.x.unique().numel(), noisy.events.y.unique().numel()) == SIZE


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_stretched_time_leaves_the_motion_true(factor):
    sample = a_sample()
    stretched = stretch_time(sample, factor)
    check_events(stretched.events, *SIZE)
    assert stretched.t_us.tolist() == [4_000 + round(factor * t) for t in (0, 3_000, 6_000)]
    later = se3_exp(1e-6 * torch.diff(stretched.t_us)[:, None] * stretched.velocity[:-1]) @ stretched.T_cam_obj[:-1]
    torch.testing.assert_close(later, sample.T_cam_obj[1:])
    inside = ((sample.events.t_us > 4_000) & (sample.events.t_us <= 7_000)).sum()
    if factor >= 1:
        assert ((stretched.events.t_us > stretched.t_us[0]) & (stretched.events.t_us <= stretched.t_us[1])).sum() == inside


def test_jitter_moves_the_start_alone():
    sample = a_sample()
    moved = [jitter_pose(sample, 2.0, 0.003, generator(seed)) for seed in range(200)]
    assert all(changed(sample, each) == {"T_start"} for each in moved)
    T_start = torch.stack([each.T_start for each in moved])
    turned_deg = rotation_angle_deg(T_start[:, :3, :3], sample.T_start[:3, :3].expand(200, 3, 3))
    shifted = T_start[:, :3, 3] - sample.T_start[:3, 3]
    # Three axes of 2° and of 3 mm each; the object turns about its own origin.
    assert turned_deg.square().mean().sqrt() == pytest.approx(2 * 3**0.5, rel=0.15)
    assert shifted.square().mean().sqrt() == pytest.approx(0.003, rel=0.15)


def test_all_together_by_the_lots_of_one_generator():
    config = AugmentationConfig(flip_polarity=0.5, drop_events=0.5, noise_hz=100.0, stretch_time=(0.5, 2.0), jitter_rotation_deg=1.0)
    sample = a_sample()
    first, again, other = (augmented(sample, config, *SIZE, generator(seed)) for seed in (1, 1, 2))
    assert changed(first, again) == set() and changed(first, other) >= {"events", "t_us", "velocity", "T_start"}
    check_events(first.events, *SIZE)
    assert changed(sample, augmented(sample, AugmentationConfig(), *SIZE, generator())) == set()


@pytest.mark.parametrize("factors", [(0.0, 1.0), (2.0, 1.0), (1.0, 1000.0)])
def test_factors_of_time_must_make_sense(factors):
    with pytest.raises(ValidationError, match="give the smaller factor first"):
        AugmentationConfig(stretch_time=factors)
