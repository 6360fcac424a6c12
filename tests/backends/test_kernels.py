"""Kernels give what PyTorch's operations give, stage by stage; objects do not see one another in them."""

from dataclasses import replace

import pytest
import torch
import trimesh
from both_ways import assert_as_close, both_ways
from helpers import IMAGE_SIZE, SMALL_CAMERA, box_model, contours_at, generator, moving_objects, pose, random_events, random_pose, random_twist, seen
from solid_models import ball, l_prism

from torchtrack import Tracker
from torchtrack.config.tracker import ContourConfig, FlowConfig, TrackerConfig
from torchtrack.core.events import concatenate, pad_streams
from torchtrack.core.image_velocity import MovingObjects
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.contour_source import ContourKind, group_by_model
from torchtrack.tracking.association.matches import MatchesWithCues
from torchtrack.tracking.association.nearest import contour_table
from torchtrack.tracking.association.observations import select_events
from torchtrack.tracking.association.polarity import remembered
from torchtrack.tracking.contours.depth_buffer import Scene
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.contours.objects import ObjectBatch
from torchtrack.tracking.contours.points import assemble, reproject
from torchtrack.tracking.contours.sampling import mesh_contours
from torchtrack.tracking.contours.visibility import remove_hidden
from torchtrack.tracking.frontend.arrival_flow import arrival_flow
from torchtrack.tracking.frontend.bursts import LONG_AGO_US, update_bursts
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.sensor_view import SensorPoints, SensorView
from torchtrack.tracking.frontend.time_surface import empty_last_event
from torchtrack.tracking.frontend.window_events import WindowEvents
from torchtrack.tracking.motion.prediction import Prediction
from torchtrack.tracking.relocalization.sampling import score_outlines
from torchtrack.tracking.validation.measures import fit_measures

pytest.importorskip("numba", reason="needs numba: pip install 'torchtrack[fast]'")
BENT_CAMERA = replace(SMALL_CAMERA, distortion_model="plumb_bob", distortion=(-0.2, 0.05, 0.001, -0.002, 0.0))
TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}


def uniform(*shape, low=0.0, high=1.0, seed=0, dtype=torch.float64):
    return (low + (high - low) * torch.rand(shape, generator=generator(seed), dtype=torch.float64)).to(dtype)


def random_contours(batch=3, count=400, seed=0, dtype=torch.float64):
    """Contour points all over an image and beside it, of all kinds, some of which do not count."""
    pixels = uniform(batch, count, 2, low=-20, high=190, seed=seed, dtype=dtype)
    angle = uniform(batch, count, high=6.28, seed=seed + 1, dtype=dtype)
    kind = torch.randint(len(ContourKind), (batch, count), generator=generator(seed + 2))
    mask = uniform(batch, count, seed=seed + 3) < 0.8
    contours = contours_at(pixels, torch.stack([angle.cos(), angle.sin()], -1), mask=mask, dtype=dtype)
    return replace(contours, kind=kind, resolved=uniform(batch, count, low=-0.5, seed=seed + 4, dtype=dtype).clamp(min=0))


# ---- contours, hidden or not


def textured_plate():
    """A plate with lines of texture on one side, now brighter above, now below."""
    plate = ObjectModel.from_mesh(trimesh.creation.box((0.12, 0.10, 0.01)))
    grid = torch.stack(torch.meshgrid(torch.linspace(-0.05, 0.05, 21), torch.linspace(-0.04, 0.04, 17), indexing="ij"), -1).flatten(0, 1)
    points = torch.cat([grid, torch.full_like(grid[:, :1], -0.005)], 1)
    tangents, normals = torch.tensor([1.0, 0.0, 0.0]).repeat(len(points), 1), torch.tensor([0.0, 0.0, -1.0]).repeat(len(points), 1)
    tangents.view(21, 17, 3)[:, 1::2] *= -1
    return replace(plate, texture_points=points, texture_tangents=tangents, texture_normals=normals)


def all_kinds():
    lines = ObjectModel.from_polylines([[[0, 0, 0], [0.08, 0, 0], [0.08, 0.05, 0.01], [0, 0, 0]]], unit="m")
    box = box_model()
    return [box, ObjectModel.from_mesh(l_prism()), ObjectModel.from_mesh(ball(0.05)), textured_plate(), lines, box]


CORNERS_ALONE = {"corners": {"max_corners": 32}, "association": {"max_events": 0}}
SETTINGS = {
    "as it is": ContourConfig(),
    "no creases": ContourConfig(creases=False),
    "no texture": ContourConfig(texture=False),
    "few points": ContourConfig(max_edge_points=40),
}


@pytest.mark.parametrize("config", SETTINGS.values(), ids=SETTINGS)
@pytest.mark.parametrize("seed", range(3))
def test_contours_of_models_of_all_kinds(config, seed, dtype):
    groups = [group.to(dtype) for group in group_by_model(all_kinds(), config)]
    T, intrinsics = random_pose(6, seed=seed).to(dtype), SMALL_CAMERA.intrinsics(dtype).expand(6, 4)
    by_kernels, plain = both_ways(lambda: mesh_contours(groups, T, intrinsics, config))
    if dtype == torch.float32 and not torch.equal(by_kernels.mask.sum(1), plain.mask.sum(1)):
        # A length that is nearly whole may be rounded up or down: then all points lie elsewhere.
        pytest.skip("rounded to another number of points")
    for number in range(6):
        ours, theirs = ([value[number][contours.mask[number]] for value in vars(contours).values()] for contours in (by_kernels, plain))
        assert_as_close(tuple(ours), tuple(theirs), tolerance=0.02 if dtype == torch.float32 else 1e-7)


def test_what_is_behind_the_camera_has_no_contours():
    groups = group_by_model([box_model(), box_model()], ContourConfig())
    T = torch.stack([pose(), pose(translation=(0.0, 0.0, -0.5))]).float()
    for contours in both_ways(lambda: mesh_contours(groups, T, SMALL_CAMERA.intrinsics().expand(2, 4), ContourConfig())):
        assert contours.mask.any(1).tolist() == [True, False]
        assert all(torch.isfinite(value).all() for value in vars(contours).values() if value.is_floating_point())


def test_points_at_a_pose(dtype):
    contours, T = random_contours(dtype=dtype), random_pose(3, depth_m=(-1.0, 3.0)).to(dtype)
    intrinsics = SMALL_CAMERA.intrinsics(dtype).expand(3, 4)
    given = contours.points_obj * 1e-3, contours.points_cam.roll(1, 1), contours.kind, contours.mask, T, intrinsics
    assert_as_close(*both_ways(lambda: assemble(*given)), tolerance=TOLERANCE[dtype])
    assert_as_close(*both_ways(lambda: reproject(replace(contours, points_obj=given[0]), T, intrinsics)), tolerance=TOLERANCE[dtype])


@pytest.mark.parametrize("streams", [[0, 0, 0, 0, 0, 0], [0, 1, 2, 0, 1, 1]])
@pytest.mark.parametrize("depth_m", [(0.4, 0.8), (0.8, 3.0)], ids=["near", "far"])
@pytest.mark.parametrize("seed", range(3))
def test_hidden_contours_of_objects_before_one_another(streams, depth_m, seed):
    models, streams = all_kinds(), torch.tensor(streams)
    groups = [group.double() for group in group_by_model(models, ContourConfig())]
    T, intrinsics = random_pose(6, seed=seed, depth_m=depth_m), SMALL_CAMERA.intrinsics(torch.float64).expand(6, 4)
    diameters, shape = torch.tensor([model.diameter_m for model in models]).double(), (3, SMALL_CAMERA.height, SMALL_CAMERA.width)
    contours = mesh_contours(groups, T, intrinsics, ContourConfig())
    scene = Scene(groups, T, intrinsics, streams, diameters, shape, shared=True)
    by_kernels, plain = both_ways(lambda: remove_hidden(contours, scene))
    assert torch.equal(by_kernels.mask, plain.mask)
    assert 0 < int(plain.mask.sum()) < int(contours.mask.sum())


# ---- index, table and choice of events


@pytest.mark.parametrize("cell_px", [1, 2, 3])
@pytest.mark.parametrize("radius_px", [2, 7, torch.tensor([3, 7, 18])])
def test_the_nearest_contour_of_every_cell(radius_px, cell_px):
    contours, places = random_contours(), uniform(3, 5000, 2, low=-30, high=220, seed=9)
    places[0, :3] = torch.tensor([torch.nan, torch.inf, 1e30])[:, None]
    (ours, theirs) = both_ways(lambda: index_contours(contours, IMAGE_SIZE, radius_px, cell_px))
    for subcell_lookup in (None, torch.tensor([True, False, True])):
        assert torch.equal(ours.look_up(places, subcell_lookup), theirs.look_up(places, subcell_lookup))


def test_of_no_contours_nothing_is_found():
    contours = random_contours()
    contours = replace(contours, mask=contours.mask & torch.tensor([True, False, True])[:, None])
    for index in both_ways(lambda: index_contours(contours, IMAGE_SIZE, 7, 2)):
        assert (index.look_up(contours.pixels)[1] == -1).all()


@pytest.mark.parametrize("of_texture", [True, False])
@pytest.mark.parametrize("polarity", [None, uniform(3, 8, low=-1)])
def test_the_table_of_contours(polarity, of_texture, dtype):
    contours, polarity = random_contours(dtype=dtype), None if polarity is None else polarity.to(dtype)
    contours = replace(contours, points_cam=contours.points_cam + uniform(*contours.mask.shape, 1, seed=5, dtype=dtype))
    index = index_contours(contours, IMAGE_SIZE, 7, 2)
    ours, theirs = both_ways(lambda: contour_table(contours, index, polarity, of_texture=of_texture).rows)
    counts = contours.mask[:, None].expand_as(ours)
    torch.testing.assert_close(ours[counts], theirs[counts], rtol=1e-5, atol=1e-5)


def window_events(batch=3, count=4000, dtype=torch.float64):
    polarity = torch.where(uniform(batch, count, seed=3) < 0.5, -1.0, 1.0).to(dtype)
    age_s = uniform(batch, count, high=5e-3, seed=1, dtype=dtype)
    return WindowEvents(uniform(batch, count, 2, high=180, dtype=dtype), age_s, polarity, uniform(batch, count, seed=4) < 0.9)


@pytest.mark.parametrize("count", [200, 10_000])
@pytest.mark.parametrize("kind", ["of each", "numbered", "of all", "none"])
def test_which_events_are_chosen(count, kind):
    events, contours = window_events(), random_contours()
    if kind == "numbered":
        events = replace(events, number=torch.arange(4000).mul(3).expand(3, -1).contiguous())
    if kind == "of all":
        events = events.of_object(0).repeated(3)
    if kind == "none":
        events = replace(events, mask=torch.zeros_like(events.mask))
    index, objects = index_contours(contours, IMAGE_SIZE, 7, 2), moving_objects((300.0, -200.0), 3)
    ours, theirs = both_ways(lambda: select_events(events, index, objects, count))
    assert torch.equal(ours.mask, theirs.mask)
    for name in ("pixels", "age_s", "polarity"):
        assert torch.equal(getattr(ours, name)[ours.mask], getattr(theirs, name)[ours.mask])


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("count", [150, 300, 5000])
def test_which_events_are_chosen_beside_corners(share, count):
    events, contours = window_events(), random_contours()
    mask = uniform(3, 250, seed=9) < share
    flow = torch.where(mask[..., None], uniform(3, 250, 2, seed=8), 0)
    corners = seen(uniform(3, 250, 2, seed=7), age_s=uniform(3, 250, seed=6), polarity=1.0, flow=flow, mask=mask)
    index, objects = index_contours(contours, IMAGE_SIZE, 7, 2), moving_objects((300.0, -200.0), 3)
    ours, theirs = both_ways(lambda: select_events(events, index, objects, count, corners))
    for name in ("mask", "has_flow", "flow"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name))
    for name in ("pixels", "age_s", "polarity"):
        assert torch.equal(getattr(ours, name)[ours.mask], getattr(theirs, name)[ours.mask])


# ---- flow


@pytest.mark.parametrize("count", [1, 16, 37, 300])
def test_arrival_flow_at_and_beside_borders(count, dtype):
    """Of every number of pixels, also those that do not fill a block, and of several streams."""
    height, width = 12, 15
    ages = torch.randint(LONG_AGO_US + 1, (2, 2, height, width), generator=generator(1), dtype=torch.int16)
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    ages[:, 1] = (1000 + 400 * u + 90 * v + 300 * uniform(2, height, width, seed=4)).to(torch.int16)
    table = torch.stack([u, v], -1).to(dtype) + uniform(2, height, width, 2, high=0.2, seed=2, dtype=dtype)
    pixels = (uniform(3, count, 2, seed=3) * torch.tensor([width, height])).long()
    polarity = torch.randint(-1, 2, (3, count), generator=generator(5)).to(dtype)
    points = SensorPoints(pixels, torch.zeros_like(polarity), polarity, uniform(3, count, seed=6) < 0.8)
    view = SensorView(SensorMaps(empty_last_event(2, height, width), ages), torch.zeros(2).long(), table, torch.tensor([1, 0, 1]))
    (flow, valid), (plain_flow, plain_valid) = both_ways(lambda: arrival_flow(points, view, FlowConfig(model="arrival")))
    assert torch.equal(valid, plain_valid) and (count < 37 or valid.any())
    torch.testing.assert_close(flow, plain_flow, rtol=TOLERANCE[dtype], atol=TOLERANCE[dtype])


def test_sensor_pixels_nearest_to_ideal_ones_and_to_what_lies_beside():
    sensors = Tracker([box_model()] * 2, [SMALL_CAMERA, BENT_CAMERA], stream_index=[1, 0]).sensors
    pixels = uniform(2, 500, 2, low=-300, high=500, dtype=torch.float32)
    ours, theirs = both_ways(lambda: sensors.nearest_pixels(pixels))
    assert torch.equal(ours, theirs)


# ---- events


@pytest.mark.parametrize("elapsed_us", [5000, 40_000])
@pytest.mark.parametrize("streams", [1, 3])
def test_bursts_of_pixels_that_fire_again_and_again(elapsed_us, streams):
    batches = [random_events(800 + 50 * s, width=8, height=6, duration_us=elapsed_us - 1, seed=s, stream=s) for s in range(streams)]
    events = pad_streams(concatenate(batches), streams, torch.full((streams,), elapsed_us))
    before = torch.randint(LONG_AGO_US, (streams, 2, 6, 8), generator=generator(5), dtype=torch.int16)
    ours, theirs = both_ways(lambda: update_bursts(before, torch.full((streams,), elapsed_us), events))
    assert torch.equal(ours, theirs)


# ---- measures and matrices


# Each object in an image of its own size.
IMAGE_SIZES = torch.tensor([IMAGE_SIZE, (90, 200), (150, 110)])


def random_matches(batch=3, count=6000):
    """Matches with numbers all over."""
    offsets, near = uniform(batch, count, low=-6, high=6, seed=1), uniform(batch, count, seed=2) < 0.7
    zeros, points = torch.zeros_like(offsets), torch.zeros(batch, count, 3).double()
    targets, directions = uniform(batch, count, 2, high=180, seed=3), uniform(batch, count, 2, low=-1, seed=4)
    stated = uniform(batch, count, low=0.5, seed=5), torch.where(near, 1.0, -1.0).double(), zeros + 1
    contour = torch.randint(400, (batch, count), generator=generator(7))
    return MatchesWithCues(contour, near, uniform(batch, count, seed=6), zeros, points, targets, directions, offsets, near, *stated)


@pytest.mark.parametrize("speed", [0.0, 40.0, 900.0])
@pytest.mark.parametrize("settings", [{}, CORNERS_ALONE, {"validation": {"min_observations": 5000}}])
def test_what_events_explain(speed, settings):
    config = TrackerConfig.model_validate(settings)
    contours, objects = random_contours(), moving_objects((speed, 0.5 * speed), 3)
    by_kernels, plain = both_ways(lambda: fit_measures(contours, random_matches(), objects, IMAGE_SIZES, config))
    assert_as_close(by_kernels, plain, tolerance=1e-6)
    assert by_kernels.texture_agreement.isnan().all() == ("validation" in settings)


def test_what_is_remembered_of_sides():
    matches, before = random_matches(), uniform(3, 8, low=-1, seed=8)
    weights = torch.where(matches.near, matches.weights, 0)
    window_s = torch.full((3,), 5e-3).double()
    assert_as_close(*both_ways(lambda: remembered(before, matches.directions, matches.dark, weights, window_s)))


# ---- every object for itself


@pytest.mark.parametrize("what", ["points", "pixels"])
def test_what_is_not_a_number_stays_with_its_object(what):
    contours = random_contours()
    spoilt = replace(contours, **{name: value.clone() for name, value in (("pixels", contours.pixels), ("points_cam", contours.points_cam))})
    (spoilt.points_cam if what == "points" else spoilt.pixels)[1] = torch.nan
    objects = MovingObjects(torch.eye(4).double().expand(3, 4, 4), random_twist(3), torch.ones(3, 3).double(), torch.ones(3, 4).double())
    with torch.inference_mode():
        alone, neighbours = (fit_measures(owner, random_matches(), objects, IMAGE_SIZES, TrackerConfig()) for owner in (contours, spoilt))
        index, other = (index_contours(owner, IMAGE_SIZE, 7, 2) for owner in (contours, spoilt))
    for first, second in zip(alone, neighbours, strict=True):
        torch.testing.assert_close(first[[0, 2]], second[[0, 2]], rtol=0, atol=0, equal_nan=True)
    assert torch.equal(index.look_up(contours.pixels)[[0, 2]], other.look_up(contours.pixels)[[0, 2]])


# ---- scores of poses


@pytest.mark.parametrize("each", [True, False])
def test_marks_of_poses(each, dtype):
    camera = torch.tensor([[1.0, 1.0, 0.0, 0.0]], dtype=dtype)
    group = group_by_model([box_model()], ContourConfig())[0].to(dtype)
    own = torch.zeros(1, 3, dtype=dtype), torch.ones(1, 3, dtype=dtype), torch.ones(1, dtype=dtype), torch.zeros(1).long(), torch.tensor([IMAGE_SIZE])
    objects = ObjectBatch([group], camera, *own, (1, *IMAGE_SIZE), False)
    T_cam_obj = torch.eye(4, dtype=dtype)[None]
    prediction = Prediction(objects, T_cam_obj, torch.ones(1).bool(), torch.zeros(1, 6, dtype=dtype), torch.eye(12).double()[None])
    outlines = random_contours(40 if each else 1, 200, dtype=dtype)
    outlines = replace(outlines, tangents_obj=uniform(*outlines.points_obj.shape, low=-1, seed=5, dtype=dtype))
    offsets = torch.nn.functional.pad(random_twist(40, rotation_rad=0.01, translation_m=3.0).to(dtype), (0, 7))
    offsets[3, :6] = torch.nan
    image = uniform(1, IMAGE_SIZE[0] + 4, IMAGE_SIZE[1] + 4, high=3, seed=7, dtype=dtype)
    by_kernels, plain = both_ways(lambda: score_outlines(outlines, prediction.poses_at(offsets[:, :6]), camera, image))
    known = torch.arange(40) != 3
    torch.testing.assert_close(by_kernels[known], plain[known], rtol=1e-4, atol=1e-9 if dtype == torch.float64 else 0.03)
