"""Simulator: an event camera that looks at known rigid objects, with exact truth (extra ``sim``).

A sequence in one go::

    python -c "
    from torchtrack.sim import ObjectConfig, SceneConfig, simulate, write
    config = SceneConfig(name='hello', objects=(ObjectConfig(label='cube', shape='cube'),), duration_s=0.5)
    sequence = simulate(config, progress=print)
    print(len(sequence.events), 'events,', write(sequence, 'hello.npz'))
    "

========================= ============================================================================
``trajectory.py``         smooth motions, known at any time
``textures.py meshes.py`` procedural objects
``surface.py render.py``  images; ``rasterizer.py shading.py`` hold the numba kernels
``event_camera.py``       images -> events
``frames.py``             when to render, so that nothing moves more than half a pixel
``scenes.py``             settings of a scene
``simulation.py``         ``simulate`` and ``write``
========================= ============================================================================
"""

from torchtrack.sim.event_camera import EventCamera
from torchtrack.sim.scenes import BackgroundConfig, CameraConfig, ObjectConfig, SceneConfig
from torchtrack.sim.sensor_profiles import EventCameraConfig
from torchtrack.sim.simulation import SimulatedSequence, simulate, write
from torchtrack.sim.trajectory import MotionConfig, SinusoidMotion, ground_truth

__all__ = [
    "BackgroundConfig",
    "CameraConfig",
    "EventCamera",
    "EventCameraConfig",
    "MotionConfig",
    "ObjectConfig",
    "SceneConfig",
    "SimulatedSequence",
    "SinusoidMotion",
    "ground_truth",
    "simulate",
    "write",
]
