"""How far a pass over a file has come: by its bytes, its events or its messages."""

import zipfile

import pytest
from helpers import random_events

from torchtrack.io import open_events
from torchtrack.io.columns import Columns
from torchtrack.io.convert import WRITERS, convert
from torchtrack.io.formats import Input
from torchtrack.io.reading import Reading

SUFFIX = {"evt2": ".raw", "evt3": ".raw", "aedat4": ".aedat4", "dsec": ".h5", "npz": ".npz", "csv": ".csv"}
COUNT, DURATION_US = 300_000, 1_000_000


@pytest.fixture(scope="module")
def events():
    return random_events(COUNT, duration_us=DURATION_US)


def looks_at(source):
    """After each batch: the share, and the end that is expected."""
    return [(source.reading.share, source.reading.expected_end_us) for _ in source.chunks()]


def assert_even(looks):
    """The share grows up to the end, which is known from the first part on: events are as dense everywhere."""
    shares = [share for share, _ in looks]
    assert shares == sorted(shares) and shares[-1] > 0.9
    # Text grows with its numbers.
    assert [end_us for _, end_us in looks] == pytest.approx([DURATION_US] * len(looks), rel=0.15)


@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_the_share_that_is_read_grows_evenly(events, kind, tmp_path):
    if kind == "aedat4":
        pytest.importorskip("lz4.frame", reason="needs lz4: pip install 'torchtrack[aedat]'")
    path = tmp_path / f"events{SUFFIX[kind]}"
    writer = WRITERS[kind](path, 64, 48)
    writer.write(events)
    writer.close()
    source = open_events(path, 64, 48)
    assert_even(looks_at(source))
    # A second pass begins anew, and is at its end at the end.
    next(source.chunks())
    assert 0 < source.reading.count < COUNT
    list(source.chunks())
    assert source.reading.share == 1.0 and source.reading.count == COUNT


def test_of_text_in_an_archive(events, tmp_path):
    writer = WRITERS["csv"](tmp_path / "events.csv", 64, 48)
    writer.write(events)
    writer.close()
    with zipfile.ZipFile(tmp_path / "events.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(tmp_path / "events.csv", "events.csv")
    assert_even(looks_at(open_events(tmp_path / "events.zip", 64, 48)))


def test_of_a_bag_by_its_messages(data_dir):
    pytest.importorskip("rosbags", reason="needs rosbags: pip install 'torchtrack[ros]'")
    source = open_events(data_dir / "recordings" / "event_camera_msgs_evt3.bag")
    shares = [share for share, _ in looks_at(source)]
    assert len(shares) > 3 and shares == sorted(shares) and shares[0] < 0.5 and source.reading.share == 1.0


def test_facts_and_conversions_say_how_far_they_are(events, tmp_path):
    writer = WRITERS["evt2"](tmp_path / "events.raw", 64, 48)
    writer.write(events)
    writer.close()
    shares: list[float] = []
    open_events(tmp_path / "events.raw", 64, 48).info(progress=shares.append)
    assert shares[-1] > 0.95 and shares == sorted(shares)
    shares.clear()
    open_events(tmp_path / "events.raw", 64, 48).info(max_events=1000, progress=shares.append)
    assert shares == [1.0]
    shares.clear()
    convert(Input(tmp_path / "events.raw", 64, 48), tmp_path / "events.npz", progress=shares.append)
    assert shares[-1] > 0.95 and shares == sorted(shares)


def test_nothing_is_expected_before_anything_is_known():
    reading = Reading()
    assert reading.expected_end_us is None
    reading.add(Columns.from_batch(random_events(10)))
    assert reading.count == 10 and reading.share is None and reading.expected_end_us is None
