"""Simulated sequences against their truth: events lie on contours, labels say who caused them, velocities carry poses on."""

import numpy as np
import pytest
import torch
import trimesh

from torchtrack.core.camera import distort
from torchtrack.core.events import concatenate
from torchtrack.core.lie import se3_exp
from torchtrack.io.container import read_source
from torchtrack.io.sequence import read_sequence
from torchtrack.sim import BackgroundConfig, CameraConfig, MotionConfig, ObjectConfig, SceneConfig, simulate, write
from torchtrack.sim.scenes import LightConfig
from torchtrack.sim.simulation import BACKGROUND, NOISE, render_frames

SMALL = {"width": 160, "height": 120, "fx": 150.0, "fy": 150.0}
RADIUS_M = 0.05


@pytest.fixture(autouse=True)
def needs_numba():
    pytest.importorskip("numba", reason="the rasteriser needs numba: pip install 'torchtrack[sim]'")


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A file of a user's own: a ball in millimetres, with colours at its vertices."""
    mesh = trimesh.creation.icosphere(4, 1000 * RADIUS_M)
    mesh.visual.vertex_colors = np.tile([150, 150, 150, 255], (len(mesh.vertices), 1))
    path = tmp_path_factory.mktemp("models") / "ball.ply"
    mesh.export(path)
    return path


def ball_scene(ball, **changes):
    motion = MotionConfig(position_m=(0, 0, 0.4), frequency_hz=2.0)
    item = ObjectConfig(label="ball", mesh=ball, unit="mm", gloss=0, motion=motion)
    return SceneConfig(
        **{"objects": (item,), "camera": CameraConfig(**SMALL), "duration_s": 0.25, "noise": "ideal", "render": {"ambient": 1.0, "diffuse": 0.0}}
        | changes
    )


def outline_of_ball(centre_m, camera, count=720):
    """Pixels where the outline of a ball is seen, by the tangent cone; exact."""
    distance = centre_m.norm()
    axis = centre_m / distance
    side = torch.linalg.cross(axis, torch.tensor([1.0, 0.3, 0.0], dtype=torch.float64))
    side = side / side.norm()
    other = torch.linalg.cross(axis, side)
    angle = torch.linspace(0, 2 * torch.pi, count, dtype=torch.float64)[:, None]
    share = RADIUS_M / distance
    ring = centre_m - axis * RADIUS_M * share + RADIUS_M * (1 - share**2).sqrt() * (angle.cos() * side + angle.sin() * other)
    ideal = ring[:, :2] / ring[:, 2:] * torch.tensor([camera.fx, camera.fy]) + torch.tensor([camera.cx, camera.cy])
    return distort(ideal.numpy(), camera)


def around_the_middle(sequence, chosen):
    """Of chosen events, from the middle of the ball's outline (px): their pixels and the points of the outline nearest to them; and its motion."""
    events, truth = sequence.events, sequence.trajectories[0]
    t_us, pixels = events.t_us[chosen], torch.stack([events.x, events.y], -1)[chosen].numpy()
    centres = truth.at(t_us)[:, :3, 3]
    outlines = np.stack([outline_of_ball(centre, sequence.camera) for centre in centres])
    middle = outlines.mean(1)
    nearest = outlines[np.arange(len(chosen)), np.linalg.norm(outlines - pixels[:, None], axis=2).argmin(1)]
    return pixels - middle, nearest - middle, (centres - truth.at(t_us - 2000)[:, :3, 3])[:, :2].numpy()


LENS = {"distortion_model": "plumb_bob", "distortion": (-0.3, 0.1, 0.001, -0.0005)}


FISHEYE = {"distortion_model": "fisheye", "distortion": (0.05, -0.01, 0.002, -0.0005)}


@pytest.mark.parametrize("lens", [{}, LENS, FISHEYE], ids=["pinhole", "plumb bob", "fisheye"])
@pytest.mark.parametrize("background", [{"luminance": 0.05}, {"luminance": 0.9}], ids=["before dark", "before bright"])
def test_events_of_a_curved_object_lie_on_its_outline(ball, lens, background):
    sequence = simulate(ball_scene(ball, camera=CameraConfig(**SMALL, **lens), background=BackgroundConfig(**background)))
    events = sequence.events
    assert len(events) > 2000
    seen, nearest, _ = around_the_middle(sequence, torch.linspace(0, len(events) - 1, 300).long())
    assert np.mean(np.linalg.norm(seen - nearest, axis=1) <= 1) >= 0.95
    assert float((sequence.source == 0).double().mean()) > 0.995


@pytest.mark.parametrize(("luminance", "outside_is_dark"), [(0.05, True), (0.9, False)], ids=["before dark", "before bright"])
def test_events_of_a_lit_limb_lie_to_its_dark_side(ball, luminance, outside_is_dark):
    """Whatever the motion: what the component ``silhouette_dark_shift`` takes back."""
    sequence = simulate(ball_scene(ball, background=BackgroundConfig(luminance=luminance), render={}))
    seen, nearest, moved = around_the_middle(sequence, torch.linspace(0, len(sequence.events) - 1, 600).long())
    distance, leads = np.linalg.norm(seen, axis=1) - np.linalg.norm(nearest, axis=1), (moved * nearest).sum(1) > 0
    near = np.abs(distance) < 1.5
    # Both sides count alike: what leads and what trails lag the same way.
    shift = np.mean([distance[near & side].mean() for side in (leads, ~leads)])
    assert 0.03 < (shift if outside_is_dark else -shift) < 0.25


def test_events_of_a_print_lie_on_edges_of_the_image():
    """Where the true image has a steep edge, at the time of the event."""
    item = ObjectConfig(label="card", shape="planar", motion=MotionConfig(position_m=(0, 0, 0.45)))
    config = SceneConfig(objects=(item,), camera=CameraConfig(width=240, height=180, fx=220, fy=220), duration_s=0.1, noise="ideal")
    events = simulate(config).events
    chosen = torch.linspace(0, len(events) - 1, 60).long()
    near = []
    for frame, x, y in zip(render_frames(config, events.t_us[chosen].numpy()), events.x[chosen].tolist(), events.y[chosen].tolist(), strict=True):
        level = np.log(frame.luminance[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3] + 0.005)
        near.append(level.max() - level.min() > 0.2)
    assert np.mean(near) >= 0.95


def test_labels_say_who_caused_an_event(ball):
    bar = ObjectConfig(label="bar", shape="bar", scale=0.6, motion=MotionConfig(position_m=(0, 0, 0.25), frequency_hz=2.0))
    background = BackgroundConfig(kind="messy", pan_px_s=(100, 0))
    config = ball_scene(ball, occluders=(bar,), background=background, noise="default", duration_s=0.08)
    sequence = simulate(config)
    assert sequence.labels == ("ball",)
    assert sequence.occluder_labels == ("bar",)
    counts = {number: int((sequence.source == number).sum()) for number in (0, 1, BACKGROUND, NOISE)}
    assert sum(counts.values()) == len(sequence.events)
    assert min(counts[number] for number in (0, 1, BACKGROUND)) > 300
    # Shot noise between that of white and that of black; leak counts as noise only where nothing moves.
    assert 0.25 * 0.2 < counts[NOISE] / (160 * 120 * 0.08) < 0.1 + 0.2
    (last,) = render_frames(config, np.array([80_000]))
    late = sequence.events.t_us > 75_000
    for number in (0, 1, BACKGROUND):
        x, y = (getattr(sequence.events, name)[late & (sequence.source == number)].numpy() for name in ("x", "y"))
        near = [(last.object_index[max(row - 4, 0) : row + 5, max(col - 4, 0) : col + 5] == number).any() for row, col in zip(y, x, strict=True)]
        assert np.mean(near) > 0.97


def test_truth_is_written_with_the_sequence(ball, tmp_path):
    bar = ObjectConfig(label="bar", shape="bar", motion=MotionConfig(position_m=(0, 0, 0.25)))
    sequence = simulate(ball_scene(ball, occluders=(bar,), name="truth", duration_s=0.05))
    path = write(sequence, tmp_path / "truth.npz")
    with np.load(path) as arrays:
        velocity, poses, source = arrays["velocity"], arrays["occluder_poses"], arrays["source"]
        assert arrays["occluder_labels"].tolist() == ["bar"]
    assert poses.shape == (51, 4, 4)
    assert len(source) == len(sequence.events)
    truth = read_sequence(path).objects[0].ground_truth
    ahead = se3_exp(1e-3 * torch.from_numpy(velocity[0, 20:22].mean(0))) @ truth.T_cam_obj[20]
    assert torch.allclose(ahead, truth.T_cam_obj[21], atol=1e-6)
    mesh = trimesh.load_mesh(tmp_path / "truth_ball.ply")
    assert mesh.extents == pytest.approx([2 * RADIUS_M] * 3, rel=0.01)
    assert mesh.visual.vertex_colors[0].tolist() == [150, 150, 150, 255]


def test_a_textured_file_looks_like_its_shape(tmp_path):
    from torchtrack.sim.meshes import make_mesh

    make_mesh("cube").export(tmp_path / "cube.glb")
    motion = MotionConfig(position_m=(0, 0, 0.4), rotation_deg=(30, 35, 10))
    frames = []
    for item in (ObjectConfig(label="cube", shape="cube", motion=motion), ObjectConfig(label="cube", mesh=tmp_path / "cube.glb", motion=motion)):
        frames += list(render_frames(SceneConfig(objects=(item,), camera=CameraConfig(**SMALL)), np.array([0])))
    assert np.abs(frames[0].luminance - frames[1].luminance).max() < 0.02


def test_parts_of_a_file_keep_their_textures(tmp_path):
    from torchtrack.sim.meshes import make_mesh

    book = make_mesh("book")
    book.apply_translation([0.2, 0, 0])
    trimesh.Scene([make_mesh("cube"), book]).export(tmp_path / "both.glb")
    still = {"translation_amplitude_m": (0, 0, 0), "rotation_amplitude_deg": (0, 0, 0)}
    left, right = (MotionConfig(position_m=(x, 0, 0.9), **still) for x in (-0.1, 0.1))
    apart = (ObjectConfig(label="cube", shape="cube", motion=left), ObjectConfig(label="book", shape="book", motion=right))
    joined = (ObjectConfig(label="both", mesh=tmp_path / "both.glb", motion=left),)
    scenes = [SceneConfig(objects=objects, camera=CameraConfig(**SMALL), duration_s=0.01) for objects in (apart, joined)]
    frames = [next(render_frames(scene, np.array([0]))) for scene in scenes]
    assert np.abs(frames[0].luminance - frames[1].luminance).max() < 0.02
    write(simulate(scenes[1]), tmp_path / "joined.npz")
    written = trimesh.load_scene(tmp_path / "joined_both_textured.glb")
    assert len(written.geometry) == 2


def test_flicker_makes_events_everywhere(ball):
    light = LightConfig(flicker_hz=100, flicker_depth=0.3)
    events = simulate(ball_scene(ball, speed=0.0, light=light, duration_s=0.03)).events
    # From its mean light goes up by ln 1.3 and down by ln 0.7, one threshold each: two events up and two down, three times.
    per_pixel = torch.bincount(events.y * 160 + events.x, minlength=160 * 120).double()
    assert float(per_pixel.median()) == pytest.approx(2 * 3 * 2, abs=1)
    assert float((per_pixel > 0).double().mean()) > 0.99


def test_a_sequence_fits_into_one_file(tmp_path):
    item = ObjectConfig(label="cube", shape="cube", motion=MotionConfig(position_m=(0, 0, 0.4)))
    sequence = simulate(SceneConfig(name="one", objects=(item,), camera=CameraConfig(**SMALL), duration_s=0.03))
    path = write(sequence, tmp_path / "one.h5")
    assert [file.name for file in tmp_path.iterdir()] == ["one.h5"]
    read = read_sequence(path)
    assert read.meta == sequence.meta
    assert read.extra["velocity"].shape == (1, 31, 6)
    (of_cube,) = read.objects
    assert of_cube.label == "cube"
    assert torch.equal(of_cube.ground_truth.T_cam_obj, sequence.trajectories[0].T_cam_obj)
    assert trimesh.load_mesh(of_cube.mesh_path).is_watertight
    assert of_cube.textured_path is not None
    events = concatenate(list(read.events.chunks()))
    assert torch.equal(events.t_us, sequence.events.t_us)
    assert np.array_equal(np.concatenate(list(read_source(path, 1000))), sequence.source.numpy())


def test_a_container_that_breaks_off_leaves_nothing(tmp_path, monkeypatch):
    item = ObjectConfig(label="bar", shape="bar", motion=MotionConfig(position_m=(0, 0, 0.4)))
    sequence = simulate(SceneConfig(objects=(item,), camera=CameraConfig(**SMALL), duration_s=0.01))

    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("torchtrack.sim.output.ContainerWriter.annotate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(sequence, tmp_path / "one.h5")
    assert not list(tmp_path.iterdir())
