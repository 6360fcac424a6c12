"""glTF and GLB: what trimesh would leave out or misread is worked in, refused or said.

trimesh reads the file's geometry and materials. Before it does, the file is checked (its length, its nodes, its sizes, the
extensions that it needs), and made plain: quantised and sparse numbers become floats, the transforms of textures become
texture coordinates, fans become triangles.
"""

import base64
import binascii
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from torchtrack.core.limits import check_limit
from torchtrack.errors import ModelError, TorchtrackError
from torchtrack.object_model.gltf_accessors import GltfContent, Tree, at
from torchtrack.object_model.notices import tell
from torchtrack.object_model.side_files import MeshText, SideFiles

# Extensions that may be needed without harm to the shape; what they do to a texture shows when the texture is missing.
_HARMLESS = (
    "KHR_materials_",
    "KHR_texture_",
    "KHR_mesh_quantization",
    "KHR_lights_",
    "KHR_xmp",
    "EXT_texture_",
    "MSFT_texture_",
    "KHR_node_visibility",
)
_VALUES_PER_NODE = 200
# Assemblies are some ten levels deep; the time of a scene is that of its nodes times their depth.
_DEEPEST = 100
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_FLOAT, _UINT32 = 5126, 5125
# What reading a damaged tree of JSON runs into.
_TREE_ERRORS = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError, MemoryError, binascii.Error)


def read_gltf(path: Path) -> MeshText:
    """A glTF 2.0 or GLB file as plain JSON for trimesh.

    Raises:
        ModelError: if it is damaged, or needs an extension that cannot be read.
        LimitError: if it has more nodes, faces or vertices than the limits.
    """
    try:
        tree, binary = _container(path, path.read_bytes())
        content = GltfContent(tree, _buffers(path, tree, binary))
        _check_extensions(path, tree)
        _check_scene(path, tree)
        _check_sizes(path, content)
        images = _name_materials(tree)
        _make_plain(path, content)
        for number, buffer in enumerate(tree.get("buffers", [])):
            buffer["uri"] = f"buffer:{number}"
        given = {f"buffer:{number}": data for number, data in enumerate(content.buffers)}
        named = [image["uri"] for image in tree.get("images", []) if "uri" in image and not image["uri"].startswith("data:")]
        return MeshText(json.dumps(tree).encode(), "gltf", SideFiles(path, given), tuple(named), images)
    except TorchtrackError:
        raise
    except _TREE_ERRORS as error:
        raise ModelError(
            f"cannot read '{path}' as a glTF file: it is damaged ({type(error).__name__}: {error}). Copy it again, or export it again."
        ) from error


def _container(path: Path, data: bytes) -> tuple[Tree, bytes | None]:
    """The JSON tree of a glTF or GLB file, whatever its suffix, and the binary chunk of a GLB."""
    if data[:4] != b"glTF":
        return _checked_tree(path, data), None
    if len(data) < 20:
        raise ValueError("it ends within its header")
    version, length = (int.from_bytes(data[start : start + 4], "little") for start in (4, 8))
    if version != 2:
        raise ModelError(f"'{path}' is glTF {version}, and only glTF 2.0 is read. Export it as glTF 2.0.")
    if length > len(data):
        raise ValueError(f"it says that it has {length} bytes, and has {len(data)}: it was cut short")
    chunks: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= length:
        size, kind = int.from_bytes(data[start : start + 4], "little"), data[start + 4 : start + 8]
        if start + 8 + size > length:
            raise ValueError(f"its chunk at byte {start} reaches beyond its end")
        chunks.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    return _checked_tree(path, chunks[b"JSON"]), chunks.get(b"BIN\0")


def _checked_tree(path: Path, text: bytes) -> Tree:
    # A node takes some tens of values; text of brackets alone would take a hundred times its size in memory.
    check_limit("scene_nodes", sum(text.count(sign) for sign in (b",", b"[", b"{")) // _VALUES_PER_NODE, path)
    tree = json.loads(text)
    version = str(tree.get("asset", {}).get("version", "2.0"))
    if not version.startswith("2"):
        raise ModelError(f"'{path}' is glTF {version}, and only glTF 2.0 is read. Export it as glTF 2.0.")
    return dict(tree)


def _buffers(path: Path, tree: Tree, binary: bytes | None) -> list[bytes]:
    """The bytes of every buffer."""
    data_of_each = []
    for number, buffer in enumerate(tree.get("buffers", [])):
        data = binary if number == 0 and "uri" not in buffer else _uri_bytes(path, buffer.get("uri"))
        if data is None:
            # The place that a compressed view would be unpacked to; see _check_extensions.
            data = b""
        elif len(data) < buffer["byteLength"]:
            raise ValueError(f"its buffer {number} should have {buffer['byteLength']} bytes, and has {len(data)}: it was cut short")
        data_of_each.append(data)
    return data_of_each


def _uri_bytes(path: Path, uri: str | None) -> bytes | None:
    if uri is None:
        return None
    if not uri.startswith("data:"):
        try:
            return SideFiles(path).get(uri)
        except FileNotFoundError as error:
            raise ModelError(f"'{path}' keeps its shape in '{uri}', which cannot be found in '{path.parent}'. Put the file there.") from error
    check_limit("mesh_bytes", len(uri), path)
    return base64.b64decode(uri.split(",", 1)[1], validate=False)


def _check_extensions(path: Path, tree: Tree) -> None:
    """Refuse what cannot be decoded, rather than lose the parts that need it."""
    missing = [name for name in tree.get("extensionsRequired", []) if not str(name).startswith(_HARMLESS)]
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            used = [primitive["attributes"]["POSITION"], *([primitive["indices"]] if "indices" in primitive else [])]
            accessors = [at(tree["accessors"], index) for index in used]
            if any("bufferView" not in accessor and "sparse" not in accessor for accessor in accessors):
                missing += list(primitive.get("extensions", {})) or ["(an accessor without data)"]
            views = [at(tree["bufferViews"], accessor["bufferView"]) for accessor in accessors if "bufferView" in accessor]
            # Compressed views name a buffer that has no bytes unless a copy without compression was stored.
            missing += [name for view in views for name in view.get("extensions", {}) if _is_empty(tree, view["buffer"])]
    if missing:
        raise ModelError(
            f"'{path}' needs {', '.join(dict.fromkeys(missing))}, which cannot be read: parts of the model would be missing or wrong. "
            "Export it without that extension, that is without compression "
            "(in Blender: untick Compression; with gltfpack: leave out -c and -cc)."
        )


def _is_empty(tree: Tree, number: int) -> bool:
    return number > 0 and "uri" not in at(tree["buffers"], number)


def _check_scene(path: Path, tree: Tree) -> None:
    """Nodes form a forest within the limits; what of it is not shown is said."""
    nodes = tree.setdefault("nodes", [])
    check_limit("scene_nodes", len(nodes), path)
    check_limit("scene_nodes", sum(len(mesh["primitives"]) for mesh in tree.get("meshes", [])), path)
    children = [child for node in nodes for child in node.get("children", [])]
    if len(set(children)) < len(children) or any(not 0 <= child < len(nodes) for child in children):
        raise ValueError("a node is the child of two others, or is not there")
    if not tree.get("scenes"):
        tree["scenes"], tree["scene"] = [{"nodes": sorted(set(range(len(nodes))) - set(children))}], 0
    scene = at(tree["scenes"], tree.get("scene", 0))
    if len(tree["scenes"]) > 1:
        tell(f"'{path}' has {len(tree['scenes'])} scenes; only {_named(scene, tree.get('scene', 0))} is read. Export the scene that you mean alone.")
    shown: set[int] = set()
    level, depth = list(scene.get("nodes", [])), 0
    while level:
        depth += 1
        if depth > _DEEPEST or not shown.isdisjoint(level):
            raise ValueError(f"its nodes lie more than {_DEEPEST} deep in one another, or one comes twice in the scene")
        shown.update(level)
        level = [child for number in level for child in at(nodes, number).get("children", [])]
    _tell_hidden(path, tree, shown)


def _tell_hidden(path: Path, tree: Tree, shown: set[int]) -> None:
    """Say which parts are not in the scene, are marked as hidden, or are repeated by an extension."""
    nodes = tree["nodes"]
    with_mesh = {number for number, node in enumerate(nodes) if "mesh" in node}
    placed = {nodes[number]["mesh"] for number in with_mesh & shown}
    left = [number for number in range(len(tree.get("meshes", []))) if number not in placed]
    if left:
        names = ", ".join(_named(tree["meshes"][number], number) for number in left[:5])
        tell(f"{len(left)} meshes of '{path}' are not in its scene, and are not used: {names}. Put them into the scene, or delete them.")
    hidden = [n for n in sorted(with_mesh & shown) if nodes[n].get("extensions", {}).get("KHR_node_visibility", {}).get("visible") is False]
    if hidden:
        tell(f"{len(hidden)} parts of '{path}' are marked as hidden, and are used all the same: {_named(nodes[hidden[0]], hidden[0])}. Delete them.")
    if any("EXT_mesh_gpu_instancing" in nodes[number].get("extensions", {}) for number in shown):
        raise ModelError(f"'{path}' repeats parts by EXT_mesh_gpu_instancing, which cannot be read. Export it without instancing.")


def _named(item: Tree, number: int) -> str:
    return repr(str(item.get("name", number)))


def _check_sizes(path: Path, content: GltfContent) -> None:
    """Faces and vertices of all nodes together, before any is made."""
    tree = content.tree
    per_mesh = [[_size(content, primitive) for primitive in mesh["primitives"]] for mesh in tree.get("meshes", [])]
    totals = [[sum(size[k] for size in sizes) for k in (0, 1)] for sizes in per_mesh]
    placed = [at(totals, node["mesh"]) for node in tree["nodes"] if "mesh" in node]
    check_limit("vertices", sum(total[0] for total in placed), path)
    check_limit("faces", sum(total[1] for total in placed) // 3, path)


def _size(content: GltfContent, primitive: Tree) -> tuple[int, int]:
    """Vertices and corners of a primitive."""
    count = content.accessor(primitive["attributes"]["POSITION"])["count"]
    corners = content.accessor(primitive["indices"])["count"] if "indices" in primitive else count
    if min(count, corners) < 0:
        raise ValueError("a count is negative")
    return int(count), int(corners) * (1 if primitive.get("mode", _TRIANGLES) == _TRIANGLES else 3)


def _name_materials(tree: Tree) -> dict[str, str]:
    """Give every material a name of its own; the image of each that has a colour texture, by that name."""
    images: dict[str, str] = {}
    taken: set[str] = set()
    for number, material in enumerate(tree.get("materials", [])):
        name = str(material.get("name", f"material {number}"))
        material["name"] = name if name not in taken else f"{name} ({number})"
        taken.add(material["name"])
        texture = colour_texture(material)
        if texture is not None:
            images[material["name"]] = _image_name(tree, texture)
    return images


def colour_texture(material: Tree) -> Tree | None:
    """The texture of a material's colour."""
    glossy: Tree = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    texture: Tree | None = material.get("pbrMetallicRoughness", {}).get("baseColorTexture") or glossy.get("diffuseTexture")
    return texture


def _image_name(tree: Tree, texture: Tree) -> str:
    source = at(tree["textures"], texture["index"])
    number = source.get("source", next((ext["source"] for ext in source.get("extensions", {}).values() if "source" in ext), None))
    image: Tree = at(tree["images"], number) if number is not None else {}
    uri = str(image.get("uri", ""))
    return str(image.get("name", f"image {number}")) if not uri or uri.startswith("data:") else uri


def _make_plain(path: Path, content: GltfContent) -> None:
    """Rewrite, in place, what trimesh would misread; drop and tell what is no surface."""
    tree = content.tree
    for key in ("buffers", "bufferViews", "accessors"):
        tree.setdefault(key, [])
    dropped = 0
    for mesh in tree.get("meshes", []):
        kept = [primitive for primitive in mesh["primitives"] if primitive.get("mode", _TRIANGLES) in (_TRIANGLES, _STRIP, _FAN)]
        dropped += len(mesh["primitives"]) - len(kept)
        for primitive in kept:
            _make_primitive_plain(content, primitive)
        mesh["primitives"] = kept
    if dropped:
        tell(f"{dropped} parts of '{path}' are points or lines, and are not used: only surfaces are. Delete them, or make them surfaces.")


def _make_primitive_plain(content: GltfContent, primitive: Tree) -> None:
    tree, attributes = content.tree, primitive["attributes"]
    position = content.accessor(attributes["POSITION"])
    if position.get("normalized") or "sparse" in position:
        attributes["POSITION"] = content.add(content.values(attributes["POSITION"]), "VEC3", _FLOAT)
    if "indices" in primitive and "sparse" in content.accessor(primitive["indices"]):
        primitive["indices"] = content.add(content.values(primitive["indices"]), "SCALAR", _UINT32)
    if primitive.get("mode") == _FAN:
        count = content.accessor(attributes["POSITION"])["count"]
        rim = content.values(primitive["indices"]).reshape(-1) if "indices" in primitive else np.arange(count)
        faces = np.stack([np.full(max(len(rim) - 2, 0), rim[0]), rim[1:-1], rim[2:]], 1)
        primitive["indices"], primitive["mode"] = content.add(faces.reshape(-1, 1), "SCALAR", _UINT32), _TRIANGLES
    if "NORMAL" in attributes and content.accessor(attributes["NORMAL"])["componentType"] != _FLOAT:
        # Quantised normals would be misread; without any, they are computed.
        del attributes["NORMAL"]
    texture = colour_texture(at(tree["materials"], primitive["material"])) if "material" in primitive else None
    _place_texture(content, attributes, texture or {})


def _place_texture(content: GltfContent, attributes: Tree, texture: Tree) -> None:
    """The coordinates that the colour texture is looked up at, as the attribute ``TEXCOORD_0``."""
    transform: Tree = texture.get("extensions", {}).get("KHR_texture_transform", {})
    chosen = f"TEXCOORD_{transform.get('texCoord', texture.get('texCoord', 0))}"
    if chosen not in attributes:
        attributes.pop("TEXCOORD_0", None)
        return
    accessor = content.accessor(attributes[chosen])
    if chosen != "TEXCOORD_0" or transform or accessor["componentType"] != _FLOAT or "sparse" in accessor:
        uv = _transformed(content.values(attributes[chosen]).astype(np.float64), transform)
        attributes["TEXCOORD_0"] = content.add(uv, "VEC2", _FLOAT)


def _transformed(uv: np.ndarray, transform: dict[str, Any]) -> np.ndarray:
    """KHR_texture_transform: scaled, turned anticlockwise in an image whose v goes down, then shifted."""
    u, v = (uv * np.reshape(transform.get("scale", [1, 1]), 2)).T
    cosine, sine = math.cos(transform.get("rotation", 0.0)), math.sin(transform.get("rotation", 0.0))
    turned: np.ndarray = np.stack([cosine * u + sine * v, cosine * v - sine * u], 1) + np.reshape(transform.get("offset", [0, 0]), 2)
    return turned
