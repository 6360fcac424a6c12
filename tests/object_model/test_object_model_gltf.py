"""glTF: what trimesh would leave out or misread is worked in, refused or said."""

import json
import math
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from torchtrack.errors import LimitError, ModelError, TorchtrackWarning
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.gltf import _transformed

SIZE = 0.1
UV = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
DRACO = "KHR_draco_mesh_compression"


def picture() -> Image.Image:
    """A dark card with a bright square that is in no symmetric place."""
    pixels = np.full((128, 128, 3), 20, np.uint8)
    pixels[20:60, 30:100] = 230
    return Image.fromarray(pixels)


def card(uv: np.ndarray = UV) -> trimesh.Trimesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * SIZE
    visual = TextureVisuals(uv, material=PBRMaterial(baseColorTexture=picture(), name="print"))
    return trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def rewrite(path: Path, mesh: trimesh.Trimesh | trimesh.Scene, change: Callable[[dict[str, Any], list[bytes]], None]) -> Path:
    """A glTF file of the mesh whose tree and buffers are changed."""
    files = mesh.export(file_type="gltf")
    tree = json.loads(files.pop("model.gltf"))
    buffers = [files[buffer["uri"]] for buffer in tree.get("buffers", [])]
    change(tree, buffers)
    for number, data in enumerate(buffers):
        (path / f"{number}.bin").write_bytes(data)
        tree["buffers"][number].setdefault("uri", f"{number}.bin")
        if tree["buffers"][number]["uri"].startswith("gltf_buffer"):
            tree["buffers"][number] = {"uri": f"{number}.bin", "byteLength": len(data)}
    for name, data in files.items():
        if not name.startswith("gltf_buffer"):
            (path / name).write_bytes(data)
    (path / "model.gltf").write_text(json.dumps(tree))
    return path / "model.gltf"


def accessor_of(tree: dict[str, Any], attribute: str) -> dict[str, Any]:
    return tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"][attribute]]


def store(tree: dict[str, Any], buffers: list[bytes], attribute: str, values: np.ndarray, component: int, **more: Any) -> None:
    """Put other numbers in the place of an attribute."""
    accessor = accessor_of(tree, attribute)
    view = tree["bufferViews"][accessor["bufferView"]]
    buffers[view["buffer"]] = values.tobytes()
    view.clear()
    view.update({"buffer": buffers.index(values.tobytes()), "byteLength": values.nbytes})
    accessor.update({"componentType": component, "byteOffset": 0, **more})
    accessor.pop("min", None), accessor.pop("max", None)


def info(tree: dict[str, Any]) -> dict[str, Any]:
    return tree["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]


def same_print(a: ObjectModel, b: ObjectModel) -> bool:
    """Whether texture points lie at the same places, in any order."""
    return len(a.texture_points) > 100 and all(
        torch.cdist(x, y).amin(1).max() < 5e-4 for x, y in ((a.texture_points, b.texture_points), (b.texture_points, a.texture_points))
    )


@pytest.fixture
def plain(tmp_path: Path) -> ObjectModel:
    (tmp_path / "plain.glb").write_bytes(card().export(file_type="glb"))
    return ObjectModel.from_file(tmp_path / "plain.glb")


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_transform_of_a_texture(tmp_path: Path, plain: ObjectModel, turn: float):
    """UVs whose transform gives the plain ones print the same."""
    cosine, sine = math.cos(turn), math.sin(turn)
    # In the file v goes down: (u, v) = R S (u', v') + offset, so (u', v') = S^-1 R^-1 ((u, v) - offset).
    offset, scale = np.array([0.25, -0.5]), np.array([4.0, 0.5])
    uv = (np.stack([UV[:, 0], 1 - UV[:, 1]], 1) - offset) @ np.array([[cosine, -sine], [sine, cosine]]).T / scale
    transform = {"offset": offset.tolist(), "scale": scale.tolist(), "rotation": turn}
    np.testing.assert_allclose(_transformed(uv, transform), np.stack([UV[:, 0], 1 - UV[:, 1]], 1), atol=1e-12)

    def change(tree: dict[str, Any], buffers: list[bytes]) -> None:
        store(tree, buffers, "TEXCOORD_0", uv.astype("<f4"), 5126)
        info(tree)["extensions"] = {"KHR_texture_transform": transform}
        tree["extensionsRequired"] = ["KHR_texture_transform"]

    assert same_print(plain, ObjectModel.from_file(rewrite(tmp_path, card(), change)))


def test_turning_a_texture_is_anticlockwise_in_an_image_whose_v_goes_down():
    np.testing.assert_allclose(_transformed(np.array([[1.0, 0]]), {"rotation": math.pi / 2}), [[0, -1]], atol=1e-12)


def test_quantised_coordinates(tmp_path: Path, plain: ObjectModel):
    """Positions and UVs as normalised integers, as KHR_mesh_quantization allows; normals as bytes."""

    def change(tree: dict[str, Any], buffers: list[bytes]) -> None:
        position = np.zeros((4, 4), "<i2")
        position[:, :3] = np.round(card().vertices / SIZE * 32767)
        store(tree, buffers, "POSITION", position, 5122, normalized=True)
        tree["bufferViews"][accessor_of(tree, "POSITION")["bufferView"]]["byteStride"] = 8
        store(tree, buffers, "TEXCOORD_0", np.round(np.stack([UV[:, 0], 1 - UV[:, 1]], 1) * 65535).astype("<u2"), 5123, normalized=True)
        next(node for node in tree["nodes"] if "mesh" in node)["scale"] = [SIZE] * 3
        tree["extensionsRequired"] = ["KHR_mesh_quantization"]

    model = ObjectModel.from_file(rewrite(tmp_path, card(), change))
    assert model.diameter_m == pytest.approx(SIZE * 2**0.5, rel=1e-4)
    assert same_print(plain, model)


def test_texture_of_the_second_set_of_coordinates(tmp_path: Path, plain: ObjectModel):
    def change(tree: dict[str, Any], buffers: list[bytes]) -> None:
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        attributes["TEXCOORD_1"] = attributes.pop("TEXCOORD_0")
        info(tree)["texCoord"] = 1

    assert same_print(plain, ObjectModel.from_file(rewrite(tmp_path, card(), change)))


def test_sparse_positions_and_fans(tmp_path: Path):
    """A corner that is moved by a sparse accessor, in a fan of two triangles."""

    def change(tree: dict[str, Any], buffers: list[bytes]) -> None:
        buffers.append(np.array([2], "<u2").tobytes() + b"\0\0" + np.array([SIZE, SIZE, 0.2], "<f4").tobytes())
        tree["buffers"].append({"uri": f"{len(buffers) - 1}.bin", "byteLength": 16})
        tree["bufferViews"] += [{"buffer": len(buffers) - 1, "byteOffset": start, "byteLength": size} for start, size in ((0, 2), (4, 12))]
        views = len(tree["bufferViews"])
        accessor_of(tree, "POSITION")["sparse"] = {
            "count": 1,
            "indices": {"bufferView": views - 2, "componentType": 5123},
            "values": {"bufferView": views - 1},
        }
        primitive = tree["meshes"][0]["primitives"][0]
        del primitive["indices"]
        primitive["mode"] = 6

    model = ObjectModel.from_file(rewrite(tmp_path, card(), change))
    assert len(model.triangles) == 2
    assert model.triangles[..., 2].max().item() == pytest.approx(0.2)


@pytest.mark.parametrize("half", [True, False])
def test_compressed_parts_are_refused(tmp_path: Path, half: bool):
    scene = trimesh.Scene([card(), trimesh.creation.box((SIZE,) * 3)]) if half else trimesh.Scene([card()])

    def change(tree: dict[str, Any], _: list[bytes]) -> None:
        primitive = tree["meshes"][-1]["primitives"][0]
        for index in (primitive["indices"], *primitive["attributes"].values()):
            tree["accessors"][index].pop("bufferView", None)
        primitive["extensions"] = {DRACO: {"bufferView": 0, "attributes": {"POSITION": 0}}}
        tree["extensionsUsed"] = [DRACO]

    with pytest.raises(ModelError, match=rf"model\.gltf' needs {DRACO}, which cannot be read.*without compression"):
        ObjectModel.from_file(rewrite(tmp_path, scene, change))


def test_compression_that_is_required_is_refused(tmp_path: Path):
    with pytest.raises(ModelError, match="needs EXT_meshopt_compression"):
        ObjectModel.from_file(rewrite(tmp_path, card(), lambda tree, _: tree.update(extensionsRequired=["EXT_meshopt_compression"])))

    def fallback(tree: dict[str, Any], _: list[bytes]) -> None:
        view = tree["bufferViews"][accessor_of(tree, "POSITION")["bufferView"]]
        view["extensions"] = {"EXT_meshopt_compression": {}}
        view["buffer"] = len(tree["buffers"])
        tree["buffers"].append({"byteLength": 48, "extensions": {"EXT_meshopt_compression": {"fallback": True}}})

    with pytest.raises(ModelError, match="needs EXT_meshopt_compression"):
        ObjectModel.from_file(rewrite(tmp_path, card(), fallback))


def test_parts_that_are_lost_are_told(tmp_path: Path):
    scene = trimesh.Scene([card(), trimesh.creation.box((SIZE,) * 3)])

    def change(tree: dict[str, Any], _: list[bytes]) -> None:
        with_mesh = [node for node in tree["nodes"] if "mesh" in node]
        with_mesh[1]["scale"] = [0, 0, 0]
        tree["meshes"].append({"name": "spare", "primitives": tree["meshes"][1]["primitives"]})
        tree["meshes"][0]["primitives"].append({"attributes": tree["meshes"][0]["primitives"][0]["attributes"], "mode": 1})
        with_mesh[0]["extensions"] = {"KHR_node_visibility": {"visible": False}}
        tree["scenes"].append({"nodes": []})

    with pytest.warns(TorchtrackWarning) as caught:
        model = ObjectModel.from_file(rewrite(tmp_path, scene, change))
    assert len(model.triangles) == 2
    text = "\n".join(str(warning.message) for warning in caught)
    for expected in (
        "2 scenes",
        "not in its scene.*'spare'",
        "marked as hidden",
        "1 parts of .* are points or lines",
        "1 of 2 parts of the model have no face with an area",
    ):
        assert re.search(expected, text), expected


def test_instancing_is_refused(tmp_path: Path):
    def change(tree: dict[str, Any], _: list[bytes]) -> None:
        next(node for node in tree["nodes"] if "mesh" in node)["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {}}}

    with pytest.raises(ModelError, match="EXT_mesh_gpu_instancing"):
        ObjectModel.from_file(rewrite(tmp_path, card(), change))


def test_file_without_scenes(tmp_path: Path):
    def change(tree: dict[str, Any], _: list[bytes]) -> None:
        del tree["scenes"]
        tree.pop("scene", None)

    model = ObjectModel.from_file(rewrite(tmp_path, trimesh.creation.box((SIZE,) * 3), change))
    assert len(model.edge_points) == 12


def test_missing_buffer(tmp_path: Path):
    path = rewrite(tmp_path, card(), lambda tree, _: None)
    (tmp_path / "0.bin").unlink()
    with pytest.raises(ModelError, match=r"keeps its shape in '0\.bin', which cannot be found"):
        ObjectModel.from_file(path)


def test_glb_that_is_cut_short(tmp_path: Path):
    content = card().export(file_type="glb")
    for size in (3, 15, 30, len(content) // 2, len(content) - 1):
        (tmp_path / "cut.glb").write_bytes(content[:size])
        with pytest.raises(ModelError, match=r"cut\.glb' as a glTF file: it is damaged"):
            ObjectModel.from_file(tmp_path / "cut.glb")
    (tmp_path / "old.glb").write_bytes(b"glTF" + bytes([1, 0, 0, 0]) + content[8:])
    with pytest.raises(ModelError, match=r"glTF 1, and only glTF 2\.0 is read"):
        ObjectModel.from_file(tmp_path / "old.glb")


def test_sizes_are_limited_before_anything_is_made(tmp_path: Path):
    with pytest.raises(LimitError, match=r"20,001 scene nodes.*limits\.scene_nodes"):
        ObjectModel.from_file(rewrite(tmp_path, card(), lambda tree, _: tree.update(nodes=tree["nodes"][:1] + [{}] * 20_000)))
    with pytest.raises(LimitError, match=r"20,000 scene nodes"):
        ObjectModel.from_file(rewrite(tmp_path, card(), lambda tree, _: tree.update(meshes=tree["meshes"] * 20_000)))
    with pytest.raises(LimitError, match=r"faces.*limits\.faces"):
        ObjectModel.from_file(
            rewrite(tmp_path, card(), lambda tree, _: tree["accessors"][tree["meshes"][0]["primitives"][0]["indices"]].update(count=30_000_000))
        )


TREES = [
    "[]",
    "3",
    '"x"',
    "null",
    '{"nodes": 3}',
    '{"nodes": [[]]}',
    '{"meshes": [{}]}',
    '{"meshes": {"a": 1}}',
    '{"asset": []}',
    '{"scene": "x", "scenes": [{}]}',
]
TREES += [
    '{"nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}]}',
    '{"nodes": [{"children": [1]}, {"children": [0]}], "scenes": [{"nodes": [0]}]}',
]
TREES += ['{"nodes": [{"mesh": 0}, {"children": [0]}, {"children": [0]}], "scenes": [{"nodes": [1, 2]}]}', "[" * 100_000, '{"a":' * 100_000]
TREES += [
    '{"accessors": [{"count": -1}], "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "nodes": [{"mesh": 0}]}',
    '{"buffers": [{"uri": "data:"}]}',
]


TREES += ['{"scenes": [{"nodes": [0]}], "nodes": [' + ", ".join(f'{{"children": [{i}]}}' for i in range(1, 200)) + ", {}]}"]


@pytest.mark.parametrize("tree", TREES, ids=lambda text: text[:30])
def test_damaged_trees(tmp_path: Path, tree: str):
    (tmp_path / "bad.gltf").write_text(tree)
    with pytest.raises(ModelError, match=r"bad\.gltf.*[Ee]xport"):
        ObjectModel.from_file(tmp_path / "bad.gltf")


def test_values_of_wrong_types_anywhere(tmp_path: Path):
    """Any value of the tree replaced by one of another type gives a model or an error of ours."""
    path = rewrite(tmp_path, card(), lambda tree, _: None)
    tree = json.loads(path.read_text())
    places: list[tuple[Any, Any]] = []

    def walk(item: Any) -> None:
        for key in list(item) if isinstance(item, dict) else range(len(item)) if isinstance(item, list) else []:
            places.append((item, key))
            walk(item[key])

    walk(tree)
    rng = np.random.default_rng(0)
    for number in rng.choice(len(places), min(len(places), 60), replace=False):
        item, key = places[number]
        old = item[key]
        for other in (-1, 1e30, "x", None, [[]]):
            item[key] = other
            path.write_text(json.dumps(tree))
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", TorchtrackWarning)
                    ObjectModel.from_file(path)
            except (ModelError, LimitError) as error:
                assert "model" in str(error)
        item[key] = old
