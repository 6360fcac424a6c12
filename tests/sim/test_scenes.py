from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from pydantic import ValidationError

from torchtrack.config.load import load, read_yaml
from torchtrack.core.camera import project
from torchtrack.core.lie import transform_points
from torchtrack.errors import ConfigError, EventDataError, MissingFileError, ModelError, UnknownFormatError
from torchtrack.io.sequence import read_sequence
from torchtrack.object_model import ObjectModel
from torchtrack.sim import BackgroundConfig, CameraConfig, MotionConfig, ObjectConfig, SceneConfig, simulate, write
from torchtrack.sim.meshes import make_mesh
from torchtrack.sim.sensor_profiles import EVENT_CAMERA_PROFILES, EventCameraConfig
from torchtrack.sim.simulation import render_frames
from torchtrack.sim.suite import scenes_of
from torchtrack.sim.world import make_world

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "simulate"
SMALL = CameraConfig(width=120, height=90, fx=130.0, fy=130.0)
SWING = MotionConfig(position_m=(0.0, 0.0, 0.4), rotation_deg=(30.0, 35.0, 10.0))


def scene(shape="lbracket", **changes):
    item = ObjectConfig(label=shape, shape=shape, motion=SWING)
    return SceneConfig(**{"objects": (item,), "camera": SMALL, "duration_s": 0.2, "noise": "ideal", "seed": 2, **changes})


def needs_numba():
    pytest.importorskip("numba", reason="the rasteriser needs numba: pip install 'torchtrack[sim]'")


@pytest.fixture(scope="module")
def cube():
    """A cube with its print on, without noise."""
    needs_numba()
    return simulate(scene("cube"))


def distance_to_edges_px(config, events):
    """Distance of each event from the nearest edge of the one convex object, at the true pose of the event's time."""
    mesh = make_mesh(config.objects[0].shape)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    T = make_world(config).objects[0].pose(events.t_us.double() * 1e-6)
    camera = config.camera.build()
    centres = transform_points(T, torch.from_numpy(np.array(mesh.triangles_center)).expand(len(T), -1, -1))
    normals = torch.from_numpy(np.array(mesh.face_normals)) @ T[:, :3, :3].mT
    in_front = (centres * normals).sum(-1) < 0
    creases = mesh.face_adjacency_angles > 0.1
    edges, faces = mesh.face_adjacency_edges[creases], mesh.face_adjacency[creases]
    visible = in_front[:, faces].any(-1)
    vertices = transform_points(T, torch.from_numpy(np.array(mesh.vertices)).expand(len(T), -1, -1))
    pixels = project(vertices, camera.intrinsics(torch.float64).expand(len(T), -1))
    start, end = pixels[:, edges[:, 0]], pixels[:, edges[:, 1]]
    point = torch.stack([events.x, events.y], -1).double()[:, None]
    along = (((point - start) * (end - start)).sum(-1) / (end - start).square().sum(-1)).clamp(0, 1)
    distance = (start + along[..., None] * (end - start) - point).norm(dim=-1)
    return torch.where(visible, distance, torch.inf).amin(-1)


@pytest.mark.parametrize("render", [{}, {"ambient": 1.0, "diffuse": 0.0}], ids=["lit", "even light"])
def test_events_lie_on_the_projected_edges(render):
    needs_numba()
    config = scene(render=render, duration_s=0.3)
    events = simulate(config).events
    assert len(events) > 3000
    distance = distance_to_edges_px(config, events)
    assert float((distance <= 1).double().mean()) >= 0.95
    assert float(distance.median()) < 0.4


def test_every_visible_part_of_a_moving_outline_fires():
    """Pixels on the outline when the scene starts have fired by the time it has moved on."""
    needs_numba()
    config = scene(render={"ambient": 1.0, "diffuse": 0.0}, duration_s=0.1)
    first, last = render_frames(config, np.array([0, 100_000]))
    changed = np.abs(np.log(last.luminance / first.luminance)) > 0.5
    events = simulate(config).events
    fired = np.zeros_like(changed)
    fired[events.y, events.x] = True
    assert changed.sum() > 50
    assert fired[changed].all()
    grew_brighter = last.luminance > first.luminance
    balance = np.zeros(changed.shape)
    np.add.at(balance, (events.y.numpy(), events.x.numpy()), np.where(events.polarity, 1, -1))
    assert ((balance > 0) == grew_brighter)[changed].all()


def test_a_scene_at_rest_is_silent_but_for_noise():
    needs_numba()
    assert len(simulate(scene(speed=0.0)).events) == 0
    noisy = simulate(scene(speed=0.0, noise="default", duration_s=0.5))
    rate = EVENT_CAMERA_PROFILES["default"].leak_rate_hz + EVENT_CAMERA_PROFILES["default"].shot_noise_rate_hz
    assert 0.7 * rate < len(noisy.events) / (120 * 90 * 0.5) < 1.1 * rate


def test_same_settings_same_sequence_and_another_seed_another():
    needs_numba()
    first, again, other = (simulate(scene(duration_s=0.05, noise="default", seed=seed)) for seed in (1, 1, 2))
    for name in ("x", "y", "t_us", "polarity"):
        assert torch.equal(getattr(first.events, name), getattr(again.events, name))
    assert not torch.equal(first.trajectories[0].T_cam_obj, other.trajectories[0].T_cam_obj)


def test_faster_scenes_get_more_frames(cube):
    fast = simulate(scene("cube", speed=3.0))
    assert fast.meta["frames"] > 2 * cube.meta["frames"]
    assert max(fast.meta["worst_px"], cube.meta["worst_px"]) <= 0.5
    assert len(fast.events) > 2 * len(cube.events)


def test_a_simulated_sequence_is_complete(cube):
    assert cube.labels == ("cube",)
    assert cube.trajectories[0].t_us.tolist() == list(range(0, 200_001, 1000))
    assert cube.camera == SMALL.build()
    assert cube.meta["labels"] == ["cube"]
    assert cube.meta["event_camera"]["threshold_on"] == 0.2
    assert SceneConfig.model_validate(cube.meta["scene"]) == scene("cube")
    assert bool((torch.diff(cube.events.t_us) >= 0).all())
    assert int(cube.events.t_us.max()) <= 200_000


def test_progress_is_told():
    needs_numba()
    shares = []
    simulate(scene(duration_s=0.05), progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len(shares) > 5


def test_two_objects_hide_each_other():
    needs_numba()
    near = MotionConfig(position_m=(0.0, 0.0, 0.35))
    objects = (ObjectConfig(label="far", shape="book", motion=SWING), ObjectConfig(label="near", shape="lbracket", scale=0.5, motion=near))
    (frame,) = render_frames(scene(objects=objects), np.array([0]))
    assert set(np.unique(frame.object_index)) == {-1, 0, 1}
    assert len(frame.regions) == 1
    assert frame.object_index[45, 60] == 1


def test_written_sequences_are_read_back(cube, tmp_path):
    plain = simulate(scene(duration_s=0.05, name="plain"))
    for simulated in (cube, plain):
        path = write(simulated, tmp_path / f"{simulated.name}.npz")
        sequence = read_sequence(path)
        (item,) = sequence.objects
        assert sequence.camera == simulated.camera
        assert torch.equal(item.ground_truth.T_cam_obj, simulated.trajectories[0].T_cam_obj)
        events = list(sequence.events.chunks())
        assert sum(len(batch) for batch in events) == len(simulated.events)
        assert torch.equal(events[0].t_us, simulated.events.t_us[: len(events[0])])
        assert (item.textured_path is not None) == (simulated is cube)
        assert sequence.meta["name"] == simulated.name
    with pytest.raises(EventDataError, match="npz"):
        write(cube, tmp_path / "cube.zip")


def test_written_geometry_has_each_vertex_once(cube, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    write(cube, tmp_path / "scene.npz")
    geometry, textured = trimesh.load_mesh(tmp_path / "scene_cube.ply"), trimesh.load_scene(tmp_path / "scene_cube_textured.glb")
    assert len(geometry.vertices) == 8
    assert geometry.is_watertight
    assert geometry.bounds == pytest.approx(textured.bounds, abs=1e-6)
    (part,) = textured.geometry.values()
    drawn, made = np.asarray(part.visual.material.baseColorTexture), np.asarray(make_mesh("cube").visual.material.baseColorTexture)
    assert np.array_equal(drawn[..., :3], made)


# Lists of scenes hold no scene of their own.
TRIAL = CONFIGS / "trial.yaml"
SHIPPED = [path for path in sorted(CONFIGS.rglob("*.yaml")) if "scenes" not in read_yaml(path) and path.parent.name != "trial"]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_scenes_stay_in_view_and_apart(path):
    for config in scenes_of(path):
        assert config.name.startswith((path.stem, f"{path.parent.name}_{path.stem}"))
        world, boxes = make_world(config), []
        t_s = torch.arange(0, config.duration_s, 0.02, dtype=torch.float64)
        for number in range(len(config.objects)):
            points = transform_points(world.object_poses(number, t_s), world.points[number].expand(len(t_s), -1, -1))
            pixels = project(points, world.camera.intrinsics(torch.float64).expand(len(t_s), -1))
            low, high = pixels.amin(1), pixels.amax(1)
            assert float(low.min()) > 5
            assert bool((high < torch.tensor([world.camera.width - 6.0, world.camera.height - 6.0])).all())
            boxes.append((low, high))
        # Objects that are to cross do come together.
        for i, (low, high) in enumerate(boxes if path.stem != "crossing" else []):
            for other_low, other_high in boxes[:i]:
                apart = ((low > other_high) | (other_low > high)).any(-1)
                assert float(apart.double().mean()) > 0.9


@pytest.fixture(scope="module")
def boxes_of_trial():
    """Of each scene of the trial: its config, and the corners of every object's box in the image over time, ``[objects, times, 2]``."""
    boxes = []
    for config in scenes_of(TRIAL):
        world, corners = make_world(config), []
        t_s = torch.arange(0, config.duration_s, 0.02, dtype=torch.float64)
        for number in range(len(config.objects)):
            points = transform_points(world.object_poses(number, t_s), world.points[number].expand(len(t_s), -1, -1))
            pixels = project(points, world.camera.intrinsics(torch.float64).expand(len(t_s), -1))
            corners.append(torch.stack([pixels.amin(1), pixels.amax(1)]))
        boxes.append((config, *torch.stack(corners, 1)))
    return boxes


def test_the_trial_has_many_objects_in_many_scenes_of_each_kind(boxes_of_trial):
    kinds = [config.name.split("_")[0] for config, _, _ in boxes_of_trial]
    assert sum(len(config.objects) for config, _, _ in boxes_of_trial) >= 60
    assert len(set(kinds)) == 13 and all(kinds.count(kind) >= 2 for kind in kinds)
    assert len({config.seed for config, _, _ in boxes_of_trial}) == len(boxes_of_trial)


def test_scenes_of_the_trial_are_of_their_kind(boxes_of_trial):
    for config, low, high in boxes_of_trial:
        kind, sensor = config.name.split("_")[0], torch.tensor([config.camera.width, config.camera.height])
        middle_inside = ((low + high > 0) & (low + high < 2 * sensor)).all(-1)
        overlap = ~((low[0] > high[-1]) | (low[-1] > high[0])).any(-1)
        if kind == "leaving":
            assert bool(middle_inside[:, [0, -1]].all() and not middle_inside.all()), config.name
        else:
            assert bool(middle_inside.all()), config.name
        if kind in ("crossing", "twins"):
            assert bool(overlap.any()), config.name
        if kind in ("far", "small"):
            assert float((high - low).mean()) < 60, config.name
        assert len({item.shape for item in config.objects}) == (1 if kind == "twins" else len(config.objects))
        assert (len(config.occluders) > 0) == (kind in ("hidden", "held"))


def test_the_suite_of_the_paper_has_all_its_sequences():
    names = [scene.name for scene in scenes_of(CONFIGS / "paper.yaml")]
    straight = [f"{number:02d}_{speed}" for number in range(1, 7) for speed in ("slow", "normal", "fast")]
    curved = [f"{number:02d}_{kind}" for number in range(7, 13) for kind in ("original", "messy", "occlusion")]
    assert names == straight + curved + [str(number) for number in range(13, 18)]


@pytest.mark.parametrize("number", range(7, 13))
def test_occluders_of_the_paper_hide_much_of_the_object_but_not_at_first(number):
    needs_numba()
    (config,) = scenes_of(CONFIGS / "paper" / f"{number:02d}.yaml", {"variant": "occlusion", "render.supersampling": 1, "render.lens_blur_px": 0.0})
    alone = config.model_copy(update={"occluders": ()})
    t_us = np.linspace(0, 2_000_000, 7).astype(np.int64)
    share = [
        (hidden.object_index == 0).sum() / (whole.object_index == 0).sum()
        for hidden, whole in zip(render_frames(config, t_us), render_frames(alone, t_us), strict=True)
    ]
    assert share[0] > 0.99
    assert min(share) < 0.7


def test_settings_are_checked(tmp_path):
    with pytest.raises(ValidationError, match="labels must differ"):
        scene(objects=(ObjectConfig(label="a", shape="cube"), ObjectConfig(label="a", shape="book")))
    with pytest.raises(ValidationError, match="objects"):
        scene(objects=())
    for changes in ({"duration_s": 0}, {"speed": -1}, {"max_motion_px": 0}, {"noise": "none"}, {"colour": "red"}):
        with pytest.raises(ValidationError, match=next(iter(changes))):
            scene(**changes)
    file = tmp_path / "scene.yaml"
    file.write_text("objects: [{label: a, shape: teapot}]\ncamera: {widht: 640}\n")
    with pytest.raises(ConfigError) as error:
        load(SceneConfig, file)
    assert "shape" in str(error.value)
    assert "widht" in str(error.value)


@pytest.mark.parametrize("values", [{}, {"shape": "cube", "mesh": "cube.ply"}])
def test_an_object_has_one_model(values):
    with pytest.raises(ValidationError, match="either shape or mesh"):
        ObjectConfig(label="a", **values)


def test_meshes_that_cannot_be_drawn_are_errors(tmp_path):
    with pytest.raises(MissingFileError, match=r"nowhere\.ply"):
        ObjectConfig(label="a", mesh=tmp_path / "nowhere.ply").build()
    make_mesh("cube").export(tmp_path / "cube.ply")
    with pytest.raises(ModelError, match="unit"):
        ObjectConfig(label="a", mesh=tmp_path / "cube.ply", unit="mm").build()
    (part,) = ObjectConfig(label="a", mesh=tmp_path / "cube.ply", scale=2.0).build()
    assert part.extents == pytest.approx([0.24] * 3)


def test_unit_scale_and_centre_place_a_mesh_as_they_do_for_a_tracker(tmp_path):
    make_mesh("cube").apply_translation((1.0, 2.0, 3.0)).export(tmp_path / "cube.ply")
    placed = {"unit": "inch", "scale": 30.0, "centre": True}
    (part,) = ObjectConfig(label="a", mesh=tmp_path / "cube.ply", **placed).build()
    assert part.extents == pytest.approx([0.12 * 30 * 0.0254] * 3)
    assert part.bounds.mean(0) == pytest.approx([0, 0, 0], abs=1e-9)
    model = ObjectModel.from_file(tmp_path / "cube.ply", **placed)
    assert (2 * model.half_extent).tolist() == pytest.approx(part.extents, rel=1e-5)
    with pytest.raises(ValidationError, match="built-in object is enlarged by"):
        ObjectConfig(label="a", shape="cube", scale=30.0)


def test_event_camera_parameters_can_replace_the_profile():
    assert scene().event_camera_config == EVENT_CAMERA_PROFILES["ideal"]
    own = EventCameraConfig(threshold_on=0.4)
    assert scene(event_camera=own).event_camera_config == own


def test_background_image_is_linear_in_light(tmp_path):
    image = np.zeros((20, 40, 3), dtype=np.uint8)
    image[:, 20:] = 188
    cv2.imwrite(str(tmp_path / "wall.png"), image)
    built = BackgroundConfig(image=tmp_path / "wall.png").picture(80, 40)
    assert built.shape == (40, 80)
    assert built[20, 10] == 0
    assert built[20, 70] == pytest.approx(0.503, abs=0.002)
    assert BackgroundConfig(luminance=0.3).picture(8, 9).mean() == pytest.approx(0.3)
    with pytest.raises(MissingFileError, match=r"nowhere\.png"):
        BackgroundConfig(image=tmp_path / "nowhere.png").picture(8, 8)
    (tmp_path / "text.png").write_text("not an image")
    with pytest.raises(UnknownFormatError, match="cannot be read as an image"):
        BackgroundConfig(image=tmp_path / "text.png").picture(8, 8)


def test_camera_is_centred_unless_told_otherwise():
    assert (SMALL.build().cx, SMALL.build().cy) == (59.5, 44.5)
    assert CameraConfig(cx=300.0).build().cx == 300.0


def test_camera_can_come_from_a_calibration_file(tmp_path):
    (tmp_path / "calib.txt").write_text("199.1 198.8 132.2 110.7 -0.368 0.151 -0.0003 -0.0008 0.0\n")
    (tmp_path / "scene.yaml").write_text("objects: [{label: a, shape: cube}]\ncamera: {calibration: calib.txt, width: 240, height: 180}\n")
    camera = load(SceneConfig, tmp_path / "scene.yaml").camera.build()
    assert (camera.fx, camera.cy, camera.width, camera.height) == (199.1, 110.7, 240, 180)
    assert camera.distortion_model == "plumb_bob"
    world = make_world(load(SceneConfig, tmp_path / "scene.yaml"))
    # The ideal image is larger: barrel distortion pulls what is outside of it in.
    assert world.ideal.width > 240
    assert world.ideal.distortion_model == "none"
    assert world.still_background().shape == (world.ideal.height, world.ideal.width)
