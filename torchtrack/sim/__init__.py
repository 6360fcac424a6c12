"""Simulator: an event camera that looks at known rigid objects, with exact truth (extra ``sim``).

A sequence in one go::

    python -c "
    from torchtrack.sim import ObjectConfig, SceneConfig, simulate, write
    config = SceneConfig(name='hello', objects=(ObjectConfig(label='cube', shape='cube'),), duration_s=0.5)
    sequence = simulate(config, progress=print)
    print(len(sequence.events), 'events,', write(sequence, 'hello.npz'))
    "

=============================== ============================================================================
``scenes.py background.py``     settings of a scene
``trajectory.py world.py``      smooth motions, and where everything is at any time
``meshes.py curved.py``         procedural objects; ``implicit.py`` surfaces of distance fields, ``textures.py`` prints
``surface.py render.py``        images, by what draws: ``raster_drawer.py`` (numba; kernels in ``rasterizer.py shading.py``)
                                or ``opengl_drawer.py``, both behind ``drawing.py``
``backdrop.py lens.py``         what is behind the objects, and a lens that distorts
``event_camera.py``             images -> events; ``photoreceptor.py noise.py fired.py`` are its parts,
                                ``sensor_profiles.py`` its parameters
``frames.py``                   when to render, so that nothing moves more than half a pixel
``simulation.py output.py``     ``simulate`` and ``write``
``suite.py``                    many scenes in parallel
``video.py``                    events of a given video
``preview.py``                  a video of a sequence
=============================== ============================================================================
"""

from torchtrack.sim.event_camera import EventCamera
from torchtrack.sim.output import write
from torchtrack.sim.scenes import BackgroundConfig, CameraConfig, ObjectConfig, SceneConfig
from torchtrack.sim.sensor_profiles import EventCameraConfig
from torchtrack.sim.simulation import SimulatedSequence, simulate
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
