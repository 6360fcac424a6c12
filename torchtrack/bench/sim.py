"""How fast the simulator is: images per second of the renderers, and of the event camera, on one core.

A sensor of 640x480, one object of 10k faces that fills about a quarter of its height, 3x3 samples per pixel. It moves by half
a pixel from image to image, as in a scene. What counts is the processor's time.
"""

import time
from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float
from numpy import ndarray

from torchtrack.bench.results import Report, Result
from torchtrack.bench.setup import Setup
from torchtrack.core.camera import Camera
from torchtrack.errors import MissingExtraError
from torchtrack.sim.drawing import merge_regions
from torchtrack.sim.event_camera import EventCamera
from torchtrack.sim.meshes import make_mesh
from torchtrack.sim.render import Frame, RenderConfig, Renderer, plain_background
from torchtrack.sim.sensor_profiles import EVENT_CAMERA_PROFILES
from torchtrack.sim.surface import RenderObject
from torchtrack.sim.trajectory import pose_matrix

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
FRAMES_PER_S = 100.0
_FRAMES = 60
_SHAPE = "torus_knot"


def measure(setup: Setup) -> Report:
    """Images per second of what is installed here."""
    results = (*_rendering(setup.repeats, setup.show), *_sensing(setup.repeats, setup.show))
    return Report("sim", "Simulating, 640x480, an object of 10k faces, one core", results)


def _rendering(repeats: int, on_part: Callable[[str], None]) -> Iterator[Result]:
    for backend, target in (("rasterizer", FRAMES_PER_S), ("opengl", None)):
        on_part(f"rendering, {backend}")
        try:
            renderer = _renderer(backend)
        except MissingExtraError:
            continue
        figures = [_rate(_render(renderer)) for _ in range(repeats + 1)]
        yield Result(f"rendering, {backend}", "images/s", tuple(figures[1:]), target)


def _sensing(repeats: int, on_part: Callable[[str], None]) -> Iterator[Result]:
    frames = list(_render(_renderer("rasterizer")))
    for profile in ("default", "realistic"):
        on_part(f"events, {profile}")
        figures = [_rate(_events(frames, profile)) for _ in range(repeats + 1)]
        yield Result(f"events, {profile}", "images/s", tuple(figures[1:]), FRAMES_PER_S)


def _renderer(backend: str) -> Renderer:
    config = RenderConfig.model_validate({"backend": backend, "supersampling": 3})
    return Renderer([RenderObject.from_mesh(make_mesh(_SHAPE))], CAMERA, plain_background(CAMERA.width, CAMERA.height, 0.1), config)


def _rate(work: Iterator[object]) -> float:
    """Items per second of processor time."""
    begun, count = time.process_time(), sum(1 for _ in work)
    return count / (time.process_time() - begun)


def _poses() -> Iterator[Float[ndarray, "1 4 4"]]:
    for number in range(_FRAMES):
        # Half a pixel at half a metre, and a slow turn.
        yield pose_matrix((-0.05 + 0.5 * number * 0.55 / 600, 0.0, 0.55), (20.0, 30.0 + 0.1 * number, 10.0)).numpy()[None]


def _render(renderer: Renderer) -> Iterator[Frame]:
    for pose in _poses():
        yield renderer.render(pose)


def _events(frames: list[Frame], profile: str) -> Iterator[object]:
    camera = EventCamera(EVENT_CAMERA_PROFILES[profile], 640, 480)
    state = camera.start(torch.from_numpy(frames[0].luminance))
    for number in range(1, len(frames)):
        changed = [region.slices for region in merge_regions([*frames[number - 1].regions, *frames[number].regions])]
        state, events = camera.step(state, torch.from_numpy(frames[number].luminance), 800 * number, changed)
        yield events
