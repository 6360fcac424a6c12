"""Triton's rounds give what their reference gives: on a GPU, or in Triton's interpreter; and they compile for GPUs that are not here."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from both_ways import ROUNDINGS
from helpers import SMALL_CAMERA, bevelled_model, box_model, pose
from places import REPOSITORY
from states import changed
from tracked_boxes import follow, moving_box, poses_of, tensors_of, windows

from torchtrack import Tracker, preset
from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig
from torchtrack.core import dispatch, host_sync
from torchtrack.core.lie import retract_about
from torchtrack.tracking.contours.points import Contours

pytest.importorskip("triton", reason="needs Triton: pip install triton")
from torchtrack.backends.triton import operations  # noqa: F401 - it registers what is accelerated

# Unlike a GPU, the interpreter warns of what is not a number.
pytestmark = pytest.mark.filterwarnings("ignore:.*encountered in.*:RuntimeWarning")
BODY = dispatch.OPERATIONS["tracking.estimation.rounds.align_rounds"].bodies["cuda"]
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
FEW = {"association": {"max_events": 200}}


def calls_of(track, monkeypatch):
    """The arguments that rounds are called with on the way."""
    calls, operation = [], dispatch.OPERATIONS["tracking.estimation.rounds.align_rounds"]
    reference = operation.reference
    with monkeypatch.context() as patch, torch.inference_mode():
        patch.setattr(operation, "reference", lambda *args: calls.append(args) or reference(*args))
        track()
    return calls


def call_of(monkeypatch, *starts, model=None, dtype=torch.float64, of_window=2, **settings):
    """The arguments of the rounds of one window, of boxes that move."""
    config = TrackerConfig.model_validate(FEW | settings | {"association": FEW["association"] | settings.get("association", {})})
    starts = torch.stack(starts or (pose(),))
    _, events = moving_box(starts[0], of_window)
    tracker = Tracker([model or box_model()] * len(starts), SMALL_CAMERA, config, dtype=dtype, kernels=False).to(DEVICE)
    state = tracker.init(starts, 0)
    given = [(batch.to(DEVICE), end_us) for batch, end_us in windows(events, of_window)]
    calls = calls_of(lambda: follow(tracker, state, given), monkeypatch)
    # Not those of other poses that are tried.
    return next(args for args in reversed(calls) if len(args[2].mask) == len(starts))


def numbers(result, objects=slice(None)):
    """What counts of a result: of observations without a match, nothing does."""
    solution, matches, contours = result
    of_matches = [getattr(matches, name)[objects][matches.mask[objects]] for name in vars(matches)]
    return [tensor[objects] for tensor in tensors_of(solution)] + [
        matches.mask[objects],
        matches.near[objects],
        matches.weights[objects],
        *of_matches,
        contours.mask[objects],
    ]


def assert_as_the_reference(args, tolerance):
    with torch.inference_mode():
        assert BODY.supports(*args)
        ours, theirs = numbers(BODY.accelerated(*args)), numbers(dispatch.OPERATIONS["tracking.estimation.rounds.align_rounds"].reference(*args))
    for mine, other in zip(ours, theirs, strict=True):
        assert mine.dtype == other.dtype
        if not mine.is_floating_point():
            assert torch.equal(mine, other)
            continue
        # A gradient is a sum of forces that nearly cancel.
        scale = float(other.abs().max()) if other.numel() else 1.0
        torch.testing.assert_close(mine, other, rtol=tolerance, atol=tolerance * max(scale, 1.0))


# ---- the index of contours


INDEX = dispatch.OPERATIONS["tracking.contours.index.index_contours"]


def contours_of(*poses, dtype=torch.float32):
    """Contours of boxes, and the size of their image."""
    tracker = Tracker([box_model()] * len(poses), SMALL_CAMERA, dtype=dtype, kernels=False).to(DEVICE)
    return tracker.objects.contours(torch.stack(poses).to(tracker.intrinsics), tracker.config.contours), tracker.image_size


@pytest.mark.parametrize(("radius_px", "cell_px"), [(7, 2), (7, 3), ([3, 25], 2), ([0, 12], 3)])
def test_each_cell_knows_the_contour_that_the_reference_does(radius_px, cell_px, dtype, monkeypatch):
    contours, size = contours_of(pose(), pose(translation=(0.06, -0.05, 0.6)), dtype=dtype)
    radius = radius_px if isinstance(radius_px, int) else torch.tensor(radius_px, device=DEVICE)
    monkeypatch.setattr(host_sync, "read_at_once", lambda values: False)
    with torch.inference_mode():
        ours, theirs = INDEX.bodies["cuda"].accelerated(contours, size, radius, cell_px), INDEX.reference(contours, size, radius, cell_px)
    assert (ours.size, ours.cell_px) == (theirs.size, theirs.cell_px)
    assert torch.equal(ours.first, theirs.first) and torch.equal(ours.nearest.long(), theirs.nearest)
    assert ours.nearest.dtype == torch.int32
    assert (ours.nearest >= 0).any(1).all()


def test_distances_that_need_more_than_32_bits(monkeypatch):
    contours, size = contours_of(pose(), dtype=torch.float64)
    monkeypatch.setattr(host_sync, "read_at_once", lambda values: False)
    with torch.inference_mode():
        ours, theirs = INDEX.bodies["cuda"].accelerated(contours, size, 2000, 200), INDEX.reference(contours, size, 2000, 200)
    assert ours.nearest.dtype == torch.int64 and torch.equal(ours.nearest, theirs.nearest)


def test_a_contour_that_is_nowhere_or_far_outside_is_in_no_cell(monkeypatch):
    contours, size = contours_of(pose(), pose())
    pixels = contours.pixels.clone()
    pixels[0], pixels[1, ::2] = 1e5, torch.nan
    monkeypatch.setattr(host_sync, "read_at_once", lambda values: False)
    with torch.inference_mode():
        index = INDEX.bodies["cuda"].accelerated(replace(contours, pixels=pixels), size, 7, 2)
    assert (index.nearest[0] == -1).all()
    assert set(index.nearest[1].unique().tolist()) <= {-1, *range(1, contours.mask.shape[1], 2)}


def test_without_contour_points_the_reference_makes_the_index():
    contours, size = contours_of(pose())
    assert INDEX.bodies["cuda"].supports(contours, size, 7, 2)
    assert not INDEX.bodies["cuda"].supports(Contours(*(value[:, :0] for value in vars(contours).values())), size, 7, 2)


# ---- rounds


SETTINGS = {
    "as it is": {},
    "no compensation": {"association": {"motion_compensation": False}},
    "all weights alike": {"association": {"polarity": False, "concentration": False}},
    "no velocity": {"disabled": [Component.VELOCITY_IN_WINDOW, Component.DARK_SHIFT, Component.COMMON_ERROR]},
    "too few": {"validation": {"min_observations": 10_000}},
    "one round": {"association": {"gates_px": [4.0]}},
}


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_settings_that_kernels_know(settings, monkeypatch):
    assert_as_the_reference(call_of(monkeypatch, **settings), 1e-6)


def test_roundings_of_both_types(dtype, monkeypatch):
    assert_as_the_reference(call_of(monkeypatch, dtype=dtype), 10 * ROUNDINGS[dtype] if dtype == torch.float32 else 1e-6)


@pytest.mark.parametrize("between_cells", [True, False])
def test_smooth_silhouettes_looked_up_between_cells_or_not(between_cells, monkeypatch):
    start, table, observations, gates, config = call_of(monkeypatch, model=bevelled_model())
    gates = replace(gates, subcell_lookup=torch.full_like(gates.subcell_lookup, between_cells))
    assert_as_the_reference((start, table, observations, gates, config), 1e-6)


def test_wider_gates_of_some_that_begin_elsewhere(monkeypatch):
    start, *rest, gates, config = call_of(monkeypatch, pose(), pose(translation=(0.02, 0.0, 0.7)))
    offset = torch.full_like(start.prediction.velocity, 1e-3).repeat(1, 2)
    wider = gates.wider * torch.tensor([1.0, 1.7], dtype=gates.wider.dtype, device=gates.wider.device)
    assert_as_the_reference((replace(start, offset=offset), *rest, replace(gates, wider=wider), config), 1e-6)


def test_objects_do_not_see_one_another(monkeypatch):
    """One that is nowhere changes nothing of its neighbour, and stays where it is."""
    start, table, observations, gates, config = call_of(monkeypatch, pose(), pose(translation=(0.02, 0.0, 0.7)))
    spoilt = replace(observations, pixels=observations.pixels.clone())
    spoilt.pixels[0] = torch.nan
    with torch.inference_mode():
        results = [BODY.accelerated(start, table, given, gates, config) for given in (observations, spoilt)]
    pairs = zip(*(numbers(result, slice(1, 2)) for result in results), strict=True)
    assert all(torch.equal(mine, other) for mine, other in pairs)
    assert torch.equal(results[1][0].T_cam_obj[0], start.begin.T_cam_obj[0])


def test_information_that_is_not_positive_definite_takes_no_step(monkeypatch):
    start, table, observations, gates, config = call_of(monkeypatch, validation={"min_observations": 10_000})
    prediction = replace(start.prediction, covariance=-start.prediction.covariance)
    with torch.inference_mode():
        solution, matches, _ = BODY.accelerated(replace(start, prediction=prediction), table, observations, gates, config)
    assert not matches.mask.any()
    assert torch.equal(solution.T_cam_obj, start.begin.T_cam_obj) and not solution.from_prior.any()


def test_a_step_turns_about_the_centre_as_the_solver_does(monkeypatch):
    args = call_of(monkeypatch, association={"gates_px": [12.0]})
    start = replace(args[0], offset=torch.full((1, 12), 2e-2, dtype=torch.float64, device=DEVICE))
    with torch.inference_mode():
        solution, *_ = BODY.accelerated(start, *args[1:])
        step = (solution.from_prior - start.offset)[:, :6]
        turned = retract_about(start.begin.T_cam_obj, step, start.prediction.objects.centre_obj)
    # Cayley's map agrees with the exponential to second order.
    torch.testing.assert_close(solution.T_cam_obj, turned, rtol=0, atol=1e-4)


def test_the_seam_takes_it_for_its_device(monkeypatch):
    """Whole windows are tracked through the seam as by the reference."""
    trajectory, events = moving_box(pose(), 2)
    # Other poses are tried all alike: an interpreter takes its time.
    config = TrackerConfig.model_validate(FEW | {"relocalization": {"new_below": 0}})
    tracker = Tracker([box_model()], SMALL_CAMERA, config, dtype=torch.float64).to(DEVICE)
    state, taken = tracker.init(trajectory.T_cam_obj[:1], 0), []
    accelerated = BODY.accelerated
    monkeypatch.setattr(BODY, "accelerated", lambda *args: taken.append(args) or accelerated(*args))
    given, poses = [(batch.to(DEVICE), end_us) for batch, end_us in windows(events, 2)], []
    for tracker.kernels in (True, False):
        monkeypatch.setattr(dispatch, "_backend_for", lambda values: "cuda")
        with torch.inference_mode():
            poses.append(poses_of(follow(tracker, state, given)[1]))
    assert len(taken) >= 2
    torch.testing.assert_close(*poses, rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ["paper", "line"])
def test_what_kernels_do_not_know_goes_to_the_reference(name, monkeypatch):
    args = call_of(monkeypatch)
    assert BODY.supports(*args) and not BODY.supports(*args[:-1], preset(name))
    assert not BODY.supports(replace(args[0], extra_terms=(object(),)), *args[1:])
    nothing = replace(args[2], **{name: value[:, :0] for name, value in vars(args[2]).items() if value is not None})
    assert not BODY.supports(*args[:2], nothing, *args[3:])


def test_without_a_compiler_for_what_starts_kernels_there_are_none(monkeypatch):
    monkeypatch.setattr(dispatch.shutil, "which", lambda name: None)
    assert not dispatch.backend_is_installed.__wrapped__("cuda")
    monkeypatch.setattr(dispatch.shutil, "which", lambda name: f"/usr/bin/{name}" if name == "gcc" else None)
    assert dispatch.backend_is_installed.__wrapped__("cuda")
    assert not dispatch.backend_is_installed.__wrapped__("mps")


@pytest.mark.parametrize(("version", "is_new_enough"), [("3.4.0", False), ("3.5.0", True), ("3.10.1+git", True)])
def test_an_old_triton_is_none(version, is_new_enough, monkeypatch):
    monkeypatch.setattr(dispatch.importlib.metadata, "version", lambda library: version)
    assert dispatch.backend_is_installed.__wrapped__("cuda") == is_new_enough


def test_a_triton_under_another_name_is_none(monkeypatch):
    def unknown(library):
        raise dispatch.importlib.metadata.PackageNotFoundError(library)

    monkeypatch.setattr(dispatch.importlib.metadata, "version", unknown)
    assert not dispatch.backend_is_installed.__wrapped__("cuda")


COMPILED = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from torchtrack.backends.alignment import DampingSettings, matching_settings
from torchtrack.backends.triton import index, matching, solving
from torchtrack.config.tracker import TrackerConfig

constants = {"settings": matching_settings(TrackerConfig()), "damping": DampingSettings(1e-6, 1e-12, 1e-9), "velocity_in_window": True, "BLOCK": 128}
whole = {name: "i32" for name in ("count", "points", "cell_rows", "cell_columns")} | {name: "*i64" for name in ("nearest_of_cell", "contour")}
flags = {name: "*i1" for name in ("exists", "subcell_lookup", "is_near", "is_matched")}
lengths = {name: "fp32" for name in ("side_px", "aside_px", "gate_px")}
for number in ("fp32", "fp64"):
    for kernel in (matching.match, matching.believe, solving.solve):
        kinds = {name: "constexpr" if name in constants else (whole | flags | lengths).get(name, "*" + number) for name in kernel.arg_names}
        source = ASTSource(kernel, signature=kinds, constexprs={name: constants[name] for name in kinds if name in constants})
        compiled = triton.compile(source, target=GPUTarget("cuda", 80, 32), options={"enable_fp_fusion": True})
        print(kernel.__name__, number, len(compiled.asm["cubin"]), ".local" in compiled.asm["ptx"])
sizes = {"POINTS": 16, "CELLS": 16, "BLOCK": 1024, "NONE": 2**31 - 1}
plain = {"exists": "*i1", "radius_px": "*i64", "keys": "*i32", "middle_u": "fp32", "middle_v": "fp32"}
for kernel in (index.write, index.read):
    kinds = {name: "constexpr" if name in sizes else plain.get(name, "*fp32" if name == "pixels" else "i32") for name in kernel.arg_names}
    source = ASTSource(kernel, signature=kinds, constexprs={name: sizes[name] for name in kinds if name in sizes})
    compiled = triton.compile(source, target=GPUTarget("cuda", 80, 32), options={"enable_fp_fusion": True})
    print(kernel.__name__, "fp32", len(compiled.asm["cubin"]), ".local" in compiled.asm["ptx"])
"""


def test_kernels_compile_for_a_gpu_and_fit_into_its_registers(tmp_path):
    """Without a GPU, too: for one of the Ampere generation."""
    surroundings = os.environ | {"TRITON_INTERPRET": "0", "TRITON_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run([sys.executable, "-c", COMPILED], env=surroundings, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert len(lines) == 8
    assert all(int(size) > 1000 and in_memory == "False" for _, _, size, in_memory in lines)


def test_a_state_that_is_spoilt_stays_its_own(monkeypatch):
    """Through whole windows, an object whose state is not a number leaves its neighbour's digits alone."""
    starts = torch.stack([pose(), pose(translation=(0.02, 0.0, 0.7))])
    _, events = moving_box(pose(), 1)
    tracker = Tracker([box_model()] * 2, SMALL_CAMERA, TrackerConfig.model_validate(FEW), dtype=torch.float64).to(DEVICE)
    state = tracker.init(starts, 0)
    spoilt = changed(state, T_cam_obj=state.T_cam_obj.clone())
    spoilt.T_cam_obj[1] = torch.nan
    monkeypatch.setattr(dispatch, "_backend_for", lambda values: "cuda")
    given = [(batch.to(DEVICE), end_us) for batch, end_us in windows(events, 1)]
    with torch.inference_mode():
        results = [follow(tracker, begin, given)[1] for begin in (state, spoilt)]
    torch.testing.assert_close(poses_of(results[0]), poses_of(results[1]), rtol=0, atol=1e-12)
