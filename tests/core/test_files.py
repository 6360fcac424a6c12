import os

import pytest

from torchtrack.core.files import check_is_file, is_file, naming, read_bytes
from torchtrack.core.limits import Limits, limits
from torchtrack.errors import EventDataError, LimitError, MissingExtraError, MissingFileError
from torchtrack.io import open_events


def test_what_is_no_file_is_told_as_what_it_is(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name, why in (
        ("nothing", "does not exist"),
        ("pipe", "is a pipe or a device"),
        (".", "is a folder"),
        ("a" * 300, "cannot be opened: File name"),
    ):
        with pytest.raises(MissingFileError, match=why):
            check_is_file(tmp_path / name, "file")
        assert not is_file(tmp_path / name)


@pytest.mark.parametrize("suffix", ["npz", "raw", "csv", "h5", "bag", "txt"])
def test_a_pipe_in_the_place_of_a_recording_does_not_hang(tmp_path, suffix):
    os.mkfifo(tmp_path / f"events.{suffix}")
    with pytest.raises(MissingFileError, match=r"events\.\w+' is a pipe or a device"):
        open_events(tmp_path / f"events.{suffix}")


def test_a_file_is_read_up_to_a_limit(tmp_path):
    (tmp_path / "a.yaml").write_bytes(b"12345")
    assert read_bytes(tmp_path / "a.yaml", "file", "text_bytes") == b"12345"
    with limits(Limits(text_bytes=4)), pytest.raises(LimitError, match=r"a.yaml' asks for 5 text bytes, and the limit is 4.*limits.text_bytes"):
        read_bytes(tmp_path / "a.yaml", "file", "text_bytes")


def test_an_error_is_told_with_its_file_once(tmp_path):
    for message in ("it is cut off", f"'{tmp_path / 'a.npz'}': it is cut off"):
        with pytest.raises(EventDataError) as caught, naming(tmp_path / "a.npz"):
            raise EventDataError(message)
        assert str(caught.value) == f"'{tmp_path / 'a.npz'}': it is cut off"
    with pytest.raises(EventDataError, match=r"^it is cut off$"), naming(None):
        raise EventDataError("it is cut off")
    with pytest.raises(MissingExtraError, match=r"^reading needs"), naming(tmp_path / "a.npz"):
        raise MissingExtraError("rosbags", "ros", "reading")
