"""HDF5 files: every layout, their sizes and filters, seeking, and faults."""

import h5py
import numpy as np
import pytest
from helpers import random_events
from io_files import SIZE, assert_same, everything
from tiny_sequence import CAMERA

from torchtrack.core.events import EventBatch
from torchtrack.errors import EventDataError, UnknownFormatError
from torchtrack.io import open_events
from torchtrack.io.container import ContainerWriter
from torchtrack.io.hdf5 import Hdf5Events
from torchtrack.io.sequence import read_sequence
from torchtrack.io.writers.hdf5 import Hdf5Writer


@pytest.fixture
def events() -> EventBatch:
    return random_events(2000, **SIZE)


def arrays(events: EventBatch) -> dict[str, np.ndarray]:
    return {
        "x": events.x.numpy().astype(np.uint16),
        "y": events.y.numpy().astype(np.uint16),
        "t": events.t_us.numpy(),
        "p": events.polarity.numpy().astype(np.uint8),
    }


def hdf5_file(folder, group: str, content: dict, **attributes):
    with h5py.File(folder / "e.h5", "w") as file:
        for name, values in content.items():
            file[f"{group}/{name}"] = values
        file.attrs.update(attributes)
    return folder / "e.h5"


@pytest.mark.parametrize("group", ["events", "prophesee/left", "/"])
def test_groups_that_hold_events(tmp_path, events, group):
    source = open_events(hdf5_file(tmp_path, group, arrays(events), **SIZE))
    assert (source.width, source.height) == (64, 48)
    assert_same(everything(source), events)


def test_seconds_are_rounded_to_the_nearest_microsecond(tmp_path, events):
    content = arrays(events)
    seconds = {"xs": content["x"], "ys": content["y"], "ts": 1e-6 * content["t"], "ps": content["p"] > 0}
    source = open_events(hdf5_file(tmp_path, "events", seconds, sensor_resolution=[48, 64]))
    assert_same(everything(source, 99), events)


def test_dsec_without_a_size_is_vga(tmp_path, events):
    path = hdf5_file(tmp_path, "events", arrays(events))
    with h5py.File(path, "a") as file:
        file["t_offset"] = np.int64(10**12)
    source = open_events(path)
    assert (source.width, source.height) == (640, 480)
    assert int(everything(source).t_us[0]) == int(events.t_us[0]) + 10**12


def test_the_table_of_milliseconds_is_as_dsec_has_it(tmp_path, events):
    writer = Hdf5Writer(tmp_path / "e.h5", 64, 48)
    for start in range(0, len(events), 300):
        writer.write(events[start : start + 300])
    writer.close()
    with h5py.File(tmp_path / "e.h5") as file:
        t, table = file["events/t"][()], file["ms_to_idx"][()]
    assert table.tolist() == np.searchsorted(t, 1000 * np.arange(len(table))).tolist()
    assert len(table) == t[-1] // 1000 + 1
    for t_us in (0, 1, 4999, 5000, 10**6):
        assert_same(everything(Hdf5Events(tmp_path / "e.h5").seek(t_us)), events[events.t_us >= t_us])


def test_prophesee_records_and_their_filter(tmp_path, events):
    content = arrays(events)
    records = np.zeros(len(events), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in ("x", "y", "p", "t"):
        records[name] = content[name]
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file["CD/events"] = records
        file.attrs["geometry"] = "64x48"
    source = open_events(tmp_path / "e.h5")
    assert (source.width, source.height) == (64, 48)
    assert_same(everything(source), events)
    if h5py.h5z.filter_avail(0x8ECF):
        pytest.skip("the filter ECF is installed")
    with h5py.File(tmp_path / "ecf.h5", "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((16384,))
        # Optional: what is created may lack it; a file of Prophesee's has it in the same place.
        plist.set_filter(0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        h5py.h5d.create(file.create_group("CD").id, b"events", h5py.h5t.py_create(records.dtype), h5py.h5s.create_simple((20_000,)), plist)
    with pytest.raises(EventDataError, match=r"ECF, which is not installed.*github\.com/prophesee-ai/hdf5_ecf.*HDF5_PLUGIN_PATH"):
        open_events(tmp_path / "ecf.h5")


def test_files_compressed_as_dsec_is(tmp_path, events):
    hdf5plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for name, values in arrays(events).items():
            file.create_dataset(f"events/{name}", data=values, **hdf5plugin.Blosc(cname="zstd"))
    assert_same(everything(open_events(tmp_path / "e.h5", strict=True)), events)


@pytest.mark.parametrize(
    ("group", "content", "error", "reason"),
    [
        ("images", {"left": [1]}, UnknownFormatError, "without events that are known.*It holds: images"),
        ("events", {"x": [1], "y": [1], "t": [1, 2], "p": [1]}, EventDataError, "of one length"),
        ("events", {"x": [[1]], "y": [[1]], "t": [[1]], "p": [[1]]}, EventDataError, "must be flat"),
        ("events", {"x": [1.5], "y": [1], "t": [1], "p": [1]}, EventDataError, "pixels are not whole"),
        ("events", {"x": [1], "y": [1], "t": [np.nan], "p": [1]}, EventDataError, "not finite"),
        ("events", {"x": ["a"], "y": [1], "t": [1], "p": [1]}, EventDataError, "'x' must hold numbers"),
    ],
)
def test_hdf5_files_that_are_wrong(tmp_path, group, content, error, reason):
    with pytest.raises(error, match=reason):
        everything(open_events(hdf5_file(tmp_path, group, content), strict=True))


def test_a_sequence_of_a_later_version(tmp_path):
    writer = ContainerWriter(tmp_path / "e.h5", CAMERA)
    writer.file.attrs["version"] = 2
    writer.close()
    with pytest.raises(EventDataError, match="version 2, but version 1 is known"):
        read_sequence(tmp_path / "e.h5")
