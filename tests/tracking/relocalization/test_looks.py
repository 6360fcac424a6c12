"""Who is looked for in a window: how many, who first, that nobody waits for ever, and that streams do not matter to one another."""

import torch

from torchtrack.tracking.relocalization.looks import Asks, among, in_turn
from torchtrack.tracking.relocalization.triggers import Trigger
from torchtrack.tracking.validation.health import TrackHealth


def asks(number, looks=0, lost_s=0.0, *, stream=0, is_starting=False, flags=Trigger.UNCERTAIN):
    return Asks(number, stream, int(flags), looks, lost_s, is_starting)


def numbers(*asking, most=1):
    return [chosen.number for chosen in in_turn(asking, most)]


def test_those_looked_for_least_often_come_first_and_of_these_the_longest_lost():
    assert numbers(asks(0, 2, 9.0), asks(1, 1, 0.1), asks(2, 1, 0.3)) == [2]
    assert numbers(asks(0, 2, 9.0), asks(1, 1, 0.1), asks(2, 1, 0.3), most=2) == [1, 2]
    assert numbers(most=3) == []


def test_nobody_waits_for_ever():
    looks, order = [0, 0, 0], []
    for _ in range(9):
        chosen = numbers(*(asks(number, looks[number], 10.0 - number) for number in range(3)))
        looks[chosen[0]] += 1
        order += chosen
    assert order == [0, 1, 2] * 3


def test_streams_do_not_matter_to_one_another():
    assert numbers(asks(0), asks(1), asks(2, stream=1), asks(3, stream=1)) == [0, 2]


def test_all_whose_motion_is_not_known_are_looked_for_beside_the_others():
    starting = [asks(number, is_starting=True) for number in range(3)]
    assert numbers(*starting, asks(3), asks(4)) == [0, 1, 2, 3]


def test_what_merely_waits_for_its_confirmation_takes_no_look_from_what_is_lost():
    """As many more are looked for, and no more than that: the rest waits."""
    waiting = [asks(number, flags=Trigger.UNCONFIRMED) for number in range(3)]
    assert numbers(*waiting, asks(3, 5), asks(4, 6)) == [0, 3]
    assert numbers(*waiting, asks(3, 5), asks(4, 6), most=2) == [0, 1, 3, 4]
    # What has another reason besides waits for its turn among those that have one.
    assert numbers(asks(0, 5), asks(1, 6, flags=Trigger.UNCONFIRMED | Trigger.NEW)) == [0]
    assert numbers(asks(0, 5), asks(1, 6, flags=Trigger.UNCONFIRMED | Trigger.LOST)) == [0, 1]


def test_numbers_as_a_mask():
    assert among([0, 2], torch.zeros(4, dtype=torch.bool)).tolist() == [True, False, True, False]


def test_looks_are_counted_until_an_object_is_seen_well():
    health = TrackHealth.unknown(torch.eye(4).expand(2, 4, 4), torch.float32)
    lost = TrackHealth(**{**vars(health), "time_since_validated_s": torch.tensor([0.0, 0.1])})
    looked = lost.with_looks(torch.tensor([True, True])).with_looks(torch.tensor([True, True]))
    assert looked.looks.tolist() == [0, 2]
    assert looked.with_looks(None).looks.tolist() == [0, 2]
