"""Sizes that do not hang on values give what exact ones give; values on their way, constants, and what is known of events without reading them."""

from dataclasses import replace

import pytest
import torch
from helpers import IMAGE_SIZE, box_model, contours_at, generator, random_events
from states import changed
from tracked_boxes import SCENES, assert_same, follow, started

from torchtrack import Tracker
from torchtrack.config.components import Component
from torchtrack.config.relocalization import RelocalizationConfig
from torchtrack.config.tracker import CornerConfig, TrackerConfig
from torchtrack.core import host_sync
from torchtrack.core.constants import constant
from torchtrack.core.events import EventBatch, concatenate, pad_streams
from torchtrack.tracking import initialization
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.frontend.bursts import no_bursts
from torchtrack.tracking.frontend.corners import detect_corners
from torchtrack.tracking.frontend.sensor_maps import SensorMaps
from torchtrack.tracking.frontend.sensor_view import SensorView
from torchtrack.tracking.frontend.tiles import NearbyEvents
from torchtrack.tracking.frontend.time_surface import empty_last_event, object_regions, time_surface, update_last_event
from torchtrack.tracking.step import StepInput, advance, opened, steady_advance

COUNT = 6
CORNERS = TrackerConfig(corners=CornerConfig(max_corners=20))
# A look before a pose is confirmed takes as long as all the rest; the search below takes one, of few rotations.
UNCHECKED = TrackerConfig(disabled={Component.UNCONFIRMED})
# In their first windows boxes are searched for as new ones, once in a while: not in all windows.
STEADY = TrackerConfig(relocalization=RelocalizationConfig(new_below=0))


@pytest.fixture
def nothing_is_read(monkeypatch):
    """From its call on, all is done as on a GPU, where values are not read."""
    return lambda: monkeypatch.setattr(host_sync, "read_at_once", lambda values: False)


# ---- values on their way, and constants


def test_an_answer_gives_the_values():
    value = host_sync.AsyncValue.to(torch.tensor([7, 18]))
    assert value.numbers() == [7, 18]
    assert value.any()
    assert not host_sync.AsyncValue.to(torch.zeros(3, dtype=torch.bool)).any()
    assert not host_sync.AsyncValue.to(torch.zeros(0, dtype=torch.bool)).any()


@pytest.mark.parametrize("shape", [(), (0,), (4,), (2, 3)])
def test_it_is_certain_that_none_is_true_where_none_is(shape, nothing_is_read):
    nothing = torch.zeros(shape, dtype=torch.bool)
    assert host_sync.none_of(nothing)
    if nothing.numel():
        something = nothing.clone()
        something.view(-1)[-1] = True
        assert not host_sync.none_of(something)
    nothing_is_read()
    assert not host_sync.none_of(nothing)


def test_an_answer_is_a_constant():
    assert not host_sync.AsyncValue.to(torch.ones(2, requires_grad=True)).on_device.requires_grad


def test_a_constant_is_made_once_for_each_type():
    like = torch.zeros(2)
    first = constant((1, 2), like.dtype, like.device)
    assert constant((1, 2), like.dtype, like.device) is first
    assert first.tolist() == [1.0, 2.0]
    assert constant((1, 2), torch.float64, like.device).dtype == torch.float64


def test_a_constant_made_in_inference_mode_takes_part_in_gradients():
    with torch.inference_mode():
        weights = constant((0.25, 0.125), torch.float32, torch.device("cpu"))
    x = torch.ones(2, requires_grad=True)
    (x * weights).sum().backward()
    assert x.grad.tolist() == [0.25, 0.125]


# ---- events


def three_streams():
    return concatenate([random_events(count, seed=stream, stream=stream) for stream, count in enumerate((40, 90, 20))])


def test_on_the_way_to_another_device_the_fullest_stream_is_noted():
    assert three_streams().to("cpu").most_of_one is None
    assert three_streams().to("meta").most_of_one == 90
    assert EventBatch.empty().to("meta").most_of_one == 0


def test_what_is_noted_holds_for_a_part_of_the_events_and_for_nothing_else():
    events = replace(three_streams(), most_of_one=90)
    assert events[events.t_us < 5_000].most_of_one == 90
    assert concatenate([events, events]).most_of_one is None
    assert events.of_stream(0).most_of_one is None


@pytest.mark.parametrize("noted", [90, 100, 1000, None])
def test_padding_to_what_is_noted_adds_padding_alone(nothing_is_read, noted):
    events, ends = three_streams(), torch.tensor([11_000, 12_000, 13_000])
    exact = pad_streams(events, 3, ends)
    nothing_is_read()
    padded = pad_streams(replace(events, most_of_one=noted), 3, ends)
    assert padded.mask.shape == (3, min(noted or 90, 150))
    for name, value in vars(exact).items():
        assert torch.equal(getattr(padded, name)[:, :90], value)
        assert not getattr(padded, name)[:, 90:].any()


def test_padding_of_no_events_needs_no_reading(nothing_is_read):
    nothing_is_read()
    assert pad_streams(EventBatch.empty(), 3, torch.zeros(3, dtype=torch.int64)).mask.tolist() == [[False]] * 3


# ---- the index and the regions


@pytest.mark.parametrize("cell_px", [1, 2, 3])
@pytest.mark.parametrize("radii_px", [(7, 7, 7), (18, 7, 12), (4, 0, 4)])
def test_an_index_of_the_whole_image_finds_the_same(nothing_is_read, dtype, cell_px, radii_px):
    rng = generator()
    pixels = (torch.rand((3, 200, 2), generator=rng) * torch.tensor([260.0, 210.0]) - 30).to(dtype)
    pixels[0, :4] = torch.tensor([[torch.nan, 3.0], [torch.inf, 5.0], [1e9, -1e9], [99.5, -6.5]], dtype=dtype)
    contours = contours_at(pixels, mask=torch.rand((3, 200), generator=rng) < 0.8, dtype=dtype)
    places = torch.rand((3, 4000, 2), generator=rng).to(dtype) * torch.tensor([300, 250], dtype=dtype) - 50
    exact = index_contours(contours, IMAGE_SIZE, torch.tensor(radii_px), cell_px).look_up(places)
    nothing_is_read()
    whole = index_contours(contours, IMAGE_SIZE, torch.tensor(radii_px), cell_px)
    assert torch.equal(whole.look_up(places), exact)
    assert (exact >= 0).sum() > 300


def test_an_index_of_no_contours_on_the_whole_image_is_empty(nothing_is_read):
    nothing_is_read()
    index = index_contours(contours_at([[[50.0, 50.0]]], mask=[[False]]), IMAGE_SIZE, 5, 1)
    assert (index.nearest == -1).all()


def corners_of(pixels, largest_px):
    """Corners of objects with contours at ``pixels`` on a sensor full of events, and the regions they come from."""
    events = random_events(8000, width=160, height=120)
    now, table = torch.tensor([10_000]), torch.zeros(1, 120, 160, 2)
    last = update_last_event(empty_last_event(1, 120, 160), events)
    mask, stream = torch.ones(pixels.shape[:2], dtype=torch.bool), torch.zeros(len(pixels), dtype=torch.int64)
    regions = object_regions(pixels, mask, stream, (120, 160), 12, largest_px)
    surface = time_surface(last, now, regions, 0.03, torch.float32)
    view = SensorView(SensorMaps(last, no_bursts(*last.shape)), now, table, stream)
    return regions, detect_corners(surface, regions, view, torch.tensor([0.01]), CORNERS)


def test_regions_of_one_size_give_the_same_corners(nothing_is_read):
    pixels = torch.tensor([[[20.0, 30.0], [70.0, 90.0]], [[0.0, 0.0], [159.0, 119.0]], [[100.0, 60.0], [130.0, 80.0]]])
    _, exact = corners_of(pixels, 256)
    nothing_is_read()
    regions, same = corners_of(pixels, 256)
    assert regions.size == (160, 192)
    assert torch.equal(same.mask, exact.mask)
    assert exact.mask.sum() >= 40
    assert torch.equal(same.sensor_pixels[same.mask], exact.sensor_pixels[exact.mask])


def test_of_a_larger_object_the_middle_is_taken(nothing_is_read):
    pixels = torch.tensor([[[20.0, 10.0], [149.0, 110.0]], [[100.0, 60.0], [110.0, 70.0]]])
    nothing_is_read()
    regions, corners = corners_of(pixels, 96)
    assert regions.size == (96, 96)
    assert regions.extent.tolist() == [[96, 96], [35, 35]]
    middle = regions.origin[0] + 48
    assert (middle - torch.tensor([84, 60])).abs().max() <= 4
    assert corners.mask.any(1).all()


# ---- whole steps


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(
    ("config", "max_unknown_px"),
    [
        (UNCHECKED, 2.0),
        (UNCHECKED, 0.01),
        (TrackerConfig(relocalization=RelocalizationConfig(trigger_sigma_px=1e-3, hypotheses=4, rotations=10)), 2.0),
    ],
    ids=["default", "in parts", "searched"],
)
def test_a_tracker_that_reads_nothing_finds_the_same(nothing_is_read, monkeypatch, scene, config, max_unknown_px):
    monkeypatch.setattr(initialization, "_EVENTS_OF_A_PART", 20)
    monkeypatch.setattr(initialization, "MAX_UNKNOWN_PX", max_unknown_px)
    starts, stream_index, cameras, cut = scene(COUNT)
    # Kernels are not for what reads nothing.
    boxes = Tracker([box_model()] * len(starts), cameras, config, stream_index, dtype=torch.float64, kernels=False)
    begin = boxes.init(torch.stack(starts), 0)
    with torch.inference_mode():
        _, exact = follow(boxes, begin, cut)
        nothing_is_read()
        _, bounded = follow(boxes, begin, cut)
    for result, other in zip(exact, bounded, strict=True):
        torch.testing.assert_close(other.T_cam_obj, result.T_cam_obj, rtol=0, atol=1e-9)
        torch.testing.assert_close(other.covariance, result.covariance, rtol=1e-6, atol=0)
        torch.testing.assert_close(other.quality, result.quality, rtol=0, atol=1e-9)
        assert torch.equal(other.status, result.status)
        assert torch.equal(other.observation_count, result.observation_count)


# ---- steady steps


def steady_step(tracker, state, events, end_us):
    """A window by the function that compiled graphs are of."""
    return steady_advance(tracker, opened(tracker, state, events), NearbyEvents(events), torch.as_tensor(end_us).expand_as(state.t_us))


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("reading", [True, False])
def test_a_steady_step_is_a_step(nothing_is_read, scene, reading):
    starts, stream_index, cameras, cut = scene(COUNT)
    boxes = Tracker([box_model()] * len(starts), cameras, STEADY, stream_index)
    with torch.inference_mode():
        state, _ = follow(boxes, boxes.init(torch.stack(starts), 0), cut[:-1])
        if not reading:
            nothing_is_read()
        *steady, wrong = steady_step(boxes, state, *cut[-1])
        assert not wrong
        events, end_us = cut[-1]
        given = StepInput(NearbyEvents(events), torch.as_tensor(end_us).expand_as(state.t_us), learns=False)
        for result, other in zip(steady, advance(boxes, opened(boxes, state, events), given), strict=True):
            assert_same(result, other)


@pytest.mark.parametrize("reading", [True, False])
@pytest.mark.parametrize("reason", ["in parts", "searched", "far away", "lost"])
def test_a_steady_step_says_when_it_does_not_hold(nothing_is_read, monkeypatch, reason, reading):
    # Made before anything is patched: other tests share it.
    boxes, state, _, window, _ = started(config=STEADY)
    monkeypatch.setattr(initialization, "_EVENTS_OF_A_PART", 20)
    *_, wrong = steady_step(boxes, state, *window)
    assert not wrong
    if not reading:
        nothing_is_read()
    uncertain = state.motion.covariance.clone()
    if reason == "in parts":
        uncertain[:, 6:, 6:] += torch.eye(6) * 4.0
    elif reason in ("searched", "far away"):
        uncertain[:, :6, :6] += torch.eye(6) * (0.05 if reason == "searched" else 0.005) ** 2
    # No window explains twice as much as all there is.
    usual_score = state.health.mean_score + (2 if reason == "lost" else 0)
    *_, wrong = steady_step(boxes, changed(state, covariance=uncertain, mean_score=usual_score), *window)
    assert wrong
