"""ADD, ADD-S, MSSD, MSPD and their AUC against the formulas written out point by point, as bop_toolkit has them."""

import math

import numpy as np
import pytest
import torch
import trimesh
from helpers import random_pose

from torchtrack.core.lie import se3_exp
from torchtrack.errors import PoseError
from torchtrack.eval.surface_errors import add_m, adds_m, auc, model_points, mspd_px, mssd_m, surface_errors, symmetries_of
from torchtrack.object_model import ObjectModel

POINTS = torch.from_numpy(np.random.default_rng(0).normal(size=(40, 3)) * 0.05)
TRUE = random_pose(5, seed=1)
TRUE[:, 2, 3] = TRUE[:, 2, 3].abs() + 0.5
ESTIMATED = se3_exp(torch.from_numpy(np.random.default_rng(2).normal(size=(5, 6)) * 0.1)) @ TRUE
HALF_TURN = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
HALF_TURN[:3, 3] = torch.tensor([0.01, 0.0, 0.002], dtype=torch.float64)
K = torch.tensor([[300.0, 0, 160], [0, 310, 120], [0, 0, 1]], dtype=torch.float64)


def moved(T, point):
    return T[:3, :3].numpy() @ point + T[:3, 3].numpy()


def distances(T, other):
    """Of every point at one pose from every point at another."""
    return np.array([[math.dist(moved(T, p), moved(other, q)) for q in POINTS.numpy()] for p in POINTS.numpy()])


def test_add_and_adds():
    expected = [distances(estimated, true) for estimated, true in zip(ESTIMATED, TRUE, strict=True)]
    np.testing.assert_allclose(add_m(ESTIMATED, TRUE, POINTS), [np.diag(table).mean() for table in expected], rtol=1e-9)
    # To each true point, the nearest estimated one.
    np.testing.assert_allclose(adds_m(ESTIMATED, TRUE, POINTS), [table.min(0).mean() for table in expected], rtol=1e-9)


def test_mssd_and_mspd_take_the_symmetry_that_fits_best():
    estimated = ESTIMATED.clone()
    estimated[3:] = estimated[3:] @ HALF_TURN
    symmetries = symmetries_of([HALF_TURN.tolist()])
    in_space, in_image = [], []
    for T, true in zip(estimated, TRUE, strict=True):
        tables = [[(moved(T, p), moved(true @ symmetry, p)) for p in POINTS.numpy()] for symmetry in symmetries]
        in_space.append(min(max(math.dist(a, b) for a, b in table) for table in tables))
        pixels = [[[(K.numpy() @ p)[:2] / p[2] for p in pair] for pair in table] for table in tables]
        in_image.append(min(max(math.dist(a, b) for a, b in table) for table in pixels))
    np.testing.assert_allclose(mssd_m(estimated, TRUE, POINTS, symmetries), in_space, rtol=1e-9)
    np.testing.assert_allclose(mspd_px(estimated, TRUE, POINTS, symmetries, K), in_image, rtol=1e-9)
    # Without the symmetry those that are turned by it are wrong.
    alone = mssd_m(estimated, TRUE, POINTS, symmetries_of())
    assert alone[:3].tolist() == pytest.approx(in_space[:3]) and bool((alone[3:] > torch.tensor(in_space[3:])).all())


@pytest.mark.parametrize("case", ["random", "doubles", "all within"])
def test_auc_is_that_of_the_curve(case):
    random = np.random.default_rng(3)
    errors = {"random": random.uniform(0, 0.15, 200), "doubles": np.repeat([0.02, 0.05, 0.3], 3), "all within": random.uniform(0, 0.01, 50)}[case]
    # YCB-Video's toolbox lets the share that an error makes count from the error before it on.
    known = np.sort(errors)
    thresholds = (np.arange(400_000) + 0.5) / 4e6
    # The first error at or above each threshold, of those that count.
    rank = np.searchsorted(known, thresholds, side="left")
    within = int((known <= 0.1).sum())
    expected = np.minimum(rank + 1, within).mean() / len(errors)
    assert auc(torch.from_numpy(errors)) == pytest.approx(expected, abs=2e-5)
    # It is above the area under the stairs themselves by no more than one error's share.
    stairs = np.searchsorted(known, thresholds, side="right").mean() / len(errors)
    assert stairs <= auc(torch.from_numpy(errors)) <= stairs + 1 / len(errors) + 1e-4


def test_auc_at_its_ends():
    assert auc(torch.zeros(4)) == pytest.approx(1.0)
    assert auc(torch.full((4,), 0.2)) == 0.0
    assert math.isnan(auc(torch.zeros(0)))
    assert auc(torch.tensor([0.05, 1.0]), limit_m=0.1) == pytest.approx(0.5)


def test_of_a_model():
    model = ObjectModel.from_mesh(trimesh.creation.box((0.1, 0.08, 0.06)), name="box")
    assert 500 <= len(model_points(model)) <= 1000
    shifted = TRUE.clone()
    shifted[:, 0, 3] += 0.004
    errors = surface_errors(shifted, TRUE, model)
    assert errors.mean_add_mm == pytest.approx(4.0) and errors.mean_adds_mm < 4.0
    assert errors.recall_add == 1.0 and errors.auc_add < errors.auc_adds < 1.0
    # Up to 4 mm counts the share of the first of five, from there on all.
    assert errors.auc_add == pytest.approx((0.2 * 4 + 96) / 100)
    far = TRUE.clone()
    far[:, 2, 3] += 0.05
    assert surface_errors(far, TRUE, model).recall_add == 0.0
    assert math.isnan(surface_errors(TRUE[:0], TRUE[:0], model).mean_add_mm)


def test_polylines_are_their_ends():
    lines = ObjectModel.from_polylines([[[0, 0, 0], [80, 0, 0], [80, 50, 0]]], unit="mm")
    assert model_points(lines).shape == (4, 3)


def test_symmetries_that_are_no_matrices():
    assert symmetries_of().shape == (1, 4, 4)
    with pytest.raises(PoseError, match=r"shape \[s, 4, 4\], got \[1, 3, 3\]"):
        symmetries_of([np.eye(3).tolist()])
