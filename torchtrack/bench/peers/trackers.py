"""Whole trackers on one moving object: ours, and OpenCV's ``rapid`` (Harris & Stennett, 1990) on images of the time surface.

Both start from the true pose. ``rapid`` looks for the largest gradient across the mesh's edges; how far each is from the truth
at the end is told beside its time.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from torchtrack.bench.peers.comparison import Comparison, Work
from torchtrack.bench.results import time_result
from torchtrack.bench.scene import Scene, simulated, started
from torchtrack.config.tracker import SurfaceConfig
from torchtrack.sim.meshes import make_mesh
from torchtrack.tracking.frontend.time_surface import Regions, empty_last_event, time_surface, update_last_event

SHAPE = "lbracket"
_WINDOW_US = 5000
# Search lines around the object, how far each reaches (px), and repetitions for every image.
_LINES, _REACH_PX, _ROUNDS = 100, 10, 3


def compare(comparison: Comparison) -> None:
    """Measure both, where the simulator and OpenCV's contributed modules are here."""
    setup, name = comparison.setup, "tracking an object, one window: "
    make = partial(_rapid, SHAPE)
    rapid = comparison.prepare(f"{name}OpenCV rapid", "opencv-contrib-python-headless, in place of opencv-python-headless", make)
    if rapid is None:
        return
    scene = simulated((SHAPE,))
    run = started([scene], setup.device)
    setup.show(f"{name}torchtrack")
    ours = time_result(f"{name}torchtrack", [float(np.median(run.latencies(setup.clock))) for _ in range(setup.repeats)])
    comparison.results.append(ours)
    windows = len(scene.windows(_WINDOW_US))
    whole = setup.clock.seconds(rapid, setup.repeats)
    theirs = time_result(f"{name}OpenCV rapid", [seconds / windows for seconds in whole])
    comparison.results.append(theirs)
    comparison.ahead(theirs, ours)
    comparison.notes += [f"{ours.name}: {run.quality(setup.clock)}", f"{theirs.name}: {_quality(scene, np.asarray(rapid()))}"]


def _rapid(shape: str) -> Work:
    """Poses of every window of the scene."""
    # Only OpenCV's contributed modules have it, and its type stubs do not know.
    contributed: Any = cv2
    refine = contributed.rapid.rapid
    scene, mesh = simulated((shape,)), make_mesh(shape)
    images = list(_images(scene))
    vertices, faces = mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32)
    camera = scene.camera
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], dtype=np.float32)
    T_start = scene.T_cam_obj[0].numpy()

    def track() -> ndarray:
        rotation, translation = cv2.Rodrigues(T_start[:3, :3])[0].astype(np.float32), T_start[:3, 3:].astype(np.float32)
        poses = []
        for image in images:
            for _ in range(_ROUNDS):
                _, rotation, translation, _ = refine(image, _LINES, _REACH_PX, vertices, faces, K, rotation, translation)
            poses.append(np.concatenate([cv2.Rodrigues(rotation)[0], translation], 1))
        return np.stack(poses)

    return track


def _images(scene: Scene) -> Iterator[UInt8[ndarray, "h w"]]:
    """The time surface at every window's end."""
    height, width = scene.camera.height, scene.camera.width
    newest = empty_last_event(1, height, width)
    zeros = torch.zeros(1, 2, dtype=torch.int64)
    whole = Regions(zeros, torch.tensor([[width, height]]), (height, width), zeros[:, 0])
    for events, end_us in scene.windows(_WINDOW_US):
        newest = update_last_event(newest, events)
        surface = time_surface(newest, torch.tensor([end_us]), whole, SurfaceConfig().tau_s, torch.float32)
        yield (255 * surface[0]).byte().numpy()


def _quality(scene: Scene, T_estimated: ndarray) -> str:
    """Median error over all windows, in words."""
    truth = scene.truth[0]
    if truth is None:
        return "its truth is not known"
    true = truth.at(torch.tensor([end_us for _, end_us in scene.windows(_WINDOW_US)])).numpy()
    angle_deg = np.degrees(Rotation.from_matrix(true[:, :3, :3].swapaxes(1, 2) @ T_estimated[:, :, :3]).magnitude())
    way_mm = 1e3 * np.linalg.norm(true[:, :3, 3] - T_estimated[:, :, 3], axis=-1)
    return f"median error {np.median(angle_deg):.2f}° and {np.median(way_mm):.2f} mm (images are made beforehand)"
