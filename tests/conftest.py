"""Fixtures that every test may use. Shapes and types of the whole package are checked in the first calls of each test."""

import os
from pathlib import Path

import jaxtyping
import pytest
import torch
from first_calls import check_again
from places import REPOSITORY

if not torch.cuda.is_available():
    # Must come before the first import of Triton: without a GPU, its kernels are interpreted.
    os.environ.setdefault("TRITON_INTERPRET", "1")

# Must come before the first import of torchtrack: it wraps the package's functions as they are loaded.
jaxtyping.install_import_hook("torchtrack", "first_calls.checked")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup():
    """What has been checked in another test is checked again."""
    check_again()


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """One thread per worker: several on busy cores are slower, and sums would differ between runs."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the shared data (``$TORCHTRACK_DATA``, else ``../shared/data``); tests are skipped where it is absent."""
    path = Path(os.environ.get("TORCHTRACK_DATA", REPOSITORY.parent / "shared" / "data"))
    if not path.is_dir():
        pytest.skip(f"no data at {path}; set TORCHTRACK_DATA to the folder that holds sequences/ and recordings/")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a sequence of one object and one of two."""
    # Not at the top: what it imports must find the hook in place.
    from tiny_sequence import write_tiny_sequence

    folder = tmp_path_factory.mktemp("sequences")
    write_tiny_sequence(folder, "one", duration_us=30_000)
    write_tiny_sequence(folder, "two", labels=("left", "right"), duration_us=20_000)
    return folder


def _devices() -> list[str]:
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


@pytest.fixture(params=_devices())
def device(request) -> torch.device:
    """Every device of this machine."""
    return torch.device(request.param)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request) -> torch.dtype:
    """Both floating types that the tracker runs in."""
    return request.param


@pytest.fixture(params=[True, False], ids=["kernels", "operations"])
def way(request):
    """Kernels, where there are any, and PyTorch's operations: that of this test."""
    # Not at the top: what it imports must find the hook in place.
    from torchtrack.core import dispatch

    with dispatch.backend(wanted=request.param):
        yield
