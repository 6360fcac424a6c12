"""Counts along rows, as a compiled graph takes them."""

import pytest
import torch

from torchtrack.core.padded import by_short_rows, running_count


@pytest.mark.parametrize("count", [1, 511, 512, 513, 2000])
def test_short_rows_count_as_a_long_one_does(count, device):
    mask = torch.rand(3, count, generator=torch.Generator().manual_seed(count)).to(device) < 0.3
    counted = by_short_rows(mask)
    assert torch.equal(counted, mask.cumsum(-1)) and torch.equal(counted, running_count(mask))
    assert counted.is_contiguous()
