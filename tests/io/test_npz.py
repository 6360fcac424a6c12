"""Events in npz files: streamed in constant memory, damage noticed."""

import zipfile

import numpy as np
import pytest
from helpers import random_events
from io_files import SIZE, assert_same, everything, peak_bytes, save_npz, save_text

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError, UnknownFormatError
from torchtrack.io import NpzEvents, open_events


@pytest.mark.parametrize("compressed", [False, True], ids=["stored", "compressed"])
def test_npz_is_streamed_in_constant_memory(tmp_path, compressed):
    count = 1_000_000
    t_us = np.arange(count)
    path = save_npz(tmp_path / "e.npz", EventBatch.from_numpy(t_us % 64, t_us % 48, t_us, t_us % 2), compressed)
    arrays_bytes = count * (8 + 2 + 2 + 1)
    assert peak_bytes(open_events(path), 10_000) < arrays_bytes / 10


@pytest.mark.parametrize("integer", ["<i8", ">i8", "<u8", "<i4"])
def test_npz_integers_of_any_size_and_order(tmp_path, integer):
    events = random_events(100, **SIZE)
    path = save_npz(tmp_path / "e.npz", events, t=events.t_us.numpy().astype(integer), x=events.x.numpy().astype(integer))
    assert_same(everything(open_events(path)), events)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"p": None}, "has no array 'p'; it holds: height, t, width, x, y"),
        ({"x": np.ones(5, dtype=np.uint16)}, "of one length, but 'x' has shape"),
        ({"t": np.ones((10, 1), dtype=np.int64), "x": np.ones((10, 1), dtype=np.int64)}, "must be flat"),
        ({"t": np.linspace(0, 1, 10)}, "'t' must be integer microseconds, got float64"),
        ({"y": np.ones(10)}, "'y' must be integer numbers, got float64"),
        ({"x": np.array([object()] * 10)}, "'x' holds Python objects"),
        ({"t": np.full(10, 2**63, dtype=np.uint64)}, "cannot be µs: that would be 292,277 years"),
        ({"width": None}, "does not say the sensor's width"),
        ({"width": np.array([64, 64])}, r"'width' must be one integer, got shape \(2,\)"),
        ({"width": np.float64(64)}, "'width' must be one integer, got .* float64"),
        ({"height": np.int64(0)}, "does not say|sensor size must be positive"),
    ],
)
def test_npz_files_that_are_refused(tmp_path, changes, message):
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE), **changes)
    with pytest.raises(EventDataError, match=message):
        list(open_events(path, strict=True).chunks())


def test_a_sensor_size_that_contradicts_the_file(tmp_path):
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE))
    assert open_events(path, 64, 48).width == 64
    with pytest.raises(EventDataError, match="width is 64, but 640 was given"):
        open_events(path, 640, 48)


def test_a_sensor_size_that_the_file_does_not_say(tmp_path):
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE), width=None, height=None)
    assert open_events(path, 100, 50).height == 50


def test_not_a_zip(tmp_path):
    path = save_text(tmp_path / "e.npz", "hello")
    with pytest.raises(UnknownFormatError, match=r"e\.npz' is not an \.npz file"):
        NpzEvents(path)


def test_a_zip_without_arrays(tmp_path):
    with zipfile.ZipFile(tmp_path / "e.zip", "w") as archive:
        archive.writestr("readme.md", "nothing here")
    with pytest.raises(UnknownFormatError, match="holds no numpy arrays"):
        open_events(tmp_path / "e.zip")


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.99])
def test_a_truncated_npz(tmp_path, keep):
    path = save_npz(tmp_path / "e.npz", random_events(1000, **SIZE))
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(EventDataError, match=r"e\.npz' is truncated or damaged"):
        open_events(path)


@pytest.mark.parametrize("compressed", [False, True], ids=["stored", "compressed"])
def test_a_changed_byte_is_noticed(tmp_path, compressed):
    path = save_npz(tmp_path / "e.npz", random_events(2000, **SIZE), compressed)
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo("p.npy")
    content[info.header_offset + 200 + info.compress_size // 2] ^= 1
    path.write_bytes(content)
    with pytest.raises(EventDataError, match="truncated or damaged"):
        list(open_events(path, strict=True).chunks())


def rewrite_member(path, key: str, content: bytes) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {**members, f"{key}.npy": content}.items():
            archive.writestr(name, data)


def test_a_header_that_promises_too_much(tmp_path):
    """Its size is compared before memory of that size is asked for."""
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE))
    header = b"{'descr': '<i8', 'fortran_order': False, 'shape': (1000000000000,), }\n"
    rewrite_member(path, "t", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    with pytest.raises(EventDataError, match=r"'t' should have shape \(1000000000000,\) of int64, but holds 0 bytes"):
        open_events(path)


@pytest.mark.parametrize("content", [b"", b"nonsense", b"\x93NUMPY\x09\x00\x00\x00", b"\x93NUMPY\x01\x00\x04\x00{}{\n"])
def test_a_header_that_cannot_be_read(tmp_path, content):
    path = save_npz(tmp_path / "e.npz", random_events(10, **SIZE))
    rewrite_member(path, "t", content)
    with pytest.raises(EventDataError, match="'t' has no readable numpy header"):
        open_events(path)


@pytest.mark.parametrize("kind", ["text", "npz"])
def test_mutated_files_never_crash(tmp_path, kind):
    """Whatever a file holds, it is read, or an error of ours says why not."""
    rng = np.random.default_rng(0)
    events = random_events(60, **SIZE)
    if kind == "text":
        rows = zip(events.t_us.tolist(), events.x.tolist(), events.y.tolist(), strict=True)
        path = save_text(tmp_path / "e.txt", "".join(f"0.{t:06d} {x} {y} 1\n" for t, x, y in rows))
    else:
        path = save_npz(tmp_path / "e.npz", events, compressed=True)
    content = np.frombuffer(path.read_bytes(), np.uint8)
    read = refused = 0
    for _ in range(300):
        mutated = content.copy()
        at = rng.integers(0, len(content), size=rng.integers(1, 6))
        mutated[at] = rng.integers(0, 256, size=len(at))
        path.write_bytes(mutated.tobytes())
        try:
            everything(open_events(path, **SIZE, strict=True))
            read += 1
        except (EventDataError, UnknownFormatError):
            refused += 1
    assert read + refused == 300
    assert refused > 100
