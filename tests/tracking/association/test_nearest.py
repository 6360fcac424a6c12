"""Association of observations with contours: the index, motion compensation, gates, concentration, the dark side, the paper's search."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import IMAGE_SIZE, SMALL_CAMERA, box_model, contours_at, generator, moving_objects, pose, random_pose, seen, upright_line
from nearest_cases import matching, nearest

from torchtrack.config.tracker import ContourConfig
from torchtrack.core.image_velocity import MovingObjects, object_plane_velocity
from torchtrack.core.lie import retract_about
from torchtrack.object_model.contour_source import ContourKind, group_by_model
from torchtrack.tracking.association.along_flow import match_along_flow
from torchtrack.tracking.association.matches import both_coordinates
from torchtrack.tracking.association.nearest import Gate, contour_table, match_nearest
from torchtrack.tracking.association.observations import Observations
from torchtrack.tracking.association.weights import DARK_SHIFT_PX, LEAST_TRUST, concentration, on_and_around, patch, patch_sums
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.contours.points import Contours, reproject
from torchtrack.tracking.contours.sampling import mesh_contours


def brute_force(contours, places, number):
    """Distance of every visible contour point to each place, infinite for masked ones."""
    distance = (contours.pixels[number][None] - places[:, None]).norm(dim=-1)
    return torch.where(contours.mask[number], distance, torch.inf)


def random_contours(batch, count, seed=0, dtype=torch.float64):
    rng = generator(seed)
    pixels = torch.rand((batch, count, 2), generator=rng, dtype=torch.float64) * torch.tensor([220.0, 170.0]) - 10
    return contours_at(pixels.to(dtype), mask=torch.rand((batch, count), generator=rng) < 0.8, dtype=dtype)


# ---- the index


@pytest.mark.parametrize("cell_px", [1, 2, 3])
@pytest.mark.parametrize("radius_px", [4, 7])
@pytest.mark.parametrize("subcell_lookup", [False, True])
def test_the_index_finds_the_nearest_contour_within_the_radius(cell_px, radius_px, subcell_lookup, dtype):
    contours = random_contours(3, 300, dtype=dtype)
    index = index_contours(contours, IMAGE_SIZE, radius_px, cell_px)
    places = torch.rand((3, 2000, 2), generator=generator(1), dtype=torch.float64).to(dtype) * torch.tensor([200, 150], dtype=dtype)
    actual = index.look_up(places, torch.full((3,), subcell_lookup))
    # What is found is nearest to the place, or to the centre of its cell; to a sixteenth of a squared pixel.
    centres = places if subcell_lookup else ((places + 2**-8) / cell_px).round() * cell_px
    rounding, reach = 2**-0.5 * cell_px, (2**0.5 if subcell_lookup else 2**-0.5) * cell_px
    for number in range(3):
        distance = brute_force(contours, centres[number], number)
        best = distance.amin(1)
        there = actual[number] >= 0
        assert there[best < radius_px - rounding].all()
        assert not there[best > radius_px + reach].any()
        ours = distance.gather(1, actual[number].clamp(min=0)[:, None])[:, 0]
        sure = there & (best < radius_px - rounding)
        assert int(sure.sum()) > 100
        exact = (ours.square() - best.square())[sure] <= 1 / 16 + 1e-3
        # What is nearest to none of four centres can be nearest to a place between them, but hardly ever is.
        assert float(exact.double().mean()) > 0.99 if subcell_lookup else exact.all()


def test_only_some_objects_are_looked_up_finely(dtype):
    index = index_contours(random_contours(3, 300, dtype=dtype), IMAGE_SIZE, 7, 2)
    places = torch.rand((3, 2000, 2), generator=generator(1), dtype=torch.float64).to(dtype) * torch.tensor([200, 150], dtype=dtype)
    mixed = index.look_up(places, torch.tensor([True, False, True]))
    roughly, subcell_lookup = index.look_up(places), index.look_up(places, torch.ones(3, dtype=torch.bool))
    assert torch.equal(mixed, torch.stack([subcell_lookup[0], roughly[1], subcell_lookup[2]]))
    assert not torch.equal(subcell_lookup[1], roughly[1])


@pytest.mark.parametrize("subcell_lookup", [False, True])
def test_roundings_do_not_choose_what_is_found_at_whole_pixels(subcell_lookup, dtype):
    """Where events lie, which is on the borders of cells or in the middle of four."""
    index = index_contours(random_contours(1, 300, dtype=dtype), IMAGE_SIZE, 7, 2)
    rows, columns = torch.meshgrid(torch.arange(150), torch.arange(200), indexing="ij")
    places = torch.stack([columns, rows], -1).reshape(1, -1, 2).to(dtype)
    rounding = 200 * torch.finfo(dtype).eps * (1 - 2 * torch.rand(places.shape, generator=generator(2), dtype=torch.float64)).to(dtype)
    fine = torch.tensor([subcell_lookup])
    assert torch.equal(index.look_up(places + rounding, fine), index.look_up(places, fine))


def test_few_places_are_looked_up_as_finely_as_many(dtype):
    index, subcell_lookup = index_contours(random_contours(3, 300, dtype=dtype), IMAGE_SIZE, 7, 2), torch.ones(3, dtype=torch.bool)
    places = torch.rand((3, 5000, 2), generator=generator(1), dtype=torch.float64).to(dtype) * torch.tensor([200, 150], dtype=dtype)
    few = torch.cat([index.look_up(some, subcell_lookup) for some in places.split(500, 1)], 1)
    # Of many, a table is made of what every cell knows.
    assert 4 * 500 < index.size[0] * index.size[1] < 4 * 5000
    assert torch.equal(index.look_up(places, subcell_lookup), few)


def test_of_edges_that_share_a_cell_the_nearer_one_is_found():
    # Two upright lines, closer than a cell; every place between them belongs to the nearer one.
    rows = torch.arange(40.0, 80.0, 0.5, dtype=torch.float64)
    lines = torch.cat([torch.stack([torch.full_like(rows, column), rows], -1) for column in (70.4, 72.0)])
    index = index_contours(contours_at(lines[None]), IMAGE_SIZE, 5, 2)
    places = torch.cartesian_prod(torch.tensor([70.0, 71.0, 72.0, 73.0], dtype=torch.float64), torch.arange(45.0, 75.0, dtype=torch.float64))
    is_second = (index.look_up(places[None], torch.tensor([True]))[0] >= len(rows)).unflatten(0, (4, -1))
    assert is_second.tolist() == [[second] * 30 for second in (False, False, True, True)]


def test_contours_that_are_masked_are_not_found():
    contours = contours_at([[[50.0, 50.0], [52.0, 50.0]]], mask=[[False, True]])
    assert index_contours(contours, IMAGE_SIZE, 5, 1).look_up(torch.tensor([[[50.0, 50.0]]], dtype=torch.float64)).tolist() == [[1]]


def test_nothing_is_found_far_away_or_outside_the_region():
    index = index_contours(upright_line(80.0), IMAGE_SIZE, 5, 1)
    places = [[80.0, 60.0], [88.0, 60.0], [80.0, -400.0], [1e9, 60.0], [-1e9, -1e9], [torch.inf, 0.0], [torch.nan, 60.0]]
    actual = index.look_up(torch.tensor([places], dtype=torch.float64))[0].tolist()
    assert actual == [40, -1, -1, -1, -1, -1, -1]


def test_contours_far_outside_the_image_cost_nothing():
    far = contours_at([[[50.0, 50.0], [1e6, 50.0], [50.0, -3e5], [torch.nan, 1.0]]])
    index = index_contours(far, IMAGE_SIZE, 5, 1)
    assert max(index.size) < 20
    assert index.look_up(torch.tensor([[[51.0, 50.0]]], dtype=torch.float64)).tolist() == [[0]]


def test_objects_without_contours_have_an_empty_index():
    contours = contours_at([[[50.0, 50.0]], [[60.0, 60.0]]], mask=[[False], [True]])
    index = index_contours(contours, IMAGE_SIZE, 5, 1)
    assert index.look_up(torch.tensor([[[50.0, 50.0]], [[60.0, 61.0]]], dtype=torch.float64)).tolist() == [[-1], [0]]
    nothing = index_contours(contours_at([[[50.0, 50.0]]], mask=[[False]]), IMAGE_SIZE, 5, 1)
    assert nothing.look_up(torch.tensor([[[50.0, 50.0]]], dtype=torch.float64)).tolist() == [[-1]]


def test_the_index_of_an_object_does_not_depend_on_the_others(dtype):
    contours = random_contours(3, 60, seed=2, dtype=dtype)
    places = torch.rand((3, 500, 2), generator=generator(3), dtype=torch.float64).to(dtype) * torch.tensor([200, 150], dtype=dtype)
    together = index_contours(contours, IMAGE_SIZE, 6, 2).look_up(places)
    for number in range(3):
        own = Contours(*(getattr(contours, name)[number : number + 1] for name in vars(contours)))
        assert torch.equal(index_contours(own, IMAGE_SIZE, 6, 2).look_up(places[number : number + 1])[0], together[number])


# ---- the nearest contour


def test_observations_are_matched_with_the_nearest_contour_along_its_normal(dtype):
    contours = upright_line(80.0, dtype=dtype)
    matches, _ = nearest(seen([[[81.0, 60.2], [78.5, 99.8]]], dtype=dtype), contours)
    assert matches.mask.all()
    assert matches.contour.tolist() == [[40, 80]]
    assert matches.directions.tolist() == [[[1, 0], [1, 0]]]
    assert matches.targets.dtype == dtype


@pytest.mark.parametrize("gate_px", [1.0, 2.5])
def test_the_gate_is_strict(gate_px):
    contours = contours_at([[[80.0, 60.0]]])
    places = [[[80.0 + gate_px - 0.01, 60.0], [80.0 + gate_px, 60.0], [80.0, 60.0 - gate_px + 0.01], [80.0, 60.0 + gate_px + 0.01]]]
    matches, _ = nearest(seen(places), contours, gate_px=gate_px)
    assert matches.mask.tolist() == [[True, False, True, False]]


def test_masked_observations_and_those_far_away_have_no_match():
    matches, _ = nearest(seen([[[80.0, 60.0], [80.0, 61.0], [140.0, 60.0]]], mask=[[False, True, True]]), upright_line(80.0))
    assert matches.mask.tolist() == [[False, True, False]]
    assert matches.contour[0, 2] == 0


def test_observations_are_moved_to_the_end_of_the_window():
    """An edge at 80 px that moves at 500 px/s fired at 76 px 8 ms ago."""
    matches, _ = nearest(seen([[[76.0, 60.0]]], age_s=8e-3), upright_line(80.0), velocity=(500.0, 0.0), gate_px=0.5)
    assert matches.mask.all()
    assert matches.targets[0, 0].tolist() == pytest.approx([80.0, 60.0])
    without, _ = nearest(seen([[[76.0, 60.0]]], age_s=8e-3), upright_line(80.0), gate_px=5.0)
    assert without.targets[0, 0].tolist() == pytest.approx([76.0, 60.0])


def test_the_velocity_is_the_contours_own_not_what_was_believed():
    """Believed 400 px/s, the contour that is found moves at 500: the target is carried with 500."""
    observation = seen([[[76.0, 60.0]]], age_s=8e-3)
    matches, place = nearest(observation, upright_line(80.0), velocity=(500.0, 0.0), believed=(400.0, 0.0))
    assert matches.targets[0, 0].tolist() == pytest.approx([80.0, 60.0])
    # It is now looked for where the matched contour's velocity puts it.
    assert place[0, 0].tolist() == pytest.approx([80.0, 60.0])


def test_an_index_of_an_earlier_pose_still_finds_the_contours():
    """The contours moved by 4 px since they were indexed: after a first match, observations are moved back."""
    before = upright_line(80.0)
    index = index_contours(before, IMAGE_SIZE, 5, 1)
    after = upright_line(84.0)
    observation = seen([[[84.5, 60.0]]])
    first, place = nearest(observation, after, index=index)
    assert first.mask.all()
    assert place[0, 0].tolist() == pytest.approx([80.5, 60.0])
    table = contour_table(upright_line(87.0), index)
    second = match_nearest(seen([[[86.5, 60.0]]]), table, place, moving_objects((0.0, 0.0)), Gate(3.0), matching())[0]
    assert second.mask.all()
    assert second.contour.tolist() == [[40]]


def test_unmatched_observations_keep_what_was_believed():
    _, place = nearest(seen([[[140.0, 60.0]]], age_s=8e-3), upright_line(80.0), velocity=(500.0, 0.0), believed=(-10.0, 3.0))
    assert place[0, 0].tolist() == pytest.approx([140.0 - 0.08, 60.0 + 0.024])


@pytest.mark.parametrize(("polarity", "speed", "shift"), [(1.0, 490.0, -0.147), (-1.0, 490.0, 0.147), (1.0, -490.0, 0.147), (0.0, 490.0, 0.0)])
def test_events_are_moved_back_from_the_dark_side(polarity, speed, shift):
    """Brighter where the bright side moves over the pixel: the dark side, on which the event lies, is ahead."""
    matches, _ = nearest(seen([[[80.0, 60.0]]], polarity=polarity), upright_line(80.0), velocity=(speed, 0.0), shifted=True)
    assert matches.targets[0, 0].tolist() == pytest.approx([80.0 + shift, 60.0])


@pytest.mark.parametrize(("kind", "shift"), [(ContourKind.SMOOTH, -0.0588), (ContourKind.CREASE, -0.147), (ContourKind.TEXTURE, -0.147)])
def test_a_smooth_silhouette_has_a_shift_of_its_own(kind, shift, dtype):
    contours = upright_line(80.0, kind=kind, dtype=dtype)
    seen_there = seen([[[80.0, 60.0]]], polarity=1.0, dtype=dtype)
    matches, _ = nearest(seen_there, contours, velocity=(490.0, 0.0), shifted=True)
    assert matches.targets[0, 0].tolist() == pytest.approx([80.0 + shift, 60.0])


def test_the_dark_side_does_not_depend_on_the_sign_of_the_normal(dtype):
    normals = torch.nn.functional.normalize(torch.randn((2, 50, 2), generator=generator(), dtype=dtype), dim=-1)
    velocity = torch.tensor([[400.0, -200.0], [-30.0, 500.0]], dtype=dtype)
    polarity = torch.randn((2, 50), generator=generator(2), dtype=dtype).sign()
    pixels = 40 + 60 * torch.rand((2, 50, 2), generator=generator(3), dtype=dtype)
    shifts = []
    for sign in (1, -1):
        contours = contours_at(pixels, sign * normals, dtype=dtype)
        moved, still = (
            nearest(seen(pixels, polarity=polarity, dtype=dtype), contours, velocity=velocity, believed=(0.0, 0.0), gate_px=5.0, shifted=shifted)[0]
            for shifted in (True, False)
        )
        shifts.append(moved.targets - still.targets)
        assert torch.equal(moved.contour, still.contour)
    torch.testing.assert_close(*shifts)
    assert (shifts[0].norm(dim=-1) <= DARK_SHIFT_PX).all()
    # The dark side, from which events are moved back, is ahead where it got brighter.
    ahead = -(shifts[0] * velocity[:, None]).sum(-1) * polarity
    assert (ahead >= -1e-3).all()
    assert float(shifts[0].norm(dim=-1).median()) > 0.9 * DARK_SHIFT_PX


def test_matches_of_an_object_do_not_depend_on_the_others(dtype):
    contours = random_contours(3, 200, seed=5, dtype=dtype)
    observations = seen(torch.rand((3, 300, 2), generator=generator(6), dtype=torch.float64) * torch.tensor([200, 150]), age_s=4e-3, dtype=dtype)
    together, _ = nearest(observations, contours, velocity=(200.0, -100.0), cell_px=2)
    for number in range(3):
        own = Contours(*(getattr(contours, name)[number : number + 1] for name in vars(contours)))
        single = Observations(*(getattr(observations, name)[number : number + 1] for name in vars(observations) if name != "trust"))
        alone, _ = nearest(single, own, velocity=(200.0, -100.0), cell_px=2)
        for name in vars(alone):
            torch.testing.assert_close(getattr(alone, name)[0], getattr(together, name)[number])


def test_events_of_a_moving_box_are_all_matched_within_a_pixel():
    """True contours 5 ms ago, seen from the pose now: compensation leaves only the rounding to pixels."""
    T_now = random_pose(1, seed=8)
    velocity = torch.tensor([[1.0, -2.0, 3.0, 0.2, 0.1, 0.3]], dtype=torch.float64)
    centre_obj = torch.zeros(1, 3, dtype=torch.float64)
    T_before = retract_about(T_now, -5e-3 * velocity, centre_obj)
    intrinsics = SMALL_CAMERA.intrinsics(torch.float64)[None]
    config = ContourConfig()
    contours = mesh_contours([group.double() for group in group_by_model([box_model()], config)], T_now, intrinsics, config)
    earlier = reproject(contours, T_before, intrinsics)
    observations = seen(earlier.pixels.round(), age_s=5e-3)
    objects = MovingObjects(T_now, velocity, T_now[:, :3, 3], intrinsics)
    table = contour_table(contours, index_contours(contours, IMAGE_SIZE, 8, 1))
    place = observations.pixels + 5e-3 * object_plane_velocity(observations.pixels, velocity, T_now[:, :3, 3], intrinsics)
    inside = ((earlier.pixels > 0) & (earlier.pixels < torch.tensor([199, 149]))).all(-1)
    assert int(inside.sum()) > 200
    matches, _ = match_nearest(observations, table, place, objects, Gate(1.5), matching())
    assert float(matches.mask[inside].double().mean()) > 0.97
    still = replace(objects, velocity=torch.zeros_like(velocity))
    uncompensated, _ = match_nearest(observations, table, observations.pixels, still, Gate(1.5), matching())
    residual = [
        ((contours.pixels[0][m.contour[0]] - m.targets[0]) * m.directions[0]).sum(-1)[m.mask[0]].abs().mean() for m in (matches, uncompensated)
    ]
    assert float(residual[0]) < 0.35
    assert float(residual[0]) < 0.7 * float(residual[1])


# ---- concentration


def trust(offsets, targets, near):
    """The concentration around observations with given offsets from their contours."""
    cell, counted = patch(targets), on_and_around(offsets, near)
    on, around = patch_sums(cell, counted).gather(2, cell[:, None].expand(-1, 2, -1)).unbind(1)
    return concentration(on, around)


def line_with_offsets(*groups):
    """Observations beside the line at 80 px: for each group of rows (first, last), offsets spread over ±``spread`` px."""
    places = []
    for first, last, spread in groups:
        v = torch.arange(first, last, 0.25, dtype=torch.float64)
        places.append(torch.stack([80 + spread * (2 * torch.rand(len(v), generator=generator(first), dtype=torch.float64) - 1), v], -1))
    return torch.cat(places)[None]


def test_observations_gathered_on_a_contour_are_trusted_and_smeared_ones_are_not():
    places = line_with_offsets((32, 64, 0.6), (80, 112, 2.9))
    matches, _ = nearest(seen(places), upright_line(80.0), gate_px=4.0, concentration=True)
    inlier_ratio = places[0, :, 1] < 64
    assert float(matches.weights[0][inlier_ratio].min()) == 1
    assert float(matches.weights[0][~inlier_ratio].mean()) < 0.1
    assert ((matches.weights >= 0) & (matches.weights <= 1)).all()


def test_a_smeared_patch_is_trusted_least_and_a_gathered_one_fully(dtype):
    """Patches of 16 px: one gathered, one smeared, one of each half, exactly."""
    patches = torch.tensor([20.0, 40.0, 60.0], dtype=dtype).repeat_interleave(100)
    targets = torch.stack([patches, patches], -1)[None]
    on = torch.cat([torch.ones(100), torch.zeros(100), torch.arange(100) % 2]).to(dtype)
    offsets = torch.where(on > 0, 0.3, -2.0).to(dtype)[None]
    weights = trust(offsets, targets, torch.ones(1, 300, dtype=torch.bool))[0].view(3, 100)
    assert weights.dtype == dtype
    torch.testing.assert_close(weights, torch.tensor([1.0, LEAST_TRUST, 0.6], dtype=dtype)[:, None].expand(3, 100), rtol=0, atol=1e-6)


def test_trust_rises_with_the_share_on_the_contour():
    shares = []
    for on in range(0, 101, 10):
        offsets = torch.where(torch.arange(100) < on, 0.0, 2.0).double()[None]
        near, targets = torch.ones(1, 100, dtype=torch.bool), torch.full((1, 100, 2), 50.0, dtype=torch.float64)
        shares.append(float(trust(offsets, targets, near)[0, 0]))
    assert shares == sorted(shares)
    assert shares[:3] == [LEAST_TRUST] * 3
    assert shares[-3:] == [1.0] * 3
    assert len(set(shares)) >= 5


@pytest.mark.parametrize(("offset", "near", "expected"), [(0.0, True, 1.0), (2.0, True, 0.02), (2.0, False, 0.6)], ids=["on", "neighbours", "none"])
def test_of_a_single_observation_the_share_is_drawn_towards_a_half(offset, near, expected):
    """One on the contour counts as two of three, one beside it as one of three, and none as one of two."""
    weight = trust(torch.tensor([[offset]]), torch.full((1, 1, 2), 50.0), torch.tensor([[near]]))
    assert float(weight) == pytest.approx(expected, abs=1e-6)


def test_observations_far_from_the_contour_count_neither_way():
    offsets = torch.cat([torch.zeros(40), torch.full((40,), 3.5)]).double()[None]
    targets, near = torch.full((1, 80, 2), 50.0, dtype=torch.float64), torch.ones(1, 80, dtype=torch.bool)
    assert (trust(offsets, targets, near) == 1).all()


def test_places_outside_the_image_have_patches_too():
    targets = torch.tensor([[[-1e9, 50.0], [1e9, 1e9], [50.0, -3.0]]])
    weights = trust(torch.zeros(1, 3), targets, torch.ones(1, 3, dtype=torch.bool))
    assert torch.isfinite(weights).all()


def test_without_concentration_every_match_is_trusted():
    matches, _ = nearest(seen(line_with_offsets((32, 64, 2.9))), upright_line(80.0), gate_px=4.0)
    assert (matches.weights == 1).all()


def test_observations_without_a_contour_nearby_do_not_count_against_others():
    targets = torch.cat([torch.full((1, 40, 2), 70.0), torch.full((1, 40, 2), 71.0)], 1)
    offset = torch.cat([torch.zeros(1, 40), torch.full((1, 40), 2.0)], 1)
    near = torch.arange(80)[None] < 40
    assert (trust(offset, targets, near)[0, :40] == 1).all()
    assert (trust(offset, targets, torch.ones_like(near))[0, :40] < 1).all()


def test_the_concentration_of_an_object_does_not_depend_on_the_others():
    places = torch.cat([line_with_offsets((32, 96, 0.6)), line_with_offsets((32, 96, 2.9))])
    contours = contours_at(upright_line(80.0).pixels.expand(2, -1, -1))
    together, _ = nearest(seen(places), contours, gate_px=4.0, concentration=True)
    for number in range(2):
        alone, _ = nearest(seen(places[number : number + 1]), upright_line(80.0), gate_px=4.0, concentration=True)
        assert torch.equal(together.weights[number], alone.weights[0])


# ---- along the flow


def along(observations, contours, *, gate_px=8.0, velocity=(0.0, 0.0)):
    moving = moving_objects(velocity, len(contours.pixels), contours.pixels.dtype)
    return match_along_flow(observations, contours, moving, gate_px)


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_corners_are_matched_along_their_flow_either_way(direction, dtype):
    matches = along(seen([[[75.0, 60.0], [86.0, 60.0]]], flow=[direction * 100.0, 0.0], dtype=dtype), upright_line(80.0, dtype=dtype))
    assert matches.mask.all()
    assert matches.contour.tolist() == [[40, 40]]


def test_the_match_lies_along_the_flow_where_another_is_nearer():
    """Flow at 45°: the nearest point of the line is straight across, the match as much further down as the search is narrow."""
    matches = along(seen([[[75.0, 60.0]]], flow=[100.0, 100.0]), upright_line(80.0))
    assert matches.mask.all()
    assert matches.contour.tolist() == [[43]]


def test_of_several_edges_along_the_flow_the_nearest_is_taken():
    v = torch.arange(20.0, 120.0, dtype=torch.float64)
    pixels = torch.cat([torch.stack([torch.full_like(v, u), v], -1) for u in (73.0, 78.0, 81.0)])[None]
    matches = along(seen([[[76.0, 60.0]]], flow=[100.0, 0.0]), contours_at(pixels))
    assert float(pixels[0, int(matches.contour[0, 0]), 0]) == 78.0


def test_the_search_ends_at_the_gate():
    assert not along(seen([[[70.0, 60.0]]], flow=[100.0, 0.0]), upright_line(80.0), gate_px=9.0).mask.any()
    assert along(seen([[[70.0, 60.0]]], flow=[100.0, 0.0]), upright_line(80.0), gate_px=11.0).mask.all()


def test_edges_that_the_flow_hardly_crosses_are_no_match():
    contours = upright_line(80.0)
    for angle_deg, expected in ((0, True), (60, True), (78, False), (90, False)):
        flow = [100 * math.cos(math.radians(angle_deg)), 100 * math.sin(math.radians(angle_deg))]
        assert bool(along(seen([[[79.5, 60.0]]], flow=flow), contours).mask.all()) == expected


def test_contours_beside_the_line_of_the_flow_are_no_match():
    assert not along(seen([[[80.0, 60.0]]], flow=[100.0, 0.0]), contours_at([[[85.0, 62.5]]])).mask.any()
    assert along(seen([[[80.0, 60.0]]], flow=[100.0, 0.0]), contours_at([[[85.0, 61.5]]])).mask.all()


def test_without_flow_or_masked_there_is_no_match():
    contours = upright_line(80.0)
    assert not along(seen([[[80.0, 60.0]]]), contours).mask.any()
    assert not along(seen([[[80.0, 60.0]]], flow=[1.0, 0.0], mask=[[False]]), contours).mask.any()
    assert not along(seen([[[80.0, 60.0]]], flow=[1.0, 0.0]), upright_line(80.0, mask=torch.zeros(1, 100, dtype=torch.bool))).mask.any()


def test_the_distance_counts_along_the_normal():
    matches = along(seen([[[79.0, 60.0]]], flow=[60.0, 80.0]), upright_line(80.0))
    assert matches.mask.all()
    assert matches.directions[0, 0].tolist() == pytest.approx([1.0, 0.0])


def test_targets_along_the_flow_are_moved_to_the_end_of_the_window():
    matches = along(seen([[[76.0, 60.0]]], age_s=8e-3, flow=[100.0, 0.0]), upright_line(80.0), velocity=(500.0, 0.0))
    assert matches.targets[0, 0].tolist() == pytest.approx([80.0, 60.0])


def test_both_coordinates_count_each_match_in_u_and_in_v(dtype):
    matches = along(seen([[[79.0, 60.0], [140.0, 60.0]]], flow=[100.0, 0.0], dtype=dtype), upright_line(80.0, dtype=dtype))
    both = both_coordinates(matches)
    assert both.mask.tolist() == [[True, False, True, False]]
    assert both.contour.tolist() == [[40, 0, 40, 0]]
    assert both.weights.tolist() == [[1, 1, 1, 1]]
    assert both.directions[0, [0, 2]].tolist() == [[1, 0], [0, 1]]
    assert torch.equal(both.targets, torch.cat([matches.targets, matches.targets], 1))


def test_box_contours_keep_their_kind_so_that_smooth_silhouettes_are_known():
    config = ContourConfig()
    contours = mesh_contours(group_by_model([box_model()], config), pose()[None].float(), SMALL_CAMERA.intrinsics()[None], config)
    assert (contours.kind == int(ContourKind.CREASE)).all()
