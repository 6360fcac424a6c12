"""Files that ask for more than they hold, or hold more than they say."""

import struct
import zlib

import h5py
import lz4.frame
import numpy as np
import pytest
from helpers import random_events
from io_files import SIZE, save_npz, save_text

from torchtrack.core.limits import Limits, limits
from torchtrack.errors import EventDataError, LimitError
from torchtrack.io import open_events
from torchtrack.io.columns import shifted


def hdf5(path, **arrays):
    with h5py.File(path, "w") as file:
        file.attrs.update(SIZE)
        times = np.arange(100)
        for name, values in ({"x": times % 64, "y": times % 48, "t": times, "p": times % 2} | arrays).items():
            if callable(values):
                values(file, f"events/{name}")
            else:
                file[f"events/{name}"] = values
    return path


def test_values_that_were_never_written_are_no_events(tmp_path):
    def unwritten(file, name):
        file.create_dataset(name, (1 << 40,), "<i8", chunks=(1 << 16,))

    path = hdf5(tmp_path / "a.h5", **dict.fromkeys("xytp", unwritten))
    with pytest.raises(LimitError, match=r"a\.h5: /events/\w' asks for .* expansion, and the limit is 2,000.*limits.expansion"):
        open_events(path)


def test_a_large_chunk_of_zeros_is_not_unpacked(tmp_path):
    def packed(file, name):
        array = file.create_dataset(name, (1 << 20,), "<i8", chunks=(1 << 20,), compression="gzip")
        array.id.write_direct_chunk((0,), zlib.compress(bytes(8 << 20), 9))

    path = hdf5(tmp_path / "a.h5", **dict.fromkeys("xytp", packed))
    assert open_events(path, strict=True).count == 1 << 20
    with limits(Limits(block_bytes=1 << 20)), pytest.raises(LimitError, match=r"limits.block_bytes"):
        open_events(path)


@pytest.mark.parametrize(
    "elsewhere",
    [
        lambda file, name: file.update({name: h5py.ExternalLink("other.h5", "/t")}),
        lambda file, name: file.create_dataset(name, (100,), "<i8", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)]) and None,
        lambda file, name: file.create_virtual_dataset(name, h5py.VirtualLayout((100,), "<i8")) and None,
    ],
)
def test_arrays_in_other_files_are_refused(tmp_path, elsewhere):
    with pytest.raises(EventDataError, match=r"a\.h5'.* in (another file|other files)"):
        open_events(hdf5(tmp_path / "a.h5", t=elsewhere))


def test_arrays_of_anything_but_numbers_are_refused_before_they_are_read(tmp_path):
    with pytest.raises(EventDataError, match=r"a\.h5': 't' must hold numbers, got \|S5000"):
        open_events(hdf5(tmp_path / "a.h5", t=np.zeros(100, "S5000")))


def test_an_archive_that_says_more_than_the_limit_is_not_unpacked(tmp_path):
    path = save_npz(tmp_path / "a.npz", random_events(10, **SIZE), width=np.zeros(1000, np.int64), compressed=True)
    with pytest.raises(EventDataError, match=r"'width' must be one integer, got shape \(1000,\)"):
        open_events(path)


def test_times_that_would_not_fit_are_refused():
    times = np.array([0, 5], np.int64)
    assert shifted(times, 7).tolist() == [7, 12]
    for by_us in (2**63 - 3, -(2**63) - 1):
        with pytest.raises(EventDataError, match="do not fit 64 bits"):
            shifted(times, by_us)


def test_patterns_do_not_backtrack(tmp_path):
    comments = "#" * 60_000 + "\n# " + "width=1 " * 7000 + "\n# width" + " " * 50_000 + "=x\n"
    path = save_text(tmp_path / "a.csv", "# width=64 height=48\n" + comments[:50_000] + "\n1000,1,2,1\n2000,3,4,0\n")
    assert open_events(path).width == 64


def test_a_compressed_part_of_a_bag_is_unpacked_up_to_the_limit():
    compression = pytest.importorskip("torchtrack.io.ros_compression")
    packed = lz4.frame.compress(bytes(1 << 20), store_size=False)
    whole = compression._bounded(lz4.frame.LZ4FrameDecompressor, packed * 2)
    assert len(whole) == 2 << 20
    with limits(Limits(block_bytes=1 << 20)), pytest.raises(EventDataError, match=r"more than 1,048,576 bytes.*limits.block_bytes"):
        compression._bounded(lz4.frame.LZ4FrameDecompressor, packed * 2)
    with pytest.raises(EventDataError, match="cut off"):
        compression._bounded(lz4.frame.LZ4FrameDecompressor, packed[:-8])


def test_a_packet_of_aedat4_is_unpacked_up_to_the_limit(tmp_path):
    nodes = b'<node name="0" path="/outInfo/0/"><attr key="typeIdentifier" type="string">EVTS</attr>'
    nodes += b'<attr key="sizeX" type="int">64</attr><attr key="sizeY" type="int">48</attr></node>'
    header = struct.pack("<I5HHiiqI", 16, 10, 20, 4, 8, 16, 0, 12, 1, -1, 4) + struct.pack("<I", len(nodes)) + nodes
    packet = lz4.frame.compress(bytes(2 << 20))
    path = tmp_path / "a.aedat4"
    path.write_bytes(b"#!AER-DAT4.0\r\n" + struct.pack("<I", len(header)) + header + struct.pack("<ii", 0, len(packet)) + packet)
    with limits(Limits(block_bytes=1 << 20)), pytest.raises(EventDataError, match=r"more than 1,048,576 bytes; the setting limits.block_bytes"):
        list(open_events(path, strict=True).chunks())
