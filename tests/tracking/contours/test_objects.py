"""Objects as one batch: contours at any poses, and copies that share all and do not hide one another."""

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose

from torchtrack import Tracker
from torchtrack.config.tracker import ContourConfig
from torchtrack.object_model import contour_source
from torchtrack.tracking.contours.objects import copied_rows

CONTOURS = ContourConfig()
SPLAT = ContourConfig(source="splat", texture=False, creases=False)
PLATE_EXTENTS_M = (0.05, 0.12, 0.005)


def batch_of(*models, streams=None):
    streams = streams or [0] * len(models)
    return Tracker(models, [SMALL_CAMERA] * (max(streams) + 1), stream_index=streams).objects


def same_contours(ours, theirs, row_of_ours, row_of_theirs):
    """Whether the contours of two rows are the same, the padding aside."""
    first, second = (
        (each.points_obj[row][each.mask[row]], each.pixels[row][each.mask[row]]) for each, row in ((ours, row_of_ours), (theirs, row_of_theirs))
    )
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def box_and_plate():
    """A plate before half of a box, in one stream."""
    return torch.stack([pose(), pose((0.0, 0.0, 0.0), (-0.03, 0.0, 0.35))]).float()


# ---- contours


def test_objects_of_one_stream_hide_one_another_and_others_do_not():
    T, models = box_and_plate(), (box_model(), box_model(PLATE_EXTENTS_M))
    shared, apart = batch_of(*models), batch_of(*models, streams=[0, 1])
    assert (shared.shared, apart.shared) == (True, False)
    hidden, whole = shared.contours(T, CONTOURS).mask.sum(1), apart.contours(T, CONTOURS).mask.sum(1)
    assert int(hidden[0]) < 0.85 * int(whole[0])
    assert int(hidden[1]) == int(whole[1])
    everything = shared.contours(T, ContourConfig(remove_hidden=False)).mask.sum(1)
    assert everything.tolist() == whole.tolist()


def test_contours_of_a_splatted_cloud_are_on_offer_too():
    contours = batch_of(box_model()).contours(pose()[None].float(), SPLAT)
    assert int(contours.mask.sum()) > 50
    assert contours.pixels[contours.mask].isfinite().all()


# ---- some of the objects


def test_some_objects_are_seen_as_among_all():
    plate, box = box_model(PLATE_EXTENTS_M), box_model()
    all_of_them = batch_of(plate, box, plate, box, streams=[0, 1, 1, 0])
    T = torch.stack([pose(translation=(0.0, 0.0, 0.5 + 0.1 * number)) for number in range(4)]).float()
    chosen = torch.tensor([2, 1])
    some = all_of_them.rows(chosen)
    assert [model.members.tolist() for model in some.models] == [[0], [1]]
    assert (some.stream_index.tolist(), some.diameter_m.tolist()) == ([1, 1], all_of_them.diameter_m[chosen].tolist())
    ours, theirs = some.contours(T[chosen], CONTOURS), all_of_them.contours(T, CONTOURS)
    assert all(same_contours(ours, theirs, row, number) for row, number in enumerate((2, 1)))
    assert all_of_them.models[0].members.tolist() == [0, 2]


# ---- copies


@pytest.mark.parametrize("number", [0, 1, 2])
def test_copies_share_all_tensors_but_the_list_of_members(number):
    cube = box_model((0.1, 0.1, 0.1))
    objects = batch_of(box_model(), cube, box_model(), streams=[1, 0, 0])
    copies = objects.copies([number], 4)
    (model,) = copies.models
    (original,) = [each for each in objects.models if number in each.members.tolist()]
    for name, value in original.named_buffers():
        assert (getattr(model, name) is value) == (name != "members")
    assert model.members.tolist() == copies.stream_index.tolist() == [0, 1, 2, 3]
    assert (copies.image_shape, copies.shared) == ((4, 150, 200), False)
    for name in ("intrinsics", "centre_obj", "diameter_m"):
        ours, given = getattr(copies, name), getattr(objects, name)
        assert ours.shape == (4, *given.shape[1:])
        assert ours.data_ptr() == given[number].data_ptr()


def test_copying_leaves_the_originals_as_they_were():
    objects = batch_of(box_model(), box_model((0.1, 0.1, 0.1)), box_model())
    objects.copies([0], 7)
    assert [model.members.tolist() for model in objects.models] == [[0, 2], [1]]


@pytest.mark.parametrize(("config", "exact_faces"), [(CONTOURS, 512), (CONTOURS, 0), (SPLAT, 512)], ids=["faces", "buffer", "splat"])
def test_copies_hide_neither_one_another_nor_themselves(monkeypatch, config, exact_faces):
    """A copy before another one would hide it, were they in one stream."""
    monkeypatch.setattr(contour_source, "EXACT_FACES", exact_faces)
    objects = batch_of(box_model(), box_model(PLATE_EXTENTS_M))
    poses = torch.stack([pose(), pose(translation=(0.0, 0.0, 0.4)), pose(translation=(0.01, 0.0, 0.7))]).float()
    together = objects.copies([0], 3).contours(poses, config)
    alone = batch_of(box_model())
    for row in range(3):
        assert same_contours(together, alone.contours(poses[row : row + 1], config), row, 0)


def test_a_row_is_repeated_without_a_copy():
    values = torch.arange(12.0).view(3, 4)
    repeated = copied_rows(values, [1], 5)
    assert repeated.tolist() == [[4, 5, 6, 7]] * 5
    assert repeated.data_ptr() == values[1].data_ptr()
    assert copied_rows(values, range(3)).data_ptr() == values.data_ptr()


@pytest.mark.parametrize("numbers", [(2, 0), (0, 1, 2), (1, 2)])
def test_copies_of_several_objects_come_in_turn_and_each_is_its_own(numbers):
    objects = batch_of(box_model(), box_model(PLATE_EXTENTS_M), box_model(), streams=[0, 1, 0])
    poses = torch.stack([pose(translation=(0.0, 0.01 * row, 0.5)) for row in range(2 * len(numbers))]).float()
    copies = objects.copies(numbers, 2)
    assert copies.stream_index.tolist() == list(range(2 * len(numbers)))
    torch.testing.assert_close(copies.diameter_m, objects.diameter_m[list(numbers)].repeat_interleave(2))
    together = copies.contours(poses, CONTOURS)
    for row in range(2 * len(numbers)):
        alone = objects.copies([numbers[row // 2]]).contours(poses[row : row + 1], CONTOURS)
        assert torch.equal(together.points_obj[row][together.mask[row]], alone.points_obj[0][alone.mask[0]])
