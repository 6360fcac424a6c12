"""Sums and maxima over neighbours, against PyTorch's pooling."""

import pytest
import torch
from torch.nn.functional import avg_pool2d, max_pool2d

from torchtrack.core.neighbours import largest_around, over_3x3


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_sums_over_neighbours(shape, dtype):
    image = torch.rand(*shape, 7, 9, dtype=dtype)
    expected = 9 * avg_pool2d(image.reshape(-1, 1, 7, 9), 3, 1, 1).reshape(image.shape)
    torch.testing.assert_close(over_3x3(image, torch.add), expected)


@pytest.mark.parametrize("reach", [0, 1, 2, 3])
@pytest.mark.parametrize("shape", [(), (3,)])
def test_the_largest_around_is_that_of_pooling_also_where_all_are_below_zero(shape, reach, dtype):
    image = torch.randn(*shape, 7, 9, dtype=dtype) - 5
    expected = max_pool2d(image.reshape(-1, 1, 7, 9), 2 * reach + 1, 1, reach).reshape(image.shape)
    assert torch.equal(largest_around(image, reach), expected)


def test_gradients_go_to_the_largest():
    image = torch.randn(4, 4, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda values: largest_around(values, 1), image)
