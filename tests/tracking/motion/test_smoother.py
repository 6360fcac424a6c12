"""The smoother: as the joint least squares of all windows has it, object by object, and never across a jump."""

from dataclasses import replace

import pytest
import torch
from helpers import far_from, generator, random_pose

from torchtrack.config.tracker import MotionConfig
from torchtrack.core.lie import difference_about, retract_about
from torchtrack.tracking.motion.model import acceleration_sigma, initial_covariance, predict_covariance
from torchtrack.tracking.motion.smoother import Filtered, smoothed

CONFIG, DIAMETER_M, NOISE_M, WINDOWS = MotionConfig(initial_speed_m_s=0.2), 0.2, 1e-3, 12
OBSERVED = torch.eye(12, dtype=torch.float64)[:6]


def noise():
    """Covariance of a measured pose (rad², m²)."""
    return torch.diag(torch.tensor([0.01] * 3 + [NOISE_M] * 3, dtype=torch.float64).square())


def carried(dt_s):
    """A constant velocity, as a matrix."""
    F = torch.eye(12, dtype=torch.float64)
    F[:6, 6:] = dt_s * torch.eye(6)
    return F


def filtered(measured, dt_s, T_start, config=CONFIG):
    """A plain Kalman filter of measured moves ``[n, b, 6]`` from a pose; its windows, and the mean and covariance of each."""
    batch, R, F = measured.shape[1], noise(), carried(dt_s)
    diameter = torch.full((batch,), DIAMETER_M, dtype=torch.float64)
    mean, covariance = torch.zeros(batch, 12, dtype=torch.float64), initial_covariance(diameter, config)
    means, covariances = [], []
    for z in measured:
        covariance = predict_covariance(covariance, mean[:, 6:], torch.full_like(diameter, dt_s), diameter, config)
        mean = mean @ F.T
        gain = covariance @ OBSERVED.T @ torch.linalg.inv(OBSERVED @ covariance @ OBSERVED.T + R)
        mean = mean + (gain @ (z - mean[:, :6])[..., None])[..., 0]
        covariance = covariance - gain @ OBSERVED @ covariance
        means.append(mean)
        covariances.append(covariance)
    means, covariances = torch.stack(means), torch.stack(covariances)
    t_us = torch.arange(1, len(measured) + 1) * round(1e6 * dt_s)
    return Filtered(t_us, retract_about(T_start, means[..., :6], torch.zeros(len(means), batch, 3, dtype=torch.float64)), means[..., 6:], covariances)


def moves(batch=2, seed=0):
    """Measured moves in a straight line, with noise; turns are zero, so that all is linear."""
    z = NOISE_M * torch.randn((WINDOWS, batch, 6), generator=generator(seed), dtype=torch.float64)
    z[..., 3:] += torch.arange(1, WINDOWS + 1)[:, None, None] * 2e-3
    z[..., :3] = 0
    return z


def origins(batch):
    return torch.zeros(batch, 3, dtype=torch.float64), torch.full((batch,), DIAMETER_M, dtype=torch.float64)


def poses(batch=2):
    return torch.eye(4, dtype=torch.float64).expand(WINDOWS, batch, 4, 4)


def of_all_at_once(measured, windows, dt_s):
    """Mean and covariance of every window given all measurements of one object, by conditioning their joint distribution."""
    F = carried(dt_s)
    start = initial_covariance(torch.tensor([DIAMETER_M], dtype=torch.float64), CONFIG)[0]
    mean, joint = torch.zeros(0, dtype=torch.float64), torch.zeros(0, 0, dtype=torch.float64)
    velocity, across = torch.zeros(1, 6, dtype=torch.float64), torch.zeros(12, 0, dtype=torch.float64)
    for number in range(len(measured)):
        # The filter's own accelerations, which go by the velocity that it had found.
        sigma = acceleration_sigma(velocity, torch.tensor([[DIAMETER_M]], dtype=torch.float64), CONFIG)[0]
        push = torch.cat([torch.diag(0.5 * dt_s**2 * sigma), torch.diag(dt_s * sigma)])
        across = F @ across
        start = F @ start @ F.T + push @ push.T
        joint = torch.cat([torch.cat([joint, across.T], 1), torch.cat([across, start], 1)])
        across, velocity = joint[-12:], windows.velocity[number]
        mean = torch.cat([mean, torch.zeros(12, dtype=torch.float64)])
    H = torch.block_diag(*[OBSERVED] * len(measured))
    R = torch.block_diag(*[noise()] * len(measured))
    gain = joint @ H.T @ torch.linalg.inv(H @ joint @ H.T + R)
    after = joint - gain @ H @ joint
    blocks = [after[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] for k in range(len(measured))]
    return (gain @ measured.flatten()).view(-1, 12), torch.stack(blocks)


def test_smoothing_is_least_squares_of_all_windows_at_once(way):
    measured = moves(batch=1)
    windows = filtered(measured, 5e-3, poses(1))
    after = smoothed(windows, *origins(1), CONFIG)
    mean, covariance = of_all_at_once(measured[:, 0], windows, 5e-3)
    torch.testing.assert_close(difference_about(poses(1), after.T_cam_obj, torch.zeros(WINDOWS, 1, 3, dtype=torch.float64))[:, 0], mean[:, :6])
    torch.testing.assert_close(after.velocity[:, 0], mean[:, 6:])
    torch.testing.assert_close(after.covariance[:, 0], covariance, rtol=1e-5, atol=2e-8)


def test_what_is_known_of_the_last_window_stays_and_of_others_grows():
    windows = filtered(moves(), 5e-3, poses())
    after = smoothed(windows, *origins(2), CONFIG)
    assert torch.equal(after.T_cam_obj[-1], windows.T_cam_obj[-1])
    assert torch.equal(after.covariance[-1], windows.covariance[-1])
    less = (windows.covariance - after.covariance)[:-1].diagonal(dim1=-2, dim2=-1)
    assert (less > 0).all()
    assert (torch.linalg.eigvalsh(after.covariance) > -1e-12).all()


def test_errors_of_turning_objects_are_smoothed_as_those_of_objects_at_rest():
    """The same errors, of a pose at rest, and of one that turns fast about a centre that is not the origin."""
    steady, dt_s = MotionConfig(acceleration_rate_hz=0.0), 5e-3
    errors = moves(batch=1) + 1e-3 * torch.randn((WINDOWS, 1, 6), generator=generator(4), dtype=torch.float64)
    at_rest = filtered(errors, dt_s, poses(1), steady)
    rate = torch.tensor([1.5, -2.0, 1.0, 0.1, -0.2, 0.3], dtype=torch.float64)
    centre = torch.tensor([[0.02, -0.05, 0.1]], dtype=torch.float64)
    centres, rests = centre.expand(WINDOWS, 1, 3), torch.zeros(WINDOWS, 1, 3, dtype=torch.float64)
    times = 1e-6 * at_rest.t_us.double()[:, None, None]
    true = retract_about(random_pose(1, seed=3).expand(WINDOWS, 1, 4, 4), rate * times, centres)
    actual = retract_about(true, difference_about(poses(1), at_rest.T_cam_obj, rests), centres)
    turning = replace(at_rest, T_cam_obj=actual, velocity=at_rest.velocity + rate)
    diameter = origins(1)[1]
    after, expected = smoothed(turning, centre, diameter, steady), smoothed(at_rest, *origins(1), steady)
    left = difference_about(true, after.T_cam_obj, centres)
    # Their axes turn with them, by a tenth of a radian in all.
    torch.testing.assert_close(left, difference_about(poses(1), expected.T_cam_obj, rests), rtol=0, atol=1e-4)
    torch.testing.assert_close(after.covariance, expected.covariance)


def test_each_object_is_smoothed_as_if_it_were_alone(way):
    windows = filtered(moves(batch=3), 5e-3, poses(3))
    together = smoothed(windows, *origins(3), CONFIG)
    for number in range(3):
        single = slice(number, number + 1)
        own = Filtered(windows.t_us, windows.T_cam_obj[:, single], windows.velocity[:, single], windows.covariance[:, single])
        alone = smoothed(own, *origins(1), CONFIG)
        assert far_from(alone.T_cam_obj, together.T_cam_obj[:, single]) < 1e-12
        assert far_from(alone.covariance, together.covariance[:, single]) < 1e-12


@pytest.mark.parametrize("what", ["jump", "not a number", "not positive"])
def test_an_object_that_fails_is_left_as_it_was_and_its_neighbour_as_ever(what, way):
    windows = filtered(moves(), 5e-3, poses())
    T_cam_obj, covariance = windows.T_cam_obj.clone(), windows.covariance.clone()
    if what == "jump":
        # Found anew a tenth of a metre away, where the filter was sure to a millimetre.
        T_cam_obj[6:, 1, 0, 3] += 0.1
    elif what == "not a number":
        covariance[5, 1] = torch.nan
    else:
        covariance[5, 1] = -covariance[5, 1]
    bad = replace(windows, T_cam_obj=T_cam_obj, covariance=covariance)
    after, usual = smoothed(bad, *origins(2), CONFIG), smoothed(windows, *origins(2), CONFIG)
    assert torch.equal(after.T_cam_obj[:, 0], usual.T_cam_obj[:, 0])
    assert torch.equal(after.T_cam_obj[5, 1], T_cam_obj[5, 1])
    assert far_from(after.T_cam_obj[:, 1], T_cam_obj[:, 1]) < 5e-3
    # After the jump there is no trace of it.
    assert far_from(after.T_cam_obj[7:, 1] - T_cam_obj[7:, 1], usual.T_cam_obj[7:, 1] - windows.T_cam_obj[7:, 1]) < 1e-12


def test_one_window_stays_as_it_is():
    windows = filtered(moves()[:1], 5e-3, poses()[:1])
    assert smoothed(windows, *origins(2), CONFIG) is windows


def test_windows_of_unequal_length_are_weighed_by_their_time():
    """Of a constant velocity that is known, the way between two windows is that of the time between them."""
    windows = filtered(moves(), 5e-3, poses())
    later = replace(windows, t_us=windows.t_us + torch.tensor([0] * 6 + [100_000] * 6))
    after, usual = smoothed(later, *origins(2), CONFIG), smoothed(windows, *origins(2), CONFIG)
    assert far_from(after.T_cam_obj[6:], usual.T_cam_obj[6:]) < 1e-12
    # A tenth of a second later, the sixth window's place tells hardly anything of the fifth.
    assert far_from(after.T_cam_obj[5], windows.T_cam_obj[5]) < 0.5 * far_from(usual.T_cam_obj[5], windows.T_cam_obj[5])
