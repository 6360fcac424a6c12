"""Constants are made once, wherever they are asked for first."""

import torch

from torchtrack.core.constants import constant


def test_a_constant_that_was_made_within_a_transform_can_be_used_outside():
    def cost(x):
        return (x * constant((3.0, 41.0), x.dtype, x.device)).sum()

    gradient = torch.func.vmap(torch.func.grad(cost))(torch.ones(3, 2))
    assert gradient.tolist() == [[3.0, 41.0]] * 3
    assert cost(torch.ones(2)) == 44.0


def test_a_constant_that_was_made_where_nothing_is_recorded_can_be_differentiated_through():
    with torch.inference_mode():
        constant((2.0, 43.0), torch.float32, torch.device("cpu"))
    x = torch.ones(2, requires_grad=True)
    (x * constant((2.0, 43.0), torch.float32, x.device)).sum().backward()
    assert x.grad.tolist() == [2.0, 43.0]
