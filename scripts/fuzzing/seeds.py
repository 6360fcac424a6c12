"""Small sound files of every kind that is read, made here: what mutations start from.

A seed is a folder. One of its files is mutated; what is opened is that file, or one beside it that names it.
"""

import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import lz4.frame
import numpy as np
import torch
import trimesh
import zstandard
from PIL import Image
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from torchtrack.core.camera import Camera
from torchtrack.core.events import EventBatch
from torchtrack.io import LabelledMesh, Trajectory, write_sequence, write_tum
from torchtrack.io.convert import WRITERS, convert

WIDTH, HEIGHT = 64, 48
COUNT = 300
CAMERA = Camera(80.0, 80.0, 31.5, 23.5, WIDTH, HEIGHT)
_PACKET = "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\nbool is_bigendian\nuint8[] events"


@dataclass(frozen=True)
class Seed:
    """A sound file.

    Args:
        name: what it is called.
        kind: how it is read: ``events``, ``sequence``, ``calibration``, ``poses``, ``mesh``, ``lines``, or the command of a config.
        folder: where it is, with what it needs.
        mutated: the file that is mutated, in the folder.
        opened: what is opened, in the folder.
    """

    name: str
    kind: str
    folder: Path
    mutated: str
    opened: str


def make_seeds(folder: Path) -> list[Seed]:
    """All seeds, each in a folder of its own within ``folder``."""
    seeds = []
    for name, kind, make in _MAKERS:
        own = folder / name
        own.mkdir()
        mutated, opened = make(own)
        seeds.append(Seed(name, kind, own, mutated.relative_to(own).as_posix(), opened.relative_to(own).as_posix()))
    return seeds


def events(count: int = COUNT, seed: int = 0) -> EventBatch:
    """Events spread evenly over the sensor and 20 ms."""
    random = np.random.default_rng(seed)
    x, y, p = (random.integers(0, most, count) for most in (WIDTH, HEIGHT, 2))
    return EventBatch.from_numpy(x, y, 1000 + np.sort(random.integers(0, 20_000, count)), p)


Made = tuple[Path, Path]


def _alone(path: Path) -> Made:
    return path, path


def _written(kind: str, suffix: str) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        path = folder / f"events{suffix}"
        with closing(WRITERS[kind](path, WIDTH, HEIGHT)) as writer:
            writer.write(events())
        return _alone(path)

    return make


def _bytes(name: str, content: bytes | str) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return _alone(folder / name)

    return make


def _evt21() -> bytes:
    words = np.array([8 << 60 | 1 << 32, *(1 << 60 | x << 43 | 7 << 32 | 255 for x in range(50))], "<u8")
    return b"% evt 2.1\n% geometry 64x48\n% end\n" + words.tobytes()


def _dat() -> bytes:
    batch = events()
    address = batch.x.numpy().astype("<u8") | batch.y.numpy().astype("<u8") << np.uint64(14) | batch.polarity.numpy().astype("<u8") << np.uint64(28)
    words = batch.t_us.numpy().astype("<u8") | address << np.uint64(32)
    return b"% Data file containing CD events.\n% Version 2\n% Height 48\n% Width 64\n\x0c\x08" + words.tobytes()


def _es(kind: int) -> bytes:
    batch = events()
    delays = np.diff(batch.t_us.numpy(), prepend=batch.t_us[0]).clip(0, 60)
    shift = 1 if kind == 1 else 2
    rows = zip(delays.tolist(), batch.x.tolist(), batch.y.tolist(), batch.polarity.tolist(), strict=True)
    body = b"".join(bytes([d << shift | int(p) * shift]) + x.to_bytes(2, "little") + y.to_bytes(2, "little") for d, x, y, p in rows)
    return b"Event Stream\x02\x00\x00" + bytes([kind]) + WIDTH.to_bytes(2, "little") + HEIGHT.to_bytes(2, "little") + body


def aedat4(compression: int, packets: int = 3) -> bytes:
    """An AEDAT 4 file, its flatbuffers laid out by hand; compression 0, 1 (LZ4) or 3 (Zstandard)."""
    nodes = (
        '<node name="0" path="/mainloop/Recorder/outInfo/0/"><attr key="typeIdentifier" type="string">EVTS</attr>'
        f'<attr key="sizeX" type="int">{WIDTH}</attr><attr key="sizeY" type="int">{HEIGHT}</attr></node>'
    )
    vtable = np.array([10, 20, 4, 8, 16], "<u2").tobytes() + b"\0\0"
    # Compression, position of the index, offset of the description.
    table = np.array([12, compression], "<i4").tobytes() + np.array([-1], "<i8").tobytes() + np.array([4], "<u4").tobytes()
    header = np.array([16], "<u4").tobytes() + vtable + table + len(nodes).to_bytes(4, "little") + nodes.encode()
    squeeze = {0: bytes, 1: lz4.frame.compress, 3: zstandard.ZstdCompressor().compress}[compression]
    content = b"".join(_aedat4_packet(part, squeeze) for part in range(packets))
    return b"#!AER-DAT4.0\r\n" + len(header).to_bytes(4, "little") + header + content


def _aedat4_packet(number: int, squeeze: Callable[[bytes], bytes]) -> bytes:
    batch = events()[100 * number : 100 * number + 100]
    records = np.zeros(len(batch), np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("on", "u1"), ("pad", "V3")]))
    records["t"], records["x"], records["y"], records["on"] = batch.t_us, batch.x, batch.y, batch.polarity
    vtable = np.array([6, 8, 4], "<u2").tobytes() + b"\0\0"
    body = np.array([12], "<u4").tobytes() + vtable + np.array([8], "<i4").tobytes() + np.array([4], "<u4").tobytes()
    content = body + len(batch).to_bytes(4, "little") + records.tobytes()
    packed = squeeze(len(content).to_bytes(4, "little") + content)
    return (0).to_bytes(4, "little") + len(packed).to_bytes(4, "little") + packed


def _davis_text() -> str:
    batch = events()
    rows = zip(batch.t_us.tolist(), batch.x.tolist(), batch.y.tolist(), batch.polarity.tolist(), strict=True)
    return "".join(f"{1e-6 * t:.6f} {x} {y} {int(p)}\n" for t, x, y, p in rows)


def _zipped_text(folder: Path) -> Made:
    with zipfile.ZipFile(folder / "events.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(zipfile.ZipInfo("events.txt"), _davis_text(), zipfile.ZIP_DEFLATED)
    return _alone(folder / "events.zip")


def _npz(folder: Path) -> Made:
    batch = events()
    arrays = {"t": batch.t_us, "x": batch.x, "y": batch.y, "p": batch.polarity}
    path = folder / "events.npz"
    np.savez_compressed(path, **{key: values.numpy() for key, values in arrays.items()}, width=np.int64(WIDTH), height=np.int64(HEIGHT))
    return _alone(path)


def _prophesee_hdf5(folder: Path) -> Made:
    batch = events()
    records = np.zeros(len(batch), np.dtype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")]))
    records["x"], records["y"], records["p"], records["t"] = batch.x, batch.y, batch.polarity, batch.t_us
    with h5py.File(folder / "events.hdf5", "w") as file:
        file.create_dataset("CD/events", data=records, chunks=(128,), compression="gzip")
        file.attrs["geometry"] = f"{WIDTH}x{HEIGHT}"
    return _alone(folder / "events.hdf5")


def _trajectory(count: int = 9) -> Trajectory:
    T = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    T[:, 2, 3] = 0.5
    T[:, 0, 3] = torch.linspace(0, 0.01, count, dtype=torch.float64)
    return Trajectory(torch.arange(count) * 2500, T)


def _sequence(folder: Path) -> Made:
    path = folder / "scene.npz"
    box = LabelledMesh("box", trimesh.creation.box((0.12, 0.1, 0.08)), _trajectory())
    write_sequence(path, events(), CAMERA, [box], {"made": "by hand"})
    return _alone(path)


def _container(folder: Path) -> Made:
    inner = folder / "inner"
    inner.mkdir()
    convert(_sequence(inner)[0], folder / "scene.h5")
    return _alone(folder / "scene.h5")


def ros_packet(ros2: bool, encoding: str = "mono") -> bytes:
    """A message ``event_camera_msgs/EventPacket``."""
    batch = events(40)
    words = (
        (batch.t_us.numpy() * 1000).astype("<u8") | batch.x.numpy().astype("<u8") << np.uint64(32) | batch.y.numpy().astype("<u8") << np.uint64(48)
    )
    frame, name = (text + b"\0" * ros2 for text in (b"cam", encoding.encode()))
    start = b"\0\1\0\0" if ros2 else (7).to_bytes(4, "little")
    data = _padded(start + np.array([1, 2, len(frame)], "<u4").tobytes() + frame, ros2, 4) + np.array([HEIGHT, WIDTH], "<u4").tobytes()
    data = _padded(data, ros2, 8) + np.array([1, 5_000_000], "<u8").tobytes() + len(name).to_bytes(4, "little") + name + b"\0"
    return _padded(data, ros2, 4) + (8 * len(words)).to_bytes(4, "little") + words.tobytes()


def _padded(data: bytes, ros2: bool, size: int) -> bytes:
    return data + b"\0" * (-(len(data) - 4) % size) if ros2 else data


def _bag1(folder: Path) -> Made:
    store = get_typestore(Stores.ROS1_NOETIC)
    store.register(get_types_from_msg(_PACKET, "event_camera_msgs/msg/EventPacket"))
    writer = rosbag1.Writer(folder / "events.bag")
    writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    with writer:
        connection = writer.add_connection("/events", "event_camera_msgs/msg/EventPacket", typestore=store)
        for number in range(4):
            writer.write(connection, 1_000_000 * number, ros_packet(ros2=False))
    return _alone(folder / "events.bag")


def _bag2(plugin: rosbag2.StoragePlugin, mutated: str, opened: str = "", compressed: bool = False) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        store = get_typestore(Stores.ROS2_HUMBLE)
        store.register(get_types_from_msg(_PACKET, "event_camera_msgs/msg/EventPacket"))
        writer = rosbag2.Writer(folder / "bag", version=9, storage_plugin=plugin)
        if compressed:
            writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
        with writer:
            connection = writer.add_connection("/events", "event_camera_msgs/msg/EventPacket", typestore=store)
            for number in range(4):
                writer.write(connection, 1_000_000 * number, ros_packet(ros2=True))
        return folder / "bag" / mutated, folder / "bag" / opened

    return make


_PATHS = "source: ../sequence/scene.npz\n"
_TRACK = (
    _PATHS
    + """preset: paper
tracker:
  window: {mode: time, duration_us: 5000}
  flow: {iterations: 7}
events: {strict: false, region: [0, 0, 64, 48], downscale: 1, background_us: 5000}
objects:
- label: box
  mesh: ../mesh_ply/cube.ply
  unit: m
  initial_pose: {translation_m: [0, 0, 0.5], quaternion_xyzw: [0, 0, 0, 1]}
camera: {fx: 80, fy: 80.5, cx: 31.5, cy: 23.5, width: 64, height: 48, distortion_model: plumb_bob, distortion: [-0.1, 0.01, 0, 0, 0]}
start_us: 1500
end_us: 20000
sensor_latency_us: 10
output: results
overlay: {enabled: false, frames_per_second: 30.0}
"""
)
_EVALUATE = """paths: [../sequence/scene.npz]
methods:
  mine: {preset: default, tracker: {window: {duration_us: 4000}}}
  line: {preset: line}
jobs: 1
report: sequences
output: results
lost_rotation_deg: 10.0
"""
SIMULATE = """name: small
objects:
- {label: cube, shape: cube, scale: 0.5, motion: {position_m: [0, 0, 0.6]}}
- {label: other, mesh: ../mesh_ply/cube.ply, unit: m, reflectance: 0.5}
camera: {width: 64, height: 48, fx: 80.0, fy: 80.0}
duration_s: 0.1
noise: ideal
light: {flicker_hz: 100, flicker_depth: 0.2}
variants:
  slow: {speed: 0.5}
  large: {objects: [{label: cube, shape: cube}]}
"""


def _demo(folder: Path) -> Made:
    (folder / "scene.yaml").write_text(SIMULATE)
    (folder / "demo.yaml").write_text("scene: scene.yaml\noutput: results\npreset: default\nmodels: geometry\nthreads: 1\noverlay: {stills: 2}\n")
    return _alone(folder / "demo.yaml")


def _poses(name: str) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        trajectory = _trajectory()
        if name == "tum":
            write_tum(folder / "poses.txt", trajectory)
            return _alone(folder / "poses.txt")
        rows = list(zip(trajectory.t_us.tolist(), trajectory.T_cam_obj.tolist(), strict=True))
        if name == "csv":
            lines = ["t_us,tx,ty,tz,qx,qy,qz,qw", *(f"{t},{T[0][3]},{T[1][3]},{T[2][3]},0,0,0,1" for t, T in rows)]
            (folder / "poses.csv").write_text("\n".join(lines) + "\n")
            return _alone(folder / "poses.csv")
        if name == "motive":
            head = ["Format Version,1.23,Take Name,a,Rotation Type,Quaternion,Length Units,Meters", "", ",,Type" + ",Rigid Body" * 7]
            head += [",,Name" + ",box" * 7, ",,ID" + ",1" * 7, ",," + "Rotation," * 4 + "Position,Position,Position"]
            head += ["Frame,Time (Seconds),X,Y,Z,W,X,Y,Z", *(f"{i},{1e-6 * t:.6f},0,0,0,1,{T[0][3]},0,0.5" for i, (t, T) in enumerate(rows))]
            (folder / "motive.csv").write_text("\n".join(head) + "\n")
            return _alone(folder / "motive.csv")
        entry: dict[str, Any] = {"cam_R_m2c": [1, 0, 0, 0, 1, 0, 0, 0, 1], "cam_t_m2c": [0.0, 0.0, 500.0], "obj_id": 3}
        (folder / "scene_gt.json").write_text(json.dumps({str(image): [entry] for image in range(9)}))
        return _alone(folder / "scene_gt.json")

    return make


_CALIBRATIONS = {
    "calib.txt": "199.092366542 198.82882047 132.192071378 110.712660011 -0.368436311798 0.150947243557 -0.000296130534385 -0.000759431726241 0.0",
    "own.yaml": "fx: 80.0\nfy: 80.0\ncx: 31.5\ncy: 23.5\nwidth: 64\nheight: 48\ndistortion_model: plumb_bob\ndistortion: [-0.1, 0.02, 0.0, 0.0, 0.0]\n",
    "opencv.yml": "%YAML:1.0\n---\nimage_width: 64\nimage_height: 48\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    "   data: [ 80., 0., 31.5, 0., 80., 23.5, 0., 0., 1. ]\ndistortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n"
    "   data: [ -0.1, 0.02, 0., 0., 0. ]\n",
    "ros.yaml": "image_width: 64\nimage_height: 48\ncamera_name: dvs\ncamera_matrix: {rows: 3, cols: 3, data: [80, 0, 31.5, 0, 80, 23.5, 0, 0, 1]}\n"
    "distortion_model: plumb_bob\ndistortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.02, 0, 0, 0]}\n",
    "kalibr.yaml": "cam0:\n  camera_model: pinhole\n  intrinsics: [80.0, 80.0, 31.5, 23.5]\n  distortion_model: equidistant\n"
    "  distortion_coeffs: [0.01, -0.02, 0.001, 0.0]\n  resolution: [64, 48]\n",
    "metavision.json": json.dumps(
        {"camera_matrix": [[80, 0, 31.5], [0, 80, 23.5], [0, 0, 1]], "distortion_coefficients": [0.0] * 5, "image_size": [64, 48]}
    ),
}


def _cube() -> trimesh.Trimesh:
    """A cube of 10 cm with a texture."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    image = Image.fromarray((np.indices((32, 32)).sum(0) // 8 % 2 * 200).astype(np.uint8)).convert("RGB")
    uv = np.random.default_rng(3).random((len(box.vertices), 2))
    box.visual = trimesh.visual.TextureVisuals(uv, material=trimesh.visual.material.PBRMaterial(baseColorTexture=image))
    return box


def _mesh(name: str, **options: Any) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        (trimesh.creation.box((0.1, 0.1, 0.1)) if name[-3:] != "glb" else _cube()).export(folder / name, **options)
        return _alone(folder / name)

    return make


def _obj(mutated: str) -> Callable[[Path], Made]:
    def make(folder: Path) -> Made:
        Image.fromarray((np.indices((32, 32)).sum(0) // 8 % 2 * 200).astype(np.uint8)).save(folder / "cube.png")
        (folder / "cube.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd cube.png\n")
        corners = "".join(f"v {x} {y} {z}\n" for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1))
        faces = ("1/1 2/2 4/3", "1/1 4/3 3/4", "5/1 7/2 8/3", "5/1 8/3 6/4", "1/1 5/2 6/3", "1/1 6/3 2/4")
        faces += ("3/1 4/2 8/3", "3/1 8/3 7/4", "1/1 3/2 7/3", "1/1 7/3 5/4", "2/1 6/2 8/3", "2/1 8/3 4/4")
        uv = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
        (folder / "cube.obj").write_text("mtllib cube.mtl\n" + corners + uv + "usemtl skin\n" + "".join(f"f {face}\n" for face in faces))
        return folder / mutated, folder / "cube.obj"

    return make


def _makers() -> Iterator[tuple[str, str, Callable[[Path], Made]]]:
    # Names that others refer to come first.
    yield "sequence", "sequence", _sequence
    yield "mesh_ply", "mesh", _mesh("cube.ply", encoding="binary")
    yield "container", "sequence", _container
    for kind, suffix in (("evt2", ".raw"), ("evt3", ".raw"), ("dsec", ".h5"), ("csv", ".csv")):
        yield kind, "events", _written(kind, suffix)
    yield "evt21", "events", _bytes("events.raw", _evt21())
    yield "dat", "events", _bytes("events.dat", _dat())
    yield "es_dvs", "events", _bytes("events.es", _es(1))
    yield "es_atis", "events", _bytes("events.es", _es(2))
    for number, name in ((0, "plain"), (1, "lz4"), (3, "zstd")):
        yield f"aedat4_{name}", "events", _bytes("events.aedat4", aedat4(number))
    yield "davis_text", "events", _bytes("events.txt", _davis_text())
    yield "zipped_text", "events", _zipped_text
    yield "npz", "events", _npz
    yield "prophesee_hdf5", "events", _prophesee_hdf5
    yield "bag1", "events", _bag1
    sqlite, mcap = rosbag2.StoragePlugin.SQLITE3, rosbag2.StoragePlugin.MCAP
    yield "bag2_sqlite", "events", _bag2(sqlite, "bag.db3")
    yield "bag2_zstd", "events", _bag2(sqlite, "bag.db3", compressed=True)
    yield "bag2_metadata", "events", _bag2(sqlite, "metadata.yaml")
    yield "mcap", "events", _bag2(mcap, "bag.mcap", "bag.mcap")
    yield "track", "track", _bytes("track.yaml", _TRACK)
    yield "evaluate", "evaluate", _bytes("evaluate.yaml", _EVALUATE)
    yield "simulate", "simulate", _bytes("simulate.yaml", SIMULATE)
    yield "demo", "demo", _demo
    for name, text in _CALIBRATIONS.items():
        yield f"calibration_{Path(name).stem}", "calibration", _bytes(name, text)
    for name in ("tum", "csv", "motive", "bop"):
        yield f"poses_{name}", "poses", _poses(name)
    yield "mesh_ply_text", "mesh", _mesh("cube.ply", encoding="ascii")
    yield "mesh_stl", "mesh", _mesh("cube.stl")
    yield "mesh_off", "mesh", _mesh("cube.off")
    yield "mesh_glb", "mesh", _mesh("cube.glb")
    for name in ("obj", "mtl", "png"):
        yield f"mesh_{name}", "mesh", _obj(f"cube.{name}")
    yield "lines_json", "lines", _bytes("lines.json", json.dumps({"unit": "mm", "polylines": [[[0, 0, 0], [50, 0, 0], [50, 40, 1.5]]]}))
    yield "lines_obj", "lines", _bytes("lines.obj", "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nl 1 2 3 1\n")


_MAKERS = tuple(_makers())
