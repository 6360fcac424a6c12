"""From events to poses: boxes moving in every way, noise, gaps in the stream, distortion, occlusion, and recorded truth."""

from dataclasses import is_dataclass, replace

import numpy as np
import pytest
import torch
from helpers import BOX_EXTENTS_M, SMALL_CAMERA, box_model, drifting, edge_events, pose, pose_errors, random_events

import torchtrack
from torchtrack import Tracker, preset
from torchtrack.config.tracker import MotionConfig, TrackerConfig, WindowConfig
from torchtrack.core.camera import Camera, distort
from torchtrack.core.events import EventBatch, concatenate
from torchtrack.errors import EventDataError
from torchtrack.io import read_sequence
from torchtrack.object_model import ObjectModel
from torchtrack.run.runner import track
from torchtrack.tracking.validation.status import Status

MOTIONS = {
    "mixed": ((0.5, 0.6, 0.1), {}),
    "sideways": ((0.5, 0.6, 0.1), {"turn": (0.0, 0.0, 0.0), "move": (0.3, -0.1, 0.0)}),
    "towards": ((-0.4, 0.7, 0.2), {"turn": (0.0, 0.0, 0.0), "move": (0.0, 0.0, -0.8)}),
    "spinning": ((0.4, -0.7, 0.3), {"turn": (1.0, 2.0, -3.0), "move": (0.0, 0.0, 0.0)}),
}


def merged(*batches):
    events = concatenate(batches)
    return events[events.t_us.sort(stable=True).indices]


def followed(model, camera, events, T_start, *, config=None, dtype=torch.float32, start_us=0):
    """Every result of one object tracked through a stream."""
    tracker = Tracker([model], camera, config, dtype=dtype)
    return list(track([events], tracker, tracker.init(T_start[None], start_us)))


def errors_of(results, trajectory):
    """Rotation (degrees) and translation (mm) of every window."""
    T = torch.cat([result.T_cam_obj for result in results])
    return pose_errors(T, trajectory.at(torch.cat([result.t_us for result in results])))


# ---- synthetic


@pytest.mark.parametrize(("rotation", "motion"), list(MOTIONS.values()), ids=list(MOTIONS))
def test_a_moving_box_is_followed(rotation, motion, dtype):
    trajectory = drifting(pose(rotation), 60_000, **motion)
    results = followed(box_model(), SMALL_CAMERA, edge_events(trajectory), pose(rotation), dtype=dtype)
    degrees, millimetres = errors_of(results, trajectory)
    assert len(results) == 12
    assert [Status(int(result.status)) for result in results[4:]] == [Status.TRACKING] * 8
    assert float(degrees[3:].max()) < 0.5
    # A speed that is far from the rest that was assumed takes longer to be learned, in depth above all.
    speed_m_s = max(abs(part) for part in motion.get("move", (0.0,)))
    assert float(millimetres[3:].max()) < (2.5 if speed_m_s > 2 * MotionConfig().initial_speed_m_s else 1.0)
    assert float(millimetres[6:].max()) < 1.0
    # It has not just stood still.
    moved = pose_errors(trajectory.T_cam_obj[-1], trajectory.T_cam_obj[0])
    assert float(moved[0]) > 5 * float(degrees[-1]) or float(moved[1]) > 10 * float(millimetres[-1])


def test_precisions_agree_all_along():
    rotation, motion = MOTIONS["mixed"]
    trajectory = drifting(pose(rotation), 60_000, **motion)
    events = edge_events(trajectory)
    runs = [followed(box_model(), SMALL_CAMERA, events, pose(rotation), dtype=dtype) for dtype in (torch.float32, torch.float64)]
    degrees, millimetres = pose_errors(*(torch.cat([result.T_cam_obj for result in run]) for run in runs))
    assert float(degrees.max()) < 0.02
    assert float(millimetres.max()) < 0.1


def test_noise_all_over_the_image_does_little_harm():
    trajectory = drifting(pose(), 60_000)
    clean = edge_events(trajectory)
    noise = random_events(len(clean), width=200, height=150, duration_us=60_000, seed=9)
    results = followed(box_model(), SMALL_CAMERA, merged(clean, noise), pose())
    degrees, millimetres = errors_of(results, trajectory)
    assert float(degrees[3:].max()) < 1.0
    assert float(millimetres[3:].max()) < 2.0


def test_a_start_that_is_somewhat_off_is_corrected():
    trajectory = drifting(pose(), 80_000)
    start = pose((0.512, 0.59, 0.108), (0.002, -0.0015, 0.502))
    results = followed(box_model(), SMALL_CAMERA, edge_events(trajectory), start)
    degrees, millimetres = errors_of(results, trajectory)
    before = pose_errors(start, pose())
    assert float(degrees[-4:].max()) < 0.5 * float(before[0])
    assert float(millimetres[-4:].max()) < 0.5 * float(before[1])


def test_a_stream_may_start_at_any_time():
    """Microseconds since the epoch do not fit a float: nothing may depend on them."""
    events = edge_events(drifting(pose(), 30_000))
    runs = []
    for start_us in (0, 1_700_000_000_000_000):
        shifted = replace(events, t_us=events.t_us + start_us)
        results = followed(box_model(), SMALL_CAMERA, shifted, pose(), start_us=start_us)
        assert [int(result.t_us) for result in results] == [start_us + (k + 1) * 5000 for k in range(6)]
        runs.append(torch.cat([result.T_cam_obj for result in results]))
    assert torch.equal(*runs)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [("plumb_bob", (-0.3, 0.1, 2e-3, -1e-3)), ("fisheye", (0.1, -0.05, 0.02, 0.0))],
)
def test_a_lens_with_distortion_is_undone(model, coefficients):
    camera = replace(SMALL_CAMERA, distortion_model=model, distortion=coefficients)
    trajectory = drifting(pose(), 60_000)
    # Edges pass the points of a grid four times as fine; those that the lens takes to the centre of a pixel fire there.
    fine = edge_events(trajectory, Camera(fx=1000.0, fy=1000.0, cx=398.0, cy=298.0, width=800, height=600))
    sensor = distort(torch.stack([fine.x, fine.y], 1).numpy() / 4, camera)
    pixel = sensor.round().astype(np.int64)
    keep = (np.abs(sensor - pixel) < 0.15).all(1) & ((pixel >= 0) & (pixel < [200, 150])).all(1)
    assert keep.sum() > 1000
    events = EventBatch.from_numpy(pixel[keep, 0], pixel[keep, 1], fine.t_us.numpy()[keep], fine.polarity.numpy()[keep])
    degrees, millimetres = errors_of(followed(box_model(), camera, events, pose()), trajectory)
    assert float(degrees[3:].max()) < 0.5
    assert float(millimetres[3:].max()) < 1.0
    ignored = errors_of(followed(box_model(), SMALL_CAMERA, events, pose()), trajectory)
    assert float(ignored[1][3:].max()) > 2 * float(millimetres[3:].max())


def test_an_object_that_another_one_covers_keeps_its_pose():
    """A plate comes to rest before half of the box; its edges fire no more, and those that it hides do not either."""
    plate_extents = (0.05, 0.12, 0.005)
    trajectory = drifting(pose(), 60_000)
    behind = edge_events(trajectory)
    T_plate = pose((0.0, 0.0, 0.0), (-0.03, 0.0, 0.35))
    low, high = (250.0 * (torch.tensor([-0.03, 0.0]) + side * torch.tensor([0.025, 0.06])) / 0.35 + torch.tensor([99.5, 74.5]) for side in (-1, 1))
    places = torch.stack([behind.x, behind.y], 1)
    visible = ~((places >= low) & (places <= high)).all(1)
    assert 0.15 < float((~visible).float().mean()) < 0.85
    tracker = Tracker([box_model(), box_model(plate_extents)], SMALL_CAMERA)
    state = tracker.init(torch.stack([pose(), T_plate]), 0)
    results = list(track([behind[visible]], tracker, state))
    degrees, millimetres = errors_of(results, trajectory_of(trajectory, T_plate))
    assert float(degrees[3:].max()) < 1.5
    assert float(millimetres[3:].max()) < 3.0


def trajectory_of(moving, T_still):
    """True poses of both objects, as tracked: the moving one's and the still one's."""

    class Both:
        def at(self, t_us):
            return torch.stack([moving.at(t_us), T_still.expand(len(t_us), 4, 4)], 1).flatten(0, 1)

    return Both()


def test_windows_by_count_follow_too():
    trajectory = drifting(pose(), 60_000)
    config = TrackerConfig(window=WindowConfig(mode="count", count=120))
    results = followed(box_model(), SMALL_CAMERA, edge_events(trajectory), pose(), config=config)
    degrees, millimetres = errors_of(results, trajectory)
    assert len(results) > 8
    assert float(degrees[3:].max()) < 0.8
    assert float(millimetres[3:].max()) < 1.5


def test_a_stream_is_the_same_in_chunks_of_any_size():
    events = edge_events(drifting(pose(), 30_000))
    tracker = Tracker([box_model()], SMALL_CAMERA)
    runs = [
        torch.cat([result.T_cam_obj for result in track(chunks, tracker, tracker.init(pose()[None], 0))])
        for chunks in ([events], [events[start : start + 37] for start in range(0, len(events), 37)])
    ]
    assert torch.equal(*runs)


def test_a_stream_without_events_is_told():
    tracker = Tracker([box_model()], SMALL_CAMERA)
    with pytest.raises(EventDataError, match="no events after"):
        list(track([edge_events(drifting(pose(), 10_000))], tracker, tracker.init(pose()[None], 10**9)))


def test_a_pause_in_the_stream_is_bridged():
    """The box stops for 20 ms: no events, and no change of its pose."""
    first = drifting(pose(), 30_000)
    second = drifting(first.T_cam_obj[-1], 40_000, start_us=50_000)
    config = TrackerConfig(motion=MotionConfig(without_events="hold"))
    results = followed(box_model(), SMALL_CAMERA, concatenate([edge_events(first), edge_events(second)]), pose(), config=config)
    silent = [k for k, result in enumerate(results) if Status(int(result.status)) == Status.TOO_FEW_EVENTS]
    assert silent == [6, 7, 8, 9]
    degrees, millimetres = pose_errors(results[9].T_cam_obj, first.T_cam_obj[-1:])
    assert float(degrees) < 0.4
    assert float(millimetres) < 0.6
    degrees, millimetres = errors_of(results[-2:], second)
    assert float(degrees.max()) < 0.5
    assert float(millimetres.max()) < 1.0


def test_polyline_models_are_followed():
    """The edges of a box's front as lines: seen from the front, they are all there is."""
    x, y, z = (extent / 2 for extent in BOX_EXTENTS_M)
    front = [[-x, -y, -z], [x, -y, -z], [x, y, -z], [-x, y, -z], [-x, -y, -z]]
    model = ObjectModel.from_polylines([front])
    start = pose((0.0, 0.0, 0.2), (0.0, 0.0, 0.4))
    motion = {"turn": (0.0, 0.0, 1.5), "move": (0.15, 0.1, 0.0)}
    trajectory = drifting(start, 40_000, **motion)
    degrees, millimetres = errors_of(followed(model, SMALL_CAMERA, edge_events(trajectory), start), trajectory)
    assert float(degrees[3:].max()) < 1.0
    assert float(millimetres[3:].max()) < 2.0


def with_dtypes_of(state, like):
    """The state with each tensor in the precision that it has in another one."""
    if is_dataclass(state):
        return replace(state, **{name: with_dtypes_of(value, getattr(like, name)) for name, value in vars(state).items()})
    return state.to(like.dtype) if torch.is_tensor(state) else state


# ---- a recorded sequence with its truth


@pytest.fixture(scope="module")
def lbracket(data_dir):
    """The first 0.3 s of a straight-edged object: its model, camera, true poses and events."""
    sequence = read_sequence(data_dir / "sequences" / "lbracket_normal.npz")
    (thing,) = sequence.objects
    truth = thing.ground_truth
    start_us = int(truth.t_us[0])
    taken = []
    for chunk in sequence.events.chunks():
        taken.append(chunk.slice_time(start_us, start_us + 300_000))
        if int(chunk.t_us[-1]) > start_us + 300_000:
            break
    return ObjectModel.from_file(thing.mesh_path), sequence.camera, truth, concatenate(taken), start_us


@pytest.fixture(scope="module")
def lbracket_runs(lbracket):
    """The same sixty windows in both precisions."""
    model, camera, truth, events, start_us = lbracket
    T_start = truth.at(torch.tensor([start_us]))[0]
    return {dtype: followed(model, camera, events, T_start, dtype=dtype, start_us=start_us) for dtype in (torch.float32, torch.float64)}


def test_a_recorded_object_is_followed_to_half_a_degree(lbracket, lbracket_runs, dtype):
    results = lbracket_runs[dtype][:40]
    degrees, millimetres = errors_of(results, lbracket[2])
    assert len(results) == 40
    assert all(int(result.status) <= Status.UNCERTAIN for result in results)
    assert float(degrees.max()) < 0.5
    assert float(millimetres.max()) < 2.0


def test_precisions_agree_on_a_recording(lbracket):
    """Each window from the same state: what differs then is rounding, not what became of it in the windows before."""
    model, camera, truth, events, start_us = lbracket
    trackers = {dtype: Tracker([model], camera, dtype=dtype) for dtype in (torch.float64, torch.float32)}
    states = {dtype: tracker.init(truth.at(torch.tensor([start_us])), start_us) for dtype, tracker in trackers.items()}
    poses_by_type = {dtype: [] for dtype in trackers}
    for end_us in range(start_us + 5000, start_us + 200_001, 5000):
        window = events.slice_time(end_us - 5000, end_us)
        rounded = with_dtypes_of(states[torch.float64], states[torch.float32])
        for dtype, state in ((torch.float32, rounded), (torch.float64, states[torch.float64])):
            states[dtype], result = trackers[dtype].step(state, window, end_us)
            poses_by_type[dtype].append(result.T_cam_obj)
    degrees, millimetres = pose_errors(torch.cat(poses_by_type[torch.float32]), torch.cat(poses_by_type[torch.float64]))
    assert len(degrees) == 40
    assert float(degrees.max()) < 0.02
    assert float(millimetres.max()) < 0.1


def test_precisions_are_as_exact_on_a_recording(lbracket, lbracket_runs):
    """Over many windows roundings add up to other choices, and poses drift apart by a few hundredths of a degree: neither is the worse one."""
    (single_deg, single_mm), (double_deg, double_mm) = (errors_of(lbracket_runs[dtype], lbracket[2]) for dtype in (torch.float32, torch.float64))
    assert len(single_deg) == 60
    assert abs(float(single_deg.mean() - double_deg.mean())) < 0.02
    assert abs(float(single_mm.mean() - double_mm.mean())) < 0.1


def test_the_papers_settings_run_on_a_recording(lbracket):
    model, camera, truth, events, start_us = lbracket
    T_start = truth.at(torch.tensor([start_us]))[0]
    short = events.slice_time(start_us, start_us + 50_000)
    results = followed(model, camera, short, T_start, config=preset("paper"), start_us=start_us)
    assert len(results) == 17
    assert torch.isfinite(torch.cat([result.T_cam_obj for result in results])).all()
    assert any(result.corners.has_flow.any() for result in results)
    assert any(int(result.observation_count) > 0 for result in results)


def test_the_package_offers_what_the_pipeline_needs():
    assert torchtrack.Tracker is Tracker
    assert torchtrack.track is track
