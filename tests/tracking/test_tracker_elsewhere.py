"""A tracker works in threads, in forked and in new processes, and once pickled; the poses are the same to the digit."""

import copy
import pickle
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context

import pytest
import torch
from helpers import SMALL_CAMERA, box_model, pose
from torch.utils.data import DataLoader, Dataset
from tracked_boxes import follow, moving_box, poses_of, tensors_of, windows

from torchtrack import Tracker

COUNT = 6
STARTS = (pose(), pose((0.4, -0.7, 0.3)))


def scene(number: int):
    """A tracker, its first state, and windows; of two boxes that move otherwise."""
    tracker = Tracker([box_model()], SMALL_CAMERA)
    _, events = moving_box(STARTS[number], COUNT, seed=number)
    return tracker, tracker.init(STARTS[number][None], 0), windows(events, COUNT)


def tracked(tracker, state, stream):
    """The poses of all windows."""
    with torch.inference_mode():
        return poses_of(follow(tracker, state, stream)[1])


def tracked_from_pickle(packed: bytes):
    """The same in another process."""
    torch.set_num_threads(1)
    return tracked(*pickle.loads(packed)).tolist()


@pytest.fixture(scope="module")
def alone():
    """Poses of each scene, tracked by itself."""
    return [tracked(*scene(number)) for number in range(2)]


def test_two_trackers_in_two_threads(alone):
    scenes, together = [scene(number) for number in range(2)], threading.Barrier(2)

    def run(number: int):
        together.wait()
        return tracked(*scenes[number])

    with ThreadPoolExecutor(2) as pool:
        for _ in range(3):
            for actual, expected in zip(pool.map(run, range(2)), alone, strict=True):
                assert torch.equal(actual, expected)


def test_one_tracker_in_two_threads(alone):
    tracker, _, _ = scene(0)
    with ThreadPoolExecutor(2) as pool:
        actual = pool.map(lambda number: tracked(tracker, *scene(number)[1:]), range(2))
        assert all(torch.equal(*pair) for pair in zip(actual, alone, strict=True))


class TrackedScenes(Dataset):
    """The poses of each scene, tracked where they are asked for."""

    def __len__(self) -> int:
        return 2

    def __getitem__(self, number: int):
        return tracked(*scene(number))


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks safely")
def test_forked_workers_of_a_data_loader(alone):
    # The parent has used kernels and threads by now.
    loader = DataLoader(TrackedScenes(), batch_size=None, num_workers=2, multiprocessing_context="fork", timeout=120)
    for actual, expected in zip(loader, alone, strict=True):
        assert torch.equal(actual, expected)


def test_a_pickled_tracker_goes_on_as_it_was(alone):
    tracker, state, stream = scene(1)
    with torch.inference_mode():
        state, early = follow(tracker, state, stream[:3])
    packed = pickle.dumps((tracker, state))
    again, kept = pickle.loads(packed)
    assert all(torch.equal(*pair) or torch.isnan(pair[0]).any() for pair in zip(tensors_of(state), tensors_of(kept), strict=True))
    assert torch.equal(torch.cat([poses_of(early), tracked(again, kept, stream[3:])]), alone[1])
    assert torch.equal(tracked(copy.deepcopy(tracker), *scene(1)[1:]), alone[1])


def test_a_pickled_tracker_works_in_a_new_process(alone):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        actual = pool.submit(tracked_from_pickle, pickle.dumps(scene(0))).result(timeout=240)
    assert actual == alone[0].tolist()
