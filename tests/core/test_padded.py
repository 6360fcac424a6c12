"""Counts along rows, as a compiled graph takes them; and rows of several objects in turn."""

import pytest
import torch

from torchtrack.core.padded import by_short_rows, put_rows, repeated, rows_in_all, running_count


@pytest.mark.parametrize("count", [1, 511, 512, 513, 2000])
def test_short_rows_count_as_a_long_one_does(count, device):
    mask = torch.rand(3, count, generator=torch.Generator().manual_seed(count)).to(device) < 0.3
    counted = by_short_rows(mask)
    assert torch.equal(counted, mask.cumsum(-1)) and torch.equal(counted, running_count(mask))
    assert counted.is_contiguous()


def test_rows_are_repeated_in_turn_and_a_single_one_without_a_copy(device):
    values = torch.arange(6, device=device).view(3, 2)
    assert torch.equal(repeated(values, 6), values.repeat_interleave(2, 0))
    assert repeated(values[1:2], 5).data_ptr() == values[1].data_ptr() and repeated(values, 3).data_ptr() == values.data_ptr()


def test_chosen_rows_are_numbered_among_those_of_all_objects(device):
    chosen = torch.tensor([[3, 0], [1, 1]], device=device)
    assert rows_in_all(chosen, 4).tolist() == [3, 0, 5, 5]


def test_rows_are_put_where_they_are_taken_and_what_was_given_stays(device):
    values, others = torch.zeros(4, 2, device=device), torch.tensor([[1.0, 2.0], [3.0, torch.nan]], device=device)
    for taken, expected in (([True, False], [[0, 0], [0, 0], [0, 0], [1, 2]]), ([False, False], [[0, 0]] * 4)):
        assert put_rows(values, torch.tensor([3, 1], device=device), others, torch.tensor(taken, device=device)).tolist() == expected
    assert not values.any()
