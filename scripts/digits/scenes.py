"""The scenes whose poses are compared: what is in them, how it moves, and its files in a folder."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import trimesh
from event_images import Body, Box, Ellipsoid, Pinhole, fired, rotation
from PIL import Image

DURATION_US = 200_000
_SMALL, _WIDE = Pinhole(250.0, 200, 150), Pinhole(250.0, 320, 150)
_BOX_M, _PLATE_M, _AXES_M = (0.12, 0.10, 0.08), (0.18, 0.135, 0.01), (0.07, 0.05, 0.04)

Path3 = Callable[[float], Sequence[float] | None]


@dataclass(frozen=True)
class Scene:
    """Objects in their streams, and what else is seen there.

    Args:
        cameras: one a stream.
        objects: each with its stream.
        models: the name of each object's mesh.
        others: bodies that are not tracked, each with its stream.
        straight: whether all the objects have straight edges, as the preset ``line`` needs.
        is_searched: whether the tracker has to search for an object, by the preset ``default``.
    """

    cameras: tuple[Pinhole, ...]
    objects: tuple[tuple[int, Body], ...]
    models: tuple[str, ...]
    others: tuple[tuple[int, Body], ...] = ()
    straight: bool = True
    is_searched: bool = False


def _moving(start: Sequence[float], at: Path3, turn: Sequence[float] = (0.8, -0.5, 1.2)) -> Callable[[float], np.ndarray | None]:
    """Poses of a body that begins as ``start`` (a rotation vector) and turns (rad/s); ``at`` says where it is (m), None for away."""

    def pose(seconds: float) -> np.ndarray | None:
        place = at(seconds)
        if place is None:
            return None
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation(np.multiply(turn, seconds)) @ rotation(start), place
        return T

    return pose


def _straight(start: Sequence[float], velocity: Sequence[float]) -> Path3:
    """At ``start`` (m), with a constant velocity (m/s)."""
    return lambda seconds: np.add(start, np.multiply(velocity, seconds))


def _picture() -> np.ndarray:
    """Print of 8 × 6 patches, in three shades that follow no order."""
    return np.array([0.1, 0.4, 0.95])[np.random.default_rng(7).integers(3, size=(6, 8))]


def _box(start: Sequence[float], at: Path3, turn: Sequence[float] = (0.8, -0.5, 1.2)) -> Body:
    return Body(Box(_BOX_M), _moving(start, at, turn))


def _turning_back(seconds: float) -> Sequence[float]:
    """To the right, and, once it is hidden, fast to the left and down."""
    before, after = min(seconds, 0.12), max(seconds - 0.12, 0.0)
    return 0.02 + 0.25 * before - 0.70 * after, -0.02 + 0.10 * before + 0.30 * after, 0.6


def _away_for_a_while(seconds: float) -> Sequence[float] | None:
    """Gone for 40 ms, and then somewhere else."""
    if 0.07 < seconds < 0.11:
        return None
    return (-0.10 + 0.3 * seconds, 0.0, 0.6) if seconds < 0.09 else (-0.02 + 0.2 * seconds, 0.02, 0.6)


SCENES: dict[str, Scene] = {
    "box": Scene((_SMALL,), ((0, _box((0.5, 0.6, 0.1), _straight((0, 0, 0.5), (0.15, 0.1, 0.1)))),), ("box",)),
    "textured plate": Scene(
        (_WIDE,),
        ((0, Body(Box(_PLATE_M, picture=_picture()), _moving((0.3, 0.3, 0.1), _straight((-0.03, 0, 0.5), (0.3, 0.1, 0.1))))),),
        ("plate",),
    ),
    "smooth object": Scene(
        (_SMALL,),
        ((0, Body(Ellipsoid(_AXES_M), _moving((0.2, 0.3, 0.4), _straight((-0.03, 0, 0.5), (0.3, 0.1, 0.0)), (1.5, 2.0, 1.5)))),),
        ("ellipsoid",),
        straight=False,
    ),
    "2 streams x 2 objects": Scene(
        (_WIDE, _SMALL),
        (
            (0, _box((0.5, 0.6, 0.1), _straight((-0.17, 0, 0.5), (0.2, 0.1, 0.1)))),
            (0, _box((0.4, -0.7, 0.3), _straight((0.17, 0, 0.5), (-0.15, 0.1, 0.0)))),
            (1, _box((0.4, -0.7, 0.3), _straight((0, 0, 0.55), (0.2, 0.0, 0.1)))),
            (1, _box((0.9, 0.3, -0.4), _straight((0.06, 0.03, 0.75), (-0.2, 0.1, 0.0)))),
        ),
        ("box",) * 4,
    ),
    "hidden by a bar": Scene(
        (_WIDE,),
        ((0, _box((0.5, 0.6, 0.1), _turning_back)),),
        ("box",),
        ((0, Body(Box((0.13, 0.16, 0.01), brightness=(0.5,) * 6), _moving((0, 0, 0), _straight((-0.30, 0, 0.35), (2.4, 0, 0)), (0, 0, 0)))),),
        is_searched=True,
    ),
    "lost and found": Scene((_WIDE,), ((0, _box((0.5, 0.6, 0.1), _away_for_a_while)),), ("box",), is_searched=True),
}


def write_scenes(folder: Path, names: Sequence[str], duration_us: int = DURATION_US) -> None:
    """``MODEL.glb`` of every model, and of each scene ``NAME.json`` (cameras, objects) and ``NAME.npz`` (events, first and true poses)."""
    for name, mesh in _meshes().items():
        mesh.export(folder / f"{name}.glb")
    for number, name in enumerate(names):
        scene = SCENES[name]
        arrays = {"T_start": np.stack([body.T_cam_obj(0.0) for _, body in scene.objects])}
        for stream, camera in enumerate(scene.cameras):
            bodies = [body for index, body in (*scene.objects, *scene.others) if index == stream]
            arrays |= {f"{key}_{stream}": values for key, values in fired(bodies, camera, duration_us, seed=10 * number + stream).items()}
        np.savez(folder / f"{name}.npz", **arrays)
        said = {"cameras": [asdict(camera) for camera in scene.cameras], "streams": [index for index, _ in scene.objects], "models": scene.models}
        (folder / f"{name}.json").write_text(json.dumps(said))


def _meshes() -> dict[str, trimesh.Trimesh]:
    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.vertices *= _AXES_M
    return {"box": trimesh.creation.box(_BOX_M), "plate": _printed_plate(), "ellipsoid": ball}


def _printed_plate() -> trimesh.Trimesh:
    """The plate, with the picture on its side towards -z; the other sides show a plain strip below it."""
    box = trimesh.creation.box(_PLATE_M)
    # Every face has corners of its own, so that each side has its own part of the picture.
    mesh = trimesh.Trimesh(box.vertices[box.faces].reshape(-1, 3), np.arange(len(box.faces) * 3).reshape(-1, 3), process=False)
    picture = _picture()
    strip = np.full((2, picture.shape[1]), 0.4)
    shown = np.kron(np.concatenate([picture, strip]), np.ones((16, 16)))
    share = mesh.vertices[:, :2] / _PLATE_M[:2] + 0.5
    printed = np.repeat(mesh.face_normals[:, 2] < -0.5, 3)
    rows = len(picture) / (len(picture) + len(strip))
    # Of UV coordinates the second one goes up.
    u, down = share[:, 0], np.where(printed, share[:, 1] * rows, 0.95 + 0.02 * share[:, 1])
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray((255 * shown).astype(np.uint8)).convert("RGB"))
    mesh.visual = trimesh.visual.TextureVisuals(np.stack([u, 1 - down], 1), material=material)
    return mesh
