"""Archives, HDF5 files, packets and messages that say one size and have another, or grow without end when they are unpacked."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import lz4.frame
import numpy as np
import zstandard
from rosbags import rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from seeds import HEIGHT, WIDTH, aedat4

Make = Callable[[Path], None]
_SIZE = {"width": np.int64(WIDTH), "height": np.int64(HEIGHT)}


def array_inputs() -> Iterator[tuple[str, str, str, Make]]:
    """Name, kind, file, and what makes it."""
    yield from _npz_inputs()
    yield from _hdf5_inputs()
    for name, make in (("lz4", _lz4_bomb), ("zstd", _zstd_bomb), ("zstd_window", _zstd_window), ("zstd_size", _zstd_size)):
        yield f"aedat4_{name}", "events", "x.aedat4", partial(_aedat4_packet, make=make)
    yield "aedat4_packets", "events", "x.aedat4", lambda path: path.write_bytes(aedat4(0, 0) + struct.pack("<ii", 0, 0) * 500_000)
    yield "aedat4_header", "events", "x.aedat4", lambda path: path.write_bytes(b"#!AER-DAT4.0\r\n" + b"\xff\xff\xff\x7f" + bytes(100))
    yield "aedat4_nodes", "events", "x.aedat4", _aedat4_nodes
    yield "mcap_zstd", "events", "x.mcap", partial(_mcap_chunk, kind="zstd", make=_zstd_bomb)
    yield "mcap_zstd_size", "events", "x.mcap", partial(_mcap_chunk, kind="zstd", make=_zstd_size)
    yield "mcap_lz4", "events", "x.mcap", partial(_mcap_chunk, kind="lz4", make=_lz4_bomb)
    yield (
        "mcap_length",
        "events",
        "x.mcap",
        lambda path: path.write_bytes(b"\x89MCAP0\r\n" + b"\x01" + struct.pack("<Q", 1 << 62) + bytes(99) + b"\x89MCAP0\r\n"),
    )
    yield "bag1_length", "events", "x.bag", lambda path: path.write_bytes(b"#ROSBAG V2.0\n" + struct.pack("<I", 0xFFFFFFF0) + bytes(99))
    yield "bag2_zstd_message", "events", "bag", partial(_bag2_message, make=_zstd_bomb)
    yield "bag2_zstd_size", "events", "bag", partial(_bag2_message, make=_zstd_size)


def _header(shape: str, kind: str = "<i8") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) % 65536) + text


def _archive(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name), content, method)


def _array(values: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, values)
    return stream.getvalue()


def _members(**changes: bytes) -> dict[str, bytes]:
    times = np.arange(100, dtype=np.int64)
    sound: dict[str, Any] = {"t": times, "x": times % WIDTH, "y": times % HEIGHT, "p": times % 2, **_SIZE}
    return {f"{name}.npy": _array(values) for name, values in sound.items()} | {f"{name}.npy": content for name, content in changes.items()}


def _sequence_members(**changes: bytes) -> dict[str, bytes]:
    more: dict[str, Any] = {
        "K": np.array([[80, 0, 31.5], [0, 80, 23.5], [0, 0, 1]]),
        "labels": np.array(["box"]),
        "mesh_files": np.array(["../mesh_ply/cube.ply"]),
        "poses": np.tile(np.eye(4), (3, 1, 1)),
        "pose_t": np.arange(3),
    }
    return _members(**{name: _array(values) for name, values in more.items()} | changes)


def _npz_inputs() -> Iterator[tuple[str, str, str, Make]]:
    def npz(name: str, kind: str = "events", **changes: bytes) -> tuple[str, str, str, Make]:
        members = _members(**changes) if kind == "events" else _sequence_members(**changes)
        return f"npz_{name}", kind, "x.npz", partial(_archive, members=members)

    bomb = _header("(67108864,)") + bytes(1 << 26)
    yield npz("width_bomb", width=bomb)
    yield npz("huge_shape", t=_header("(4611686018427387904,)"))
    yield npz("negative_shape", t=_header("(-5,)"))
    yield npz("product_overflows", width=_header("(4294967296, 4294967296, 4294967296)"))
    yield npz("empty_and_huge", width=_header("(0, 4611686018427387904)"))
    yield npz("objects", t=_header("(1,)", "|O") + b"cos\nsystem\n(S'echo'\ntR.")
    yield npz("no_bytes", t=_header("(100,)", "V0"), x=_header("(100,)", "V0"), y=_header("(100,)", "V0"), p=_header("(100,)", "V0"))
    yield npz("wide", width=_header("(1,)", "|S100000000"))
    yield npz("text_width", width=_array(np.array("wide")))
    yield npz("wide_width", width=_array(np.uint64(2**64 - 1)), height=_array(np.uint64(2**64 - 1)))
    yield npz("large_sensor", width=_array(np.int64(65536)), height=_array(np.int64(65536)))
    yield npz("negative_sensor", width=_array(np.int64(-5)))
    yield npz("dates", t=_array(np.arange(100).astype("M8[us]")))
    yield npz("complex", x=_array(np.arange(100) * 1j))
    yield npz("times_beyond", t=_array(np.arange(100, dtype=np.uint64) + np.uint64(2**63)))
    yield npz("pixels_beyond", x=_array(np.arange(100, dtype=np.uint64) + np.uint64(2**63)))
    yield npz("big_endian", t=_array(np.arange(100, dtype=">i8")))
    yield npz("strings", p=_array(np.array(["on"] * 100)))
    yield npz("records", t=_array(np.zeros(100, np.dtype([("a", "<i8")]))))
    for name, text in (
        ("nested_header", b"(" * 9000),
        ("long_header", b"{'descr': '<i8'" + b" " * 60_000 + b"}"),
        ("number_header", b"{'descr': '<i8', 'fortran_order': False, 'shape': (" + b"9" * 6000 + b",)}"),
        ("minus_header", b"-" * 9000 + b"1"),
        ("descr_header", b"{'descr': [('a', '<i8', (1000000000, 1000000000))], 'fortran_order': False, 'shape': (1,)}"),
        ("descr_nested", b"{'descr': " + b"[('a', " * 200 + b"'<i8'" + b")]" * 200 + b", 'fortran_order': False, 'shape': (1,)}"),
        ("tokens_header", b"{'descr': '<i8', 'fortran_order': False, 'shape': (1L,)" + b"'''"),
    ):
        yield npz(name, t=b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text)
    yield npz("version_9", t=b"\x93NUMPY\x09\x00" + bytes(20))
    yield npz("poses_bomb", "sequence", poses=_header("(20971520, 4, 4)", "<f8") + bytes(1 << 24))
    yield npz("poses_nan", "sequence", poses=_array(np.full((3, 4, 4), np.nan)))
    yield npz("poses_huge", "sequence", poses=_array(np.tile(np.eye(4), (3, 1, 1)) * 1e308))
    yield npz("pose_times", "sequence", pose_t=_array(np.array([-(2**63), 0, 2**63 - 1])))
    yield npz("pose_times_beyond", "sequence", pose_t=_array(np.array([1, 2, 2**64 - 1], np.uint64)))
    yield npz("poses_text", "sequence", poses=_array(np.array(["a"])))
    yield npz("meta_nested", "sequence", meta=_array(np.array("[" * 100_000)))
    yield npz("meta_number", "sequence", meta=_array(np.array("9" * 6000)))
    yield npz("labels_numbers", "sequence", labels=_array(np.arange(3)))
    yield npz("labels_path", "sequence", labels=_array(np.array(["../../box"])))
    yield npz("labels_long", "sequence", labels=_array(np.array(["a" * 5000])))
    yield npz("mesh_long", "sequence", mesh_files=_array(np.array(["a" * 5000])))
    yield npz("mesh_null", "sequence", mesh_files=_array(np.array(["a\0b"])))
    yield npz("mesh_folder", "sequence", mesh_files=_array(np.array(["."])))
    yield npz("mesh_device", "sequence", mesh_files=_array(np.array(["/dev/zero"])))
    yield npz("labels_surrogate", "sequence", labels=_array(np.array(["\ud800"])), mesh_files=_array(np.array(["\udfff.ply"])))
    yield npz("K_infinite", "sequence", K=_array(np.full((3, 3), np.inf)))
    yield npz("K_tiny", "sequence", K=_array(np.array([[1e-300, 0, 0], [0, 1e-300, 0], [0, 0, 1]])))
    yield npz("K_text", "sequence", K=_array(np.full((3, 3), "a")))
    yield npz("distortion", "sequence", distortion=_array(np.array([1e300] * 5)), distortion_model=_array(np.array("plumb_bob")))
    yield npz("distortion_model", "sequence", distortion=_array(np.array([0.1] * 4)), distortion_model=_array(np.array([b"\xff\xfe"])))
    yield "zip_bzip2", "events", "x.npz", lambda path: _damaged_method(path, zipfile.ZIP_BZIP2)
    yield "zip_lzma", "events", "x.npz", lambda path: _damaged_method(path, zipfile.ZIP_LZMA)
    yield "zip_method", "events", "x.npz", lambda path: _patched(path, b"PK\x01\x02", 10, struct.pack("<H", 97))
    yield "zip_locked", "events", "x.npz", lambda path: _patched(path, b"PK\x01\x02", 8, struct.pack("<H", 1))
    yield "zip_size", "events", "x.npz", lambda path: _patched(path, b"PK\x01\x02", 24, struct.pack("<I", 0xFFFFFFF0))
    yield "zip_offset", "events", "x.npz", lambda path: _patched(path, b"PK\x01\x02", 42, struct.pack("<I", 0x7FFFFFF0))
    yield "zip_version", "events", "x.npz", lambda path: _patched(path, b"PK\x01\x02", 6, struct.pack("<H", 99))
    yield "zip_members", "events", "x.npz", lambda path: _archive(path, {f"{n}.txt": b"" for n in range(20_000)})
    yield "zip_text_bomb", "events", "x.zip", lambda path: _archive(path, {"events.txt": b" " * (64 << 20)})
    yield "zip_zeros_bomb", "events", "x.zip", lambda path: _archive(path, {"events.txt": b"0.001 1 2 1\n" + bytes(64 << 20)})
    yield "zip_no_text", "events", "x.zip", lambda path: _archive(path, {"a.png": b"", "b/": b""})
    yield "zip_only_end", "events", "x.zip", lambda path: path.write_bytes(b"PK\x05\x06" + bytes(18))
    yield "zip_cut", "events", "x.zip", lambda path: path.write_bytes(b"PK\x03\x04" + bytes(18))


def _patched(path: Path, magic: bytes, offset: int, content: bytes) -> None:
    """An archive with some bytes of its table of contents replaced."""
    _archive(path, _members())
    data = bytearray(path.read_bytes())
    at = data.find(magic) + offset
    data[at : at + len(content)] = content
    path.write_bytes(data)


def _damaged_method(path: Path, method: int) -> None:
    _archive(path, _members(), method)
    data = bytearray(path.read_bytes())
    for at in range(60, 90):
        data[at] ^= 0x5A
    path.write_bytes(data)


def _hdf5(path: Path, fill: Callable[[h5py.File], None]) -> None:
    with h5py.File(path, "w") as file:
        file.attrs["width"], file.attrs["height"] = WIDTH, HEIGHT
        fill(file)


def _events_group(file: h5py.File, **changes: Any) -> None:
    times = np.arange(1000)
    for name, values in ({"x": times % WIDTH, "y": times % HEIGHT, "t": times, "p": times % 2} | changes).items():
        if values is not None:
            file[f"events/{name}"] = values


def _hdf5_inputs() -> Iterator[tuple[str, str, str, Make]]:
    def given(name: str, fill: Callable[[h5py.File], None]) -> tuple[str, str, str, Make]:
        return f"hdf5_{name}", "events", "x.h5", partial(_hdf5, fill=fill)

    def each(**options: Any) -> Callable[[h5py.File], None]:
        def fill(file: h5py.File) -> None:
            for name in "xytp":
                file.create_dataset(f"events/{name}", dtype="<i8", **options)

        return fill

    yield given("fill_values", each(shape=(1 << 40,), chunks=(1 << 16,), fillvalue=7))
    yield given("fill_some", each(shape=(1 << 31,), chunks=(1 << 16,)))
    yield given("fill_one_chunk", each(shape=(1 << 29,), chunks=(1 << 28,), compression="gzip"))
    yield given("fill_late", each(shape=(1 << 33,)))
    yield given("zeros", _zeros)
    yield given("large_chunk", _large_chunk)
    yield given("ranks", partial(_events_group, x=np.zeros((10, 10)), y=np.zeros((10, 10)), t=np.zeros((10, 10)), p=np.zeros((10, 10))))
    yield given("scalars", partial(_events_group, x=1, y=1, t=1, p=1))
    yield given("null_space", partial(_events_group, **{name: h5py.Empty("i8") for name in "xytp"}))
    yield given("text", partial(_events_group, t=np.array(["a"] * 1000, dtype=h5py.string_dtype())))
    yield given("records", partial(_events_group, t=np.zeros(1000, np.dtype([("a", "<i8")]))))
    yield given("nested_arrays", partial(_events_group, t=np.zeros(1000, np.dtype(("<i8", (3,))))))
    yield given("complex", partial(_events_group, t=np.zeros(1000, np.complex128)))
    yield given("wide_text", partial(_events_group, t=np.zeros(1000, "S5000")))
    yield given("nan_times", partial(_events_group, t=np.full(1000, np.nan)))
    yield given("huge_times", partial(_events_group, t=np.full(1000, 1e300)))
    yield given("half_times", partial(_events_group, t=np.arange(1000, dtype=np.float16)))
    yield given("times_beyond", partial(_events_group, t=np.arange(1000, dtype=np.uint64) + np.uint64(2**63)))
    yield given("pixels_beyond", partial(_events_group, x=np.arange(1000, dtype=np.uint64) + np.uint64(2**63)))
    yield given("pixels_nan", partial(_events_group, x=np.full(1000, np.nan)))
    yield given("polarity_text", partial(_events_group, p=np.array([b"1"] * 1000)))
    yield given("offset", partial(_events_group, t_offset=np.int64(2**63 - 1)))
    yield given("offset_beyond", partial(_events_group, t_offset=np.uint64(2**64 - 1)))
    yield given("offset_nan", partial(_events_group, t_offset=np.nan))
    yield given("ms_to_idx", partial(_events_group, ms_to_idx=np.full(10_000, -(2**63))))
    yield given("lengths", partial(_events_group, p=np.zeros(5)))
    yield given("soft_loop", lambda file: file.update({"events": h5py.SoftLink("/events")}))
    yield given("soft_loops", _soft_loops)
    yield given("soft_dangling", partial(_events_group, t=h5py.SoftLink("/nothing")))
    yield given("external_link", partial(_events_group, t=h5py.ExternalLink("other.h5", "/t")))
    yield given("external_device", partial(_events_group, t=h5py.ExternalLink("/dev/zero", "/t")))
    yield given("external_file", _external_storage)
    yield given("virtual", _virtual)
    yield given("attributes_text", lambda file: (_events_group(file), file.attrs.update({"width": "wide", "height": [1, 2]}))[0])
    yield given("attributes_empty", lambda file: (_events_group(file), file.attrs.update({"width": h5py.Empty("f"), "height": h5py.Empty("f")}))[0])
    yield given("attributes_nan", lambda file: (_events_group(file), file.attrs.update({"width": np.nan, "height": np.inf}))[0])
    yield given("attributes_large", lambda file: (_events_group(file), file.attrs.update({"width": 65536, "height": 65536}))[0])
    yield given("geometry", lambda file: (_events_group(file), file.attrs.__delitem__("width"), file.attrs.update({"geometry": b"9x" * 9000}))[0])
    yield given(
        "resolution", lambda file: (_events_group(file, calib=None), file.attrs.clear(), file.update({"resolution": np.array([np.nan, 1])}))[0]
    )
    yield given("resolution_large", _large_resolution)
    yield given(
        "other_records", lambda file: file.update({"CD/events": np.zeros(5, np.dtype([("x", "S3"), ("y", "<u2"), ("p", "<i2"), ("t", "<f4", (2,))]))})
    )
    for name, changes in (
        ("version", {"version": "one"}),
        ("meta", {"meta": "[" * 100_000}),
        ("meta_bytes", {"meta": np.void(b"\xff" * 100)}),
    ):
        yield f"container_{name}", "sequence", "x.h5", partial(_container, attributes=changes)
    for name, group in (
        ("no_camera", {}),
        ("camera_text", {"camera/K": "text"}),
        ("camera_large", {"camera/K": np.full((3, 3), 1e308)}),
        ("objects_data", {"camera/K": np.eye(3), "objects": 5}),
        ("extra_huge", {"camera/K": np.eye(3), "objects/a/mesh": np.zeros(5, np.uint8), "extra/a": ("fill", (1 << 40,))}),
        ("mesh_huge", {"camera/K": np.eye(3) * 50, "objects/a/mesh": ("fill", (1 << 40,))}),
        ("mesh_text", {"camera/K": np.eye(3) * 50, "objects/a/mesh": "text"}),
        ("poses_huge", {"camera/K": np.eye(3) * 50, "objects/a/mesh": np.zeros(5, np.uint8), "objects/a/poses": ("fill", (1 << 30, 4, 4)), "objects/a/pose_t": np.arange(3)}),
        ("poses_wrong", {"camera/K": np.eye(3) * 50, "objects/a/mesh": np.zeros(5, np.uint8), "objects/a/poses": np.zeros((3, 4, 4)), "objects/a/pose_t": ["a"]}),
    ):  # fmt: skip
        yield f"container_{name}", "sequence", "x.h5", partial(_container, content=group)


def _container(path: Path, content: dict[str, Any] | None = None, attributes: dict[str, Any] | None = None) -> None:
    with h5py.File(path, "w") as file:
        file.attrs.update({"width": WIDTH, "height": HEIGHT, "format": "torchtrack-sequence", "version": 1, "meta": "{}"} | (attributes or {}))
        _events_group(file)
        for name, values in (content if content is not None else {"camera/K": np.eye(3) * 50}).items():
            if isinstance(values, tuple):
                file.create_dataset(name, values[1], "u1" if "mesh" in name else "<f8", chunks=True)
            else:
                file[name] = values
        for group in file.get("objects", {}).values() if isinstance(file.get("objects"), h5py.Group) else ():
            group.attrs["index"] = 0
            if "mesh" in group:
                group["mesh"].attrs["suffix"] = ".ply"


def _zeros(file: h5py.File) -> None:
    """Chunks of 128 MB of zeros, which take a hundredth of a per cent of that."""
    chunk = zlib.compress(bytes(1 << 27), 1)
    for name in "xytp":
        array = file.create_dataset(f"events/{name}", (1 << 32,), "<i8", chunks=(1 << 24,), compression="gzip")
        for number in range(4):
            array.id.write_direct_chunk((number << 24,), chunk)


def _large_chunk(file: h5py.File) -> None:
    chunk = zlib.compress(bytes(1 << 29), 1)
    for name in "xytp":
        array = file.create_dataset(f"events/{name}", (1 << 26,), "<i8", chunks=(1 << 26,), compression="gzip")
        array.id.write_direct_chunk((0,), chunk)


def _soft_loops(file: h5py.File) -> None:
    file["a"], file["b"] = h5py.SoftLink("/b"), h5py.SoftLink("/a")
    file["events/x"], file["events/y"], file["events/t"], file["events/p"] = (h5py.SoftLink("/a") for _ in range(4))


def _external_storage(file: h5py.File) -> None:
    for name in "xytp":
        file.create_dataset(f"events/{name}", (1 << 20,), "<i8", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])


def _virtual(file: h5py.File) -> None:
    for name in "xytp":
        layout = h5py.VirtualLayout(shape=(1 << 40,), dtype="<i8")
        layout[:1000] = h5py.VirtualSource("nothing.h5", "x", shape=(1000,))
        file.create_virtual_dataset(f"events/{name}", layout)


def _large_resolution(file: h5py.File) -> None:
    file.attrs.clear()
    _events_group(file)
    file.create_dataset("resolution", (1 << 40,), "<i8", chunks=(1 << 16,))


def _lz4_bomb() -> bytes:
    return lz4.frame.compress(bytes(400 << 20), block_size=lz4.frame.BLOCKSIZE_MAX4MB, store_size=False)


def _zstd_bomb() -> bytes:
    squeezer = zstandard.ZstdCompressor(level=1).compressobj()
    block = bytes(64 << 20)
    return b"".join(squeezer.compress(block) for _ in range(48)) + squeezer.flush()


def _zstd_window() -> bytes:
    """A frame that asks for a window of 2 GB."""
    return b"\x28\xb5\x2f\xfd\x00" + bytes([(31 - 10) << 3]) + b"\x03\x00\x00\x00\x00"


def _zstd_size() -> bytes:
    """A frame that says that it holds 2^60 bytes."""
    return b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 60) + b"\x03\x00\x00" + bytes(8)


def _aedat4_packet(path: Path, make: Callable[[], bytes]) -> None:
    packet = make()
    path.write_bytes(aedat4(1 if make is _lz4_bomb else 3, 0) + struct.pack("<ii", 0, len(packet)) + packet)


def _aedat4_nodes(path: Path) -> None:
    nodes = b'<node name="0" path="/outInfo/0/">' * 60_000 + b'<node name="' * 60_000
    header = struct.pack("<I", 16) + struct.pack("<HHHHH", 10, 20, 4, 8, 16) + b"\0\0" + struct.pack("<iiqI", 12, 0, -1, 4)
    header += len(nodes).to_bytes(4, "little") + nodes
    path.write_bytes(b"#!AER-DAT4.0\r\n" + len(header).to_bytes(4, "little") + header)


def _mcap_chunk(path: Path, kind: str, make: Callable[[], bytes]) -> None:
    """An MCAP file of one chunk, which says that it has a few bytes, and no index."""

    def record(code: int, content: bytes) -> bytes:
        return bytes([code]) + struct.pack("<Q", len(content)) + content

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    packed = make()
    chunk = struct.pack("<QQQI", 0, 10, 1000, 0) + text(kind) + struct.pack("<Q", len(packed)) + packed
    schema = struct.pack("<H", 1) + text("event_camera_msgs/msg/EventPacket") + text("ros2msg") + text("uint8 a")
    channel = struct.pack("<HH", 0, 1) + text("/events") + text("cdr") + struct.pack("<I", 0)
    magic, start = b"\x89MCAP0\r\n", 8
    head = record(1, text("ros2") + text("test"))
    body = record(6, chunk)
    data_end = record(15, bytes(4))
    index_at = start + len(head)
    summary = record(3, schema) + record(4, channel)
    indices = record(
        8,
        struct.pack("<QQQQ", 0, 10, index_at, len(body))
        + struct.pack("<I", 0)
        + struct.pack("<Q", 0)
        + text(kind)
        + struct.pack("<QQ", len(packed), 1000),
    )
    statistics = record(11, struct.pack("<QHIIIIQQ", 4, 1, 1, 0, 0, 1, 0, 10) + struct.pack("<I", 10) + struct.pack("<HQ", 0, 4))
    summary_at = index_at + len(body) + len(data_end)
    footer = record(2, struct.pack("<QQI", summary_at, 0, 0))
    path.write_bytes(magic + head + body + data_end + summary + indices + statistics + footer + magic)


def _bag2_message(path: Path, make: Callable[[], bytes]) -> None:
    """A recording whose messages are compressed, one of them without end."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg("std_msgs/Header header\nuint8[] events", "event_camera_msgs/msg/EventPacket"))
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/events", "event_camera_msgs/msg/EventPacket", typestore=store)
        writer.write(connection, 1, make())
    metadata = path / "metadata.yaml"
    text = metadata.read_text()
    marked = text.replace("compression_format: ''", "compression_format: zstd").replace("compression_mode: ''", "compression_mode: message")
    if marked == text:
        marked = text.replace('compression_format: ""', "compression_format: zstd").replace('compression_mode: ""', "compression_mode: message")
    metadata.write_text(marked)
