"""Statuses one by one, the explained share, what is in view, and the covariance against simulated noise."""

from dataclasses import replace

import pytest
import torch
from helpers import SMALL_CAMERA, generator, random_pose

from torchtrack.camera import project
from torchtrack.config.tracker import QualityConfig, SolverConfig
from torchtrack.contours import ContourKind, Contours
from torchtrack.lie import hat, se3_inverse, se3_log, transform_points
from torchtrack.matching import Matches
from torchtrack.pose_solver import PoseProblem, solve_pose
from torchtrack.quality import Status, explained_share, judge, pose_covariance, visible_share

IMAGE_SIZE = (150, 200)
CONFIG = QualityConfig()


def verdict(*, quality=1.0, count=100, in_view=1.0, turned=0.0, moved=0.0, config=CONFIG):
    """Status of one object whose prediction was turned by ``turned`` rad and moved by ``moved`` diameters."""
    step = torch.tensor([[0.6 * turned, 0.8 * turned, 0.0, 0.0, 0.0, 0.2 * moved]])
    status = judge(torch.tensor([quality]), torch.tensor([count]), torch.tensor([in_view]), step, torch.tensor([0.2]), config)
    return Status(int(status))


def contours_at(pixels, normals=(1.0, 0.0), mask=None):
    pixels = torch.as_tensor(pixels, dtype=torch.float64)
    points = torch.cat([pixels, torch.ones_like(pixels[..., :1])], -1)
    mask = torch.ones(pixels.shape[:2], dtype=torch.bool) if mask is None else torch.as_tensor(mask)
    normals = torch.tensor(normals, dtype=torch.float64).expand_as(pixels)
    return Contours(points, torch.zeros_like(points), torch.full(mask.shape, int(ContourKind.CREASE)), mask, points, pixels, normals)


def matches_at(targets, mask=None):
    targets = torch.as_tensor(targets, dtype=torch.float64)
    mask = torch.ones(targets.shape[:2], dtype=torch.bool) if mask is None else torch.as_tensor(mask)
    return Matches(torch.zeros(mask.shape, dtype=torch.int64), mask, torch.ones(mask.shape, dtype=torch.float64), targets, torch.zeros_like(targets))


def upright_line(u=80.0, count=80, first=20.0):
    v = first + torch.arange(count, dtype=torch.float64)
    return torch.stack([torch.full_like(v, u), v], -1)[None]


def share(contours, matches, velocity=(100.0, 0.0), min_speed_px_s=30.0):
    moving = torch.tensor(velocity, dtype=torch.float64).expand_as(contours.pixels)
    return explained_share(contours, matches, moving, IMAGE_SIZE, min_speed_px_s)


# ---- statuses


def test_a_good_pose_is_tracking():
    assert verdict() == Status.TRACKING


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"quality": 0.49}, Status.UNCERTAIN),
        ({"quality": 0.5}, Status.TRACKING),
        ({"quality": 0.19}, Status.LOST),
        ({"quality": 0.2}, Status.UNCERTAIN),
        ({"quality": 0.0}, Status.LOST),
        ({"count": 29}, Status.TOO_FEW_EVENTS),
        ({"count": 30}, Status.TRACKING),
        ({"count": 0}, Status.TOO_FEW_EVENTS),
        ({"in_view": 0.19}, Status.OUT_OF_VIEW),
        ({"in_view": 0.2}, Status.TRACKING),
        ({"turned": 0.51}, Status.DIVERGED),
        ({"turned": 0.49}, Status.TRACKING),
        ({"moved": 0.51}, Status.DIVERGED),
        ({"moved": 0.49}, Status.TRACKING),
        ({"turned": float("nan")}, Status.DIVERGED),
        ({"moved": float("inf")}, Status.DIVERGED),
    ],
    ids=lambda value: value.name if isinstance(value, Status) else "-".join(f"{k}={v}" for k, v in value.items()),
)
def test_each_reason_has_its_status(change, expected):
    assert verdict(**change) == expected


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"quality": 0.0, "count": 0}, Status.TOO_FEW_EVENTS),
        ({"quality": 0.0, "count": 0, "in_view": 0.0}, Status.OUT_OF_VIEW),
        ({"quality": 0.0, "count": 0, "in_view": 0.0, "turned": 1.0}, Status.DIVERGED),
    ],
)
def test_the_gravest_reason_is_told(change, expected):
    assert verdict(**change) == expected


def test_thresholds_are_those_of_the_settings():
    config = QualityConfig(min_observations=200, uncertain_below=0.9, lost_below=0.8, min_visible_share=0.7, max_step_rotation_rad=0.1)
    assert verdict(count=150, config=config) == Status.TOO_FEW_EVENTS
    assert verdict(count=250, quality=0.85, config=config) == Status.UNCERTAIN
    assert verdict(count=250, quality=0.75, config=config) == Status.LOST
    assert verdict(count=250, in_view=0.6, config=config) == Status.OUT_OF_VIEW
    assert verdict(count=250, turned=0.2, config=config) == Status.DIVERGED


def test_objects_are_judged_each_for_itself():
    status = judge(
        torch.tensor([1.0, 0.3, 0.0, 1.0]), torch.tensor([100, 100, 100, 3]), torch.ones(4), torch.zeros(4, 6), torch.full((4,), 0.2), CONFIG
    )
    assert status.tolist() == [Status.TRACKING, Status.UNCERTAIN, Status.LOST, Status.TOO_FEW_EVENTS]


# ---- the explained share


def test_a_contour_with_matches_all_along_is_explained():
    assert float(share(contours_at(upright_line()), matches_at(upright_line(u=81.0)))) == 1


def test_a_contour_without_matches_is_not():
    assert float(share(contours_at(upright_line()), matches_at(upright_line(u=120.0)))) == 0
    assert float(share(contours_at(upright_line()), matches_at(upright_line(), mask=torch.zeros(1, 80, dtype=torch.bool)))) == 0


def test_half_a_contour_is_half_explained():
    found = float(share(contours_at(upright_line()), matches_at(upright_line(count=40))))
    assert found == pytest.approx(0.5, abs=0.1)
    assert found >= 0.5


def test_what_does_not_move_need_not_be_explained():
    still = torch.cat([upright_line(60.0), upright_line(80.0)], 1)
    contours = contours_at(still)
    moving = torch.zeros_like(still)
    moving[:, 80:, 0] = 100.0
    moving[:, :80, 0] = 20.0
    matches = matches_at(upright_line(80.0))
    assert float(explained_share(contours, matches, moving, IMAGE_SIZE, 30.0)) == 1
    assert float(explained_share(contours, matches, moving, IMAGE_SIZE, 10.0)) == 0.5


def test_only_motion_across_the_contour_counts():
    """A contour that slides along itself fires no events."""
    nothing = matches_at(upright_line(150.0))
    assert float(share(contours_at(upright_line()), nothing, velocity=(0.0, 500.0))) == 1
    assert float(share(contours_at(upright_line()), nothing, velocity=(40.0, 500.0))) == 0


def test_hidden_contours_and_those_outside_the_image_need_no_explanation():
    outside = torch.cat([upright_line(80.0), upright_line(230.0), upright_line(-20.0), upright_line(60.0)], 1)
    mask = torch.ones(1, 320, dtype=torch.bool)
    mask[:, 240:] = False
    assert float(share(contours_at(outside, mask=mask), matches_at(upright_line(80.0)))) == 1


def test_hardly_anything_moving_says_nothing():
    assert float(share(contours_at(upright_line(count=15)), matches_at(upright_line(150.0)))) == 1
    assert float(share(contours_at(upright_line(count=16)), matches_at(upright_line(150.0)))) == 0


def test_matches_outside_the_image_explain_nothing():
    """Neither at the border that they would be moved to, nor on the other side of it."""
    border = torch.cat([upright_line(1.0), upright_line(198.0)], 1)
    for u in (-30.0, 230.0, -1e9):
        assert float(share(contours_at(border), matches_at(upright_line(u)))) == 0


def test_the_share_of_an_object_does_not_depend_on_the_others():
    contours = contours_at(torch.cat([upright_line(), upright_line(100.0)]))
    matches = matches_at(torch.cat([upright_line(count=80, first=60.0), upright_line(100.0)]))
    found = share(contours, matches).tolist()
    assert found[0] == float(share(contours_at(upright_line()), matches_at(upright_line(count=80, first=60.0))))
    assert found[1] == 1


# ---- in view


def test_the_visible_share_counts_points_in_the_image():
    pixels = [[[0.0, 0.0], [199.5, 149.5], [200.0, 20.0], [-0.1, 20.0], [20.0, -0.1], [20.0, 150.0], [50.0, 50.0]]]
    assert float(visible_share(contours_at(pixels), IMAGE_SIZE)) == pytest.approx(3 / 7)
    mask = [[True, True, False, False, False, False, True]]
    assert float(visible_share(contours_at(pixels, mask=mask), IMAGE_SIZE)) == 1


def test_without_contours_nothing_is_in_view():
    assert float(visible_share(contours_at([[[50.0, 50.0]]], mask=[[False]]), IMAGE_SIZE)) == 0


# ---- covariance


def noisy_problem(batch, noise_px, seed=0):
    """One body seen ``batch`` times with other noise, and its true pose."""
    T_true = random_pose(1, seed=5).expand(batch, 4, 4)
    points = 0.05 * torch.randn((1, 300, 3), generator=generator(seed), dtype=torch.float64).expand(batch, -1, -1)
    angle = 6.28 * torch.rand((1, 300), generator=generator(seed + 1), dtype=torch.float64).expand(batch, -1)
    intrinsics = SMALL_CAMERA.intrinsics(torch.float64).expand(batch, 4)
    targets = project(transform_points(T_true, points), intrinsics)
    targets = targets + noise_px * torch.randn(targets.shape, generator=generator(seed + 2), dtype=torch.float64)
    problem = PoseProblem(
        points_obj=points,
        targets=targets,
        directions=torch.stack([angle.cos(), angle.sin()], -1),
        weights=torch.ones(batch, 300, dtype=torch.float64),
        intrinsics=intrinsics,
        centre_obj=torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64).expand(batch, 3),
        scale_px=torch.full((batch,), 10.0, dtype=torch.float64),
        T_prior=T_true,
        prior_information=torch.zeros(batch, 6, 6, dtype=torch.float64),
    )
    return problem, T_true


@pytest.mark.parametrize("loss", ["tukey", "none"])
def test_the_covariance_is_that_of_simulated_noise(loss):
    problem, T_true = noisy_problem(400, 0.7)
    solution = solve_pose(problem, T_true, SolverConfig(iterations=4, loss=loss))
    error = se3_log(solution.T_cam_obj @ se3_inverse(T_true))
    empirical = error.T @ error / len(error)
    centre_cam = transform_points(solution.T_cam_obj, problem.centre_obj[:, None])[:, 0]
    predicted = pose_covariance(solution, torch.full((400,), 300), centre_cam)
    spread = empirical.diagonal().sqrt()
    ratio = predicted.mean(0) / (spread[:, None] * spread)
    assert float((ratio - empirical / (spread[:, None] * spread)).abs().max()) < 0.2
    torch.testing.assert_close(predicted, predicted.transpose(1, 2))
    assert (torch.linalg.eigvalsh(predicted) > 0).all()


def linearisation(hessian, cost=50.0):
    """A solution with another Hessian and cost."""
    batch = len(hessian)
    problem, T_true = noisy_problem(batch, 0.5)
    solution = solve_pose(problem, T_true, SolverConfig())
    return replace(solution, hessian=hessian, cost=torch.full((batch,), cost, dtype=torch.float64))


def test_the_covariance_is_of_the_left_perturbation():
    """The solver turns about the centre c: a left perturbation moves the centre by ρ + φ × c."""
    hessian = torch.diag(torch.tensor([100.0, 200.0, 300.0, 1e4, 2e4, 4e4], dtype=torch.float64))[None]
    centre = torch.tensor([[0.1, -0.2, 0.6]], dtype=torch.float64)
    covariance = pose_covariance(linearisation(hessian), torch.tensor([100]), centre)
    to_chart = torch.eye(6, dtype=torch.float64)
    to_chart[3:, :3] = -hat(centre[0])
    # The mean squared residual is one pixel²: twice the cost over the count.
    torch.testing.assert_close(to_chart @ covariance[0] @ to_chart.T, torch.linalg.inv(hessian[0]), rtol=1e-9, atol=1e-12)


def test_the_covariance_is_infinite_where_nothing_is_known_and_harms_no_neighbour():
    hessian = torch.diag(torch.tensor([100.0, 200.0, 300.0, 1e4, 2e4, 4e4], dtype=torch.float64)).repeat(4, 1, 1)
    hessian[1] = 0
    hessian[2, 0, 0] = torch.nan
    covariance = pose_covariance(linearisation(hessian), torch.tensor([100, 0, 100, 100]), torch.zeros(4, 3, dtype=torch.float64))
    for row in (1, 2):
        assert torch.isinf(covariance[row].diagonal()).all()
        assert (covariance[row][~torch.eye(6, dtype=torch.bool)] == 0).all()
    assert torch.isfinite(covariance[[0, 3]]).all()
    torch.testing.assert_close(covariance[0], covariance[3])


def test_more_noise_makes_the_pose_less_certain():
    spreads = []
    for noise_px in (0.2, 0.8):
        problem, T_true = noisy_problem(3, noise_px)
        solution = solve_pose(problem, T_true, SolverConfig(iterations=4))
        covariance = pose_covariance(solution, torch.full((3,), 300), T_true[:, :3, 3])
        spreads.append(covariance.diagonal(dim1=1, dim2=2).sqrt().mean(0))
    torch.testing.assert_close(spreads[1] / spreads[0], torch.full((6,), 4.0, dtype=torch.float64), rtol=0.1, atol=0)
