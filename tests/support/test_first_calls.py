"""Shapes and types are checked in the first calls of every test."""

import pytest
import torch
from first_calls import CHECKED_CALLS
from jaxtyping import TypeCheckError

from torchtrack.core.lie import so3_exp


# Twice: what one test used up is there again for the next.
@pytest.mark.parametrize("_", range(2))
def test_a_wrong_shape_is_told_in_the_first_calls(_):
    wrong = torch.zeros(2)
    with pytest.raises(TypeCheckError):
        so3_exp(wrong)
    for _ in range(CHECKED_CALLS):
        so3_exp(torch.zeros(3))
    with pytest.raises(RuntimeError):
        so3_exp(wrong)
