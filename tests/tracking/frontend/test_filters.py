"""Guided filter and Harris response: the sums of the kernels are kornia's, at borders too, and do not depend on the batch."""

import pytest
import torch
from helpers import generator
from kornia.feature import harris_response
from kornia.filters import guided_blur

from torchtrack.tracking.frontend.filters import FILTER_EPS, FILTER_SIZE_PX
from torchtrack.tracking.frontend.filters import corner_response as reference

pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
from torchtrack.backends.numba import corner_response as kernels

SHAPES = [(1, 16, 16), (1, 32, 32), (3, 64, 96), (9, 40, 33)]
# Of the largest value.
AGREEMENT = {torch.float32: 1e-5, torch.float64: 1e-12}


def surfaces(*shape, seed=0, dtype=torch.float64):
    return torch.rand(shape, generator=generator(seed), dtype=torch.float64).square().to(dtype)


def decaying_square(dtype):
    """A surface as events leave it: mostly zero, with steps, and touching two borders."""
    image = torch.zeros(1, 48, 64, dtype=dtype)
    image[0, :20, :30] = torch.linspace(0, 1, 30, dtype=dtype)
    image[0, 30:40, 40:50] = 1
    return image


def by_kernel(surface):
    """The response by kernels."""
    responses = torch.empty_like(surface)
    kernels.corner_responses(surface.numpy(), responses.numpy())
    return responses


def each(kernel, images):
    """What a kernel makes of each image."""
    filtered = torch.empty_like(images)
    for image, result in zip(images, filtered, strict=True):
        kernel(image.numpy(), result.numpy())
    return filtered


WAYS = {"kernel": by_kernel, "kornia": reference}


def assert_agree(ours, theirs):
    assert ours.shape == theirs.shape
    assert ours.dtype == theirs.dtype
    largest = float(theirs.abs().max())
    assert largest > 1e-4
    torch.testing.assert_close(ours, theirs, rtol=0, atol=largest * AGREEMENT[ours.dtype])


# ---- the same as kornia's


@pytest.mark.parametrize("shape", SHAPES)
def test_the_guided_filter_is_that_of_kornia(shape, dtype):
    surface = surfaces(*shape, dtype=dtype)
    expected = guided_blur(surface[:, None], surface[:, None], FILTER_SIZE_PX, FILTER_EPS)[:, 0]
    assert_agree(each(kernels.guided_filter, surface), expected)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_harris_response_is_that_of_kornia(shape, dtype):
    image = surfaces(*shape, seed=1, dtype=dtype)
    assert_agree(each(kernels.harris, image), harris_response(image[:, None], 0.04)[:, 0])


@pytest.mark.parametrize("shape", SHAPES)
def test_both_give_the_same_response(shape, dtype):
    surface = surfaces(*shape, seed=2, dtype=dtype)
    ours, theirs = by_kernel(surface), reference(surface)
    assert_agree(ours, theirs)


def test_they_agree_on_steps_and_flat_ground(dtype):
    surface = decaying_square(dtype)
    ours, theirs = by_kernel(surface), reference(surface)
    assert_agree(ours, theirs)


def test_they_agree_at_every_border(dtype):
    """Where the sums reach beyond the image: the outermost rows and columns alone."""
    surface = surfaces(2, 40, 56, seed=3, dtype=dtype)
    ours, theirs = by_kernel(surface), reference(surface)
    for border in (ours[:, :4] - theirs[:, :4], ours[:, -4:] - theirs[:, -4:], ours[..., :4] - theirs[..., :4], ours[..., -4:] - theirs[..., -4:]):
        assert float(border.abs().max()) <= AGREEMENT[dtype] * float(theirs.abs().max())


def test_the_response_is_that_of_kornia_after_the_guided_filter():
    surface = surfaces(2, 48, 48, seed=1, dtype=torch.float32)
    filtered = guided_blur(surface[:, None], surface[:, None], FILTER_SIZE_PX, FILTER_EPS)
    torch.testing.assert_close(reference(surface), harris_response(filtered)[:, 0], rtol=0, atol=1e-7)


# ---- what they do


@pytest.mark.parametrize("filters", ["kernel", "kornia"])
def test_corners_respond_more_than_edges_and_edges_less_than_nothing(filters):
    surface = torch.zeros(1, 96, 96)
    surface[0, 30:61, 30:61] = 1
    response = WAYS[filters](surface)[0]
    assert float(response[30, 30]) > 1e-3
    assert float(response[45, 30]) < 0
    assert float(response[45, 45].abs()) < 1e-6


def test_the_guided_filter_keeps_strong_edges_and_smooths_weak_noise():
    step = torch.zeros(1, 32, 32, dtype=torch.float64)
    step[..., 16:] = 1
    noise = 0.02 * torch.randn(step.shape, generator=generator(4), dtype=torch.float64)
    filtered = each(kernels.guided_filter, step + noise)
    assert float((filtered[..., 16] - filtered[..., 15]).min()) > 0.9
    assert float(filtered[..., :12].std()) < 0.3 * float(noise[..., :12].std())


@pytest.mark.parametrize("value", [0.0, 0.7])
def test_a_flat_surface_stays_flat_and_has_no_response(value, dtype):
    flat = torch.full((2, 24, 24), value, dtype=dtype)
    torch.testing.assert_close(each(kernels.guided_filter, flat), flat, rtol=0, atol=1e-6)
    assert float(by_kernel(flat).abs().max()) < 1e-10


@pytest.mark.parametrize("filters", ["kernel", "kornia"])
def test_the_response_of_a_surface_does_not_depend_on_the_rest_of_the_batch(filters, dtype):
    surface = surfaces(5, 32, 48, seed=6, dtype=dtype)
    together = WAYS[filters](surface)
    alone = torch.cat([WAYS[filters](part) for part in surface.split(1)])
    torch.testing.assert_close(together, alone, rtol=0, atol=AGREEMENT[dtype] * float(alone.abs().max()))


@pytest.mark.parametrize("filters", ["kernel", "kornia"])
def test_the_filters_leave_their_input_as_it_was(filters):
    surface = surfaces(2, 48, 48, seed=1)
    copy = surface.clone()
    WAYS[filters](surface)
    assert torch.equal(surface, copy)
