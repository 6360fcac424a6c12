"""Image velocities of contour points and of pixels at the object's depth, against the projection of moved points."""

import pytest
import torch
from helpers import SMALL_CAMERA, generator, random_twist

from torchtrack.core.camera import MIN_DEPTH_M, project
from torchtrack.core.image_velocity import object_plane_velocity, pixel_velocity
from torchtrack.core.lie import retract_about, transform_points

CENTRES_M = ((0.05, -0.02, 0.5), (0.0, 0.1, 0.8), (-0.2, 0.0, 0.3))


def centres(dtype=torch.float64):
    return torch.tensor(CENTRES_M, dtype=dtype)


def intrinsics(batch=3, dtype=torch.float64):
    return SMALL_CAMERA.intrinsics(dtype).expand(batch, 4)


def moved(points_cam, velocity, centre_cam, seconds):
    """Points after turning about the centre and moving with it."""
    T = torch.eye(4, dtype=points_cam.dtype).repeat(len(points_cam), 1, 1)
    return transform_points(retract_about(T, velocity * seconds, centre_cam), points_cam)


def at_depth(pixels, depth_m):
    """The points that are seen at ``pixels``, all at one depth per object."""
    K = intrinsics(len(pixels), pixels.dtype)
    return torch.cat([(pixels - K[:, None, 2:]) / K[:, None, :2], torch.ones_like(pixels[..., :1])], -1) * depth_m[:, None, None]


def random_pixels(batch, count, seed=0, dtype=torch.float64):
    return torch.rand((batch, count, 2), generator=generator(seed), dtype=torch.float64).to(dtype) * 150


@pytest.mark.parametrize("seed", range(3))
def test_pixel_velocity_is_the_derivative_of_the_projection(seed):
    velocity, centre = random_twist(3, seed=seed, translation_m=0.3), centres()
    points = centre[:, None] + 0.05 * torch.randn((3, 20, 3), generator=generator(seed), dtype=torch.float64)
    step = 1e-6
    expected = project(moved(points, velocity, centre, step), intrinsics()) - project(moved(points, velocity, centre, -step), intrinsics())
    torch.testing.assert_close(pixel_velocity(points, velocity, centre, intrinsics()), expected / (2 * step), rtol=1e-6, atol=1e-5)


def test_velocity_of_the_objects_plane_is_that_of_points_at_its_depth(dtype):
    velocity, centre = random_twist(3, translation_m=0.3, dtype=dtype), centres(dtype)
    pixels = random_pixels(3, 40, dtype=dtype)
    expected = pixel_velocity(at_depth(pixels, centre[:, 2]), velocity, centre, intrinsics(dtype=dtype))
    accuracy = {"rtol": 1e-4, "atol": 1e-2} if dtype == torch.float32 else {"rtol": 1e-11, "atol": 1e-9}
    torch.testing.assert_close(object_plane_velocity(pixels, velocity, centre, intrinsics(dtype=dtype)), expected, **accuracy)


def test_at_the_objects_centre_both_are_that_of_the_centre(dtype):
    """There the rotation is of no account: the centre moves as it is told to."""
    velocity, centre = random_twist(3, seed=1, translation_m=0.3, dtype=dtype), centres(dtype)
    K = intrinsics(dtype=dtype)
    still = torch.cat([torch.zeros_like(velocity[:, :3]), velocity[:, 3:]], -1)
    expected = pixel_velocity(centre[:, None], still, centre, K)
    assert float(expected.abs().min(-1).values.max()) > 10
    for turning in (velocity, still):
        torch.testing.assert_close(pixel_velocity(centre[:, None], turning, centre, K), expected, rtol=1e-6, atol=1e-4)
        torch.testing.assert_close(object_plane_velocity(project(centre[:, None], K), turning, centre, K), expected, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize(
    ("velocity", "expected"),
    [
        ((0, 0, 0, 0.2, 0, 0), [[100.0, 0.0], [100.0, 0.0]]),
        ((0, 0, 0, 0, -0.4, 0), [[0.0, -200.0], [0.0, -200.0]]),
        ((0, 0, 0, 0, 0, 0.5), [[0.0, 0.0], [-50.0, 0.0]]),
        ((0, 0, 2, 0, 0, 0), [[0.0, 0.0], [0.0, 100.0]]),
    ],
    ids=["right", "up", "away", "roll"],
)
def test_motions_that_are_known_by_heart(velocity, expected):
    """Of the centre, half a metre away on the axis, and of a pixel 50 px to its right, with a focal length of 250 px."""
    pixels = torch.tensor([[[99.5, 74.5], [149.5, 74.5]]], dtype=torch.float64)
    centre = torch.tensor([[0.0, 0.0, 0.5]], dtype=torch.float64)
    twist = torch.tensor([velocity], dtype=torch.float64)
    of_plane = object_plane_velocity(pixels, twist, centre, intrinsics(1))
    of_points = pixel_velocity(at_depth(pixels, centre[:, 2]), twist, centre, intrinsics(1))
    for moments in (of_plane, of_points):
        torch.testing.assert_close(moments[0], torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-9)


def test_velocities_are_linear_in_the_motion():
    first, second, centre = random_twist(3, seed=2), random_twist(3, seed=3), centres()
    pixels = random_pixels(3, 10)
    points = at_depth(pixels, centre[:, 2] + 0.05)
    for velocity_of, places in ((object_plane_velocity, pixels), (pixel_velocity, points)):
        parts = [velocity_of(places, twist, centre, intrinsics()) for twist in (first, second, 2 * first - 3 * second)]
        torch.testing.assert_close(parts[2], 2 * parts[0] - 3 * parts[1], rtol=1e-12, atol=1e-9)


def test_a_batch_is_its_elements(dtype):
    velocity, centre, pixels = random_twist(3, seed=4, dtype=dtype), centres(dtype), random_pixels(3, 10, dtype=dtype)
    points = at_depth(pixels, centre[:, 2])
    for velocity_of, places in ((object_plane_velocity, pixels), (pixel_velocity, points)):
        together = velocity_of(places, velocity, centre, intrinsics(dtype=dtype))
        assert together.shape == (3, 10, 2)
        for number in range(3):
            row = slice(number, number + 1)
            torch.testing.assert_close(together[row], velocity_of(places[row], velocity[row], centre[row], intrinsics(1, dtype)))


@pytest.mark.parametrize("depth_m", [0.0, -0.3, MIN_DEPTH_M / 2])
def test_behind_the_camera_velocities_are_finite(depth_m, dtype):
    centre = torch.tensor([[0.01, 0.02, depth_m]], dtype=dtype)
    velocity = random_twist(1, seed=5, dtype=dtype)
    assert torch.isfinite(pixel_velocity(centre[:, None], velocity, centre, intrinsics(1, dtype))).all()
    assert torch.isfinite(object_plane_velocity(random_pixels(1, 5, dtype=dtype), velocity, centre, intrinsics(1, dtype))).all()
