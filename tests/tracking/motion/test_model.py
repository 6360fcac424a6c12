"""Motion: the covariance of a prediction against drawn motions, inverses, the left perturbation, and velocities that die away."""

import pytest
import torch
from helpers import generator, pose

from torchtrack.config.tracker import MotionConfig
from torchtrack.core.lie import retract_about, se3_inverse, se3_log, transform_points
from torchtrack.core.linalg import inverse
from torchtrack.core.pose_covariance import left_covariance
from torchtrack.tracking.motion.model import (
    TURN_S,
    expected_velocity,
    fade,
    initial_covariance,
    predict_covariance,
    with_dropped,
)

DIAMETER_M = 0.2


def double(*values):
    return torch.tensor(values, dtype=torch.float64)


def random_covariance(size=12, batch=1, seed=0, scale=1.0):
    root = torch.randn((batch, size, 2 * size), generator=generator(seed), dtype=torch.float64)
    return scale * root @ root.transpose(1, 2) / (2 * size)


def predicted(covariance, velocity=(0.0,) * 6, dt_s=0.01, diameter_m=DIAMETER_M, **settings):
    velocity = double(*velocity).expand(len(covariance), 6)
    times, diameters = (double(value).expand(len(covariance)) for value in (dt_s, diameter_m))
    return predict_covariance(covariance, velocity, times, diameters, MotionConfig(**settings))


# ---- the start


def test_at_the_start_rim_and_centre_are_as_uncertain_as_told():
    config = MotionConfig(initial_shift=0.01, initial_speed_m_s=0.4)
    sigma = initial_covariance(torch.tensor([0.2, 0.5]), config).diagonal(dim1=1, dim2=2).sqrt()
    # Of the radius 0.1 m: 2 mm are 0.02 rad, and 0.4 m/s are 4 rad/s.
    assert sigma[0].tolist() == pytest.approx([0.02] * 3 + [0.002] * 3 + [4.0] * 3 + [0.4] * 3)
    assert sigma[1].tolist() == pytest.approx([0.02] * 3 + [0.005] * 3 + [1.6] * 3 + [0.4] * 3)
    assert sigma.dtype == torch.float64


# ---- prediction


def test_the_predicted_covariance_is_that_of_drawn_motions():
    """Poses, velocities and accelerations drawn at random, each carried on by itself."""
    start = random_covariance(scale=1e-4)
    velocity, dt_s, count = (0.5, 0.0, -1.0, 0.2, 0.1, 0.0), 0.02, 100_000
    config = MotionConfig(acceleration_rate_hz=20.0, acceleration_floor_m_s2=2.0)
    drawn = torch.randn((count, 12), generator=generator(1), dtype=torch.float64) @ torch.linalg.cholesky(start[0]).T
    rim_m_s = double(*velocity[3:]).norm() + 0.5 * DIAMETER_M * double(*velocity[:3]).norm()
    of_rim = 20.0 * rim_m_s + 2.0
    sigma = torch.cat([(2 * of_rim / DIAMETER_M).expand(3), of_rim.expand(3)])
    push = torch.randn((count, 6), generator=generator(2), dtype=torch.float64) * sigma
    later = torch.cat([drawn[:, :6] + dt_s * drawn[:, 6:] + 0.5 * dt_s**2 * push, drawn[:, 6:] + dt_s * push], 1)
    expected = later.T @ later / count
    actual = predict_covariance(start, double(*velocity)[None], double(dt_s), double(DIAMETER_M), config)[0]
    scale = expected.diagonal().sqrt()
    assert float(((actual - expected) / (scale[:, None] * scale)).abs().max()) < 0.02


def test_without_time_nothing_changes():
    start = random_covariance(batch=2, scale=1e-4)
    torch.testing.assert_close(predicted(start, (1.0,) * 6, dt_s=0.0), start)


def test_the_longer_the_less_certain():
    start = torch.diag_embed(torch.linspace(1e-6, 2e-6, 12, dtype=torch.float64))[None]
    short, long = predicted(start, dt_s=0.005), predicted(start, dt_s=0.02)
    for before, after in ((start, short), (short, long)):
        assert (after.diagonal(dim1=1, dim2=2) > before.diagonal(dim1=1, dim2=2)).all()
        assert (torch.linalg.eigvalsh(after) > 0).all()


def test_fast_objects_are_freer_than_slow_ones():
    start = random_covariance(scale=1e-8)
    still, moving, turning = (
        predicted(start, velocity).diagonal(dim1=1, dim2=2)[0, 6:].sqrt() for velocity in ((0.0,) * 6, (0, 0, 0, 0.5, 0, 0), (0, 5, 0, 0, 0, 0))
    )
    # At rest the floor alone, 2 m/s² over 10 ms; at 0.5 m/s of the centre or the rim another 10 m/s².
    assert still[3:].tolist() == pytest.approx([0.02] * 3, rel=1e-3)
    assert moving[3:].tolist() == pytest.approx([0.12] * 3, rel=1e-3)
    torch.testing.assert_close(turning, moving)
    assert still[:3].tolist() == pytest.approx([0.2] * 3, rel=1e-3)


def test_a_prediction_grows_less_certain_only_up_to_a_limit():
    covariance, limit = random_covariance(scale=1e-4), []
    for _ in range(200):
        covariance = predicted(covariance, (1.0, 0, 0, 0.5, 0, 0), dt_s=0.01)
        limit.append(covariance.diagonal(dim1=1, dim2=2)[0].sqrt())
    assert torch.isfinite(covariance).all()
    assert float(limit[-1][:3].max()) <= 0.5
    assert float(limit[-1][3:6].max()) <= 0.5 * DIAMETER_M
    assert torch.equal(limit[-1], limit[-2])


def test_objects_are_predicted_each_for_itself():
    start = random_covariance(batch=3, scale=1e-5)
    velocity, dt_s, diameter_m = torch.randn(3, 6, generator=generator(3)), torch.tensor([0.001, 0.01, 0.05]), torch.tensor([0.1, 0.2, 0.3])
    together = predict_covariance(start, velocity, dt_s, diameter_m, MotionConfig())
    assert together.dtype == torch.float64
    for row in range(3):
        part = slice(row, row + 1)
        alone = predict_covariance(start[part], velocity[part], dt_s[part], diameter_m[part], MotionConfig())
        torch.testing.assert_close(together[part], alone)


# ---- inverses


@pytest.mark.parametrize("size", [6, 12])
def test_the_inverse_is_the_inverse(size):
    matrices = random_covariance(size, batch=4)
    eye = torch.eye(size, dtype=torch.float64).expand(4, -1, -1)
    torch.testing.assert_close(inverse(matrices) @ matrices, eye, rtol=0, atol=1e-9)


def test_entries_of_any_magnitude_are_inverted():
    """A pose in radians and metres beside a velocity, and a direction that is known a million times better."""
    scale = torch.logspace(-8, 8, 12, dtype=torch.float64)
    matrices = random_covariance(batch=2)
    actual = inverse(scale[:, None] * matrices * scale)
    torch.testing.assert_close(actual, inverse(matrices) / (scale[:, None] * scale), rtol=1e-9, atol=0)


@pytest.mark.parametrize("broken", ["zero", "negative", "dependent", "nan"])
def test_what_cannot_be_inverted_is_infinite_and_harms_no_neighbour(broken):
    matrices = random_covariance(6, batch=3)
    expected = inverse(matrices)
    matrices[1] = {
        "zero": torch.zeros(6, 6, dtype=torch.float64),
        "negative": -matrices[1],
        "dependent": torch.ones(6, 6, dtype=torch.float64) - torch.diag(double(0, 0, 0, 0, 0, 0.5)),
        "nan": torch.full((6, 6), torch.nan, dtype=torch.float64),
    }[broken]
    actual = inverse(matrices)
    torch.testing.assert_close(actual[[0, 2]], expected[[0, 2]])
    assert torch.isinf(actual[1].diagonal()).all()
    assert (actual[1][~torch.eye(6, dtype=torch.bool)] == 0).all()


# ---- the left perturbation


def test_the_covariance_of_the_left_perturbation_is_that_of_drawn_poses():
    T, centre_obj = pose(), double(0.02, -0.03, 0.01)
    covariance = random_covariance(6, scale=1e-8)
    count = 100_000
    drawn = torch.randn((count, 6), generator=generator(1), dtype=torch.float64) @ torch.linalg.cholesky(covariance[0]).T
    poses = retract_about(T.expand(count, 4, 4), drawn, centre_obj.expand(count, 3))
    left = se3_log(poses @ se3_inverse(T))
    expected = left.T @ left / count
    actual = left_covariance(covariance, transform_points(T[None], centre_obj[None, None])[:, 0])[0]
    scale = expected.diagonal().sqrt()
    assert float(((actual - expected) / (scale[:, None] * scale)).abs().max()) < 0.02
    torch.testing.assert_close(actual, actual.T)


def test_what_is_unknown_stays_unknown_and_harms_no_neighbour():
    covariance = random_covariance(6, batch=3)
    centre = double(0.1, -0.2, 0.6).expand(3, 3)
    expected = left_covariance(covariance, centre)
    covariance[1] = torch.diag(torch.full((6,), torch.inf, dtype=torch.float64))
    actual = left_covariance(covariance, centre)
    assert torch.equal(actual[1], covariance[1])
    torch.testing.assert_close(actual[[0, 2]], expected[[0, 2]])


# ---- velocities that nothing confirms


def test_velocities_die_away_where_nothing_confirms_them(dtype):
    velocity = torch.ones(3, 6, dtype=dtype)
    failed, dt_s = torch.tensor([True, False, True]), torch.tensor([0.1, 0.1, 0.3], dtype=dtype)
    actual = fade(velocity, dt_s, failed)
    assert actual[:, 0].tolist() == pytest.approx([0.60653, 1.0, 0.22313], rel=1e-4)
    assert actual.dtype == dtype
    # Two windows are as good as one that is as long as both.
    twice = fade(fade(velocity, dt_s / 2, failed), dt_s / 2, failed)
    torch.testing.assert_close(twice, actual)


def test_a_velocity_that_is_set_aside_is_uncertain_by_as_much():
    covariance = random_covariance(batch=2, scale=1e-3)
    dropped = torch.tensor([[1.0, 0, 0, 0, 0.5, 0], [0.0] * 6])
    actual = with_dropped(covariance, dropped)
    assert torch.equal(actual[1], covariance[1])
    assert torch.equal(actual[0, :6], covariance[0, :6])
    added = (actual - covariance)[0, 6:, 6:]
    torch.testing.assert_close(added, torch.outer(dropped[0], dropped[0]).double())
    assert (torch.linalg.eigvalsh(actual) > 0).all()


# ---- turns that hardly show


def test_a_turn_dies_away_with_its_time_constant_and_a_move_goes_on(dtype):
    velocity = torch.arange(1.0, 13.0, dtype=dtype).view(2, 6)
    dt_s = torch.tensor([0.02, 0.1], dtype=dtype)
    expected = expected_velocity(velocity, dt_s)
    assert torch.equal(expected[:, 3:], velocity[:, 3:])
    torch.testing.assert_close(expected[:, :3], velocity[:, :3] * torch.exp(-dt_s / TURN_S)[:, None])


def test_what_dies_away_of_a_turn_is_little_of_what_may_change_in_a_window():
    dt_s, turn_rad_s = 0.005, 3.0
    velocity = double(turn_rad_s, 0, 0, 0, 0, 0)[None]
    lost = float((velocity - expected_velocity(velocity, double(dt_s))).norm())
    change = predicted(torch.zeros(1, 12, 12, dtype=torch.float64), velocity[0].tolist(), dt_s)[0, 6, 6].sqrt()
    assert 0 < lost < 0.25 * float(change)
