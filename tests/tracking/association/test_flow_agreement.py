"""Flow as a guide: trust in observations whose flow is that of their contour."""

from dataclasses import replace

import pytest
import torch
from helpers import contours_at, pose, seen
from predicted_boxes import CONTOURS, boxes
from torch.linalg import vecdot

from torchtrack.core.padded import select_ranked, take_points
from torchtrack.tracking.association.flow_agreement import LEAST_TRUST, flow_disagreement, guided_by_flow
from torchtrack.tracking.contours.index import index_contours
from torchtrack.tracking.estimation.rounds import INDEX_CELL_PX

SPEED_M_S = 0.8
VALIDATED = torch.zeros(1, dtype=torch.float64)


def moving(covariance=None):
    """A box that moves to the right, its contours, their index, and on some of them a pixel and the true normal flow."""
    velocity = torch.tensor([[0.0, 0.0, 0.0, SPEED_M_S, 0.0, 0.0]])
    prediction = boxes(pose()[None], covariance, velocity)
    contours = prediction.objects.contours(prediction.T_cam_obj, CONTOURS)
    index = index_contours(contours, (150, 200), 7, INDEX_CELL_PX)
    normals, across = contours.normals, vecdot(contours.normals, prediction.contour_velocity(contours))
    chosen, exists = select_ranked(contours.mask & (across.abs() > 100), 200)
    assert int(exists.sum()) > 60
    chosen = chosen[:, : int(exists.sum())]
    flow = take_points(normals * across[..., None], chosen)
    return prediction, contours, index, take_points(contours.pixels, chosen), flow


def some_turned_round(flow):
    """Every fourth flow the other way, and which these are."""
    turned = torch.arange(flow.shape[1]) % 4 == 0
    return torch.where(turned[:, None], -flow, flow), turned


def trusts(moved, flow, unseen_s=0.0):
    prediction, contours, index, pixels, _ = moved
    return guided_by_flow(seen(pixels, flow=flow), index, contours, prediction, VALIDATED + unseen_s).trust[0]


def test_what_moves_as_its_contour_is_trusted_in_full():
    moved = moving()
    # Near corners of the box, the nearest contour of a cell may be the other edge.
    assert float((trusts(moved, moved[-1]) > 0.9).double().mean()) > 0.9


def test_what_moves_otherwise_counts_little_as_long_as_most_do_not():
    moved = moving()
    flow, turned = some_turned_round(moved[-1])
    trust = trusts(moved, flow)
    assert float(trust[turned].mean()) < 0.2
    assert float(trust[~turned].median()) == 1
    assert float(trust.min()) >= LEAST_TRUST


def test_where_all_disagree_it_is_the_motion_that_is_wrong():
    moved = moving()
    assert float(trusts(moved, -moved[-1]).mean()) > 4 * float(trusts(moved, some_turned_round(moved[-1])[0])[::4].mean())


def test_a_motion_that_is_not_known_disagrees_with_less():
    unknown = torch.zeros(1, 12, 12, dtype=torch.float64)
    unknown[:, 9:, 9:] = 100 * torch.eye(3)
    known, unsure = moving(), moving(unknown)
    flow, turned = some_turned_round(known[-1])
    assert float(trusts(unsure, flow)[turned].median()) > 0.9 > 0.2 > float(trusts(known, flow)[turned].median())


def test_an_object_that_was_not_seen_well_lately_is_asked_less():
    moved = moving()
    flow, turned = some_turned_round(moved[-1])
    now, soon, later = (trusts(moved, flow, time_s)[turned] for time_s in (0.0, 0.01, 1.0))
    assert float(now.mean()) < float(soon.mean()) < float(later.mean())
    assert float(later.min()) > 0.99


def test_without_flow_there_is_nothing_to_say():
    moved = moving()
    assert (trusts(moved, torch.zeros_like(moved[-1])) == 1).all()


def test_earlier_trust_multiplies():
    prediction, contours, index, pixels, flow = moving()
    observations = seen(pixels, flow=flow)
    trust = guided_by_flow(observations, index, contours, prediction, VALIDATED).trust
    again = guided_by_flow(replace(observations, trust=torch.full_like(trust, 0.5)), index, contours, prediction, VALIDATED).trust
    torch.testing.assert_close(again, 0.5 * trust)


@pytest.mark.parametrize("angle_deg", [0.0, 45.0, 90.0])
def test_disagreement_is_in_standard_deviations(angle_deg):
    """Of an upright contour that moves at a known speed, and a flow that is some of it, at an angle."""
    v = torch.arange(40.0, 60.0, dtype=torch.float64)
    contours = contours_at(torch.stack([torch.full_like(v, 80.0), v], -1)[None])
    prediction = boxes(pose(translation=(0.0, 0.0, 1.0))[None], velocity=torch.tensor([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]]))
    speed_px_s = float(prediction.contour_velocity(contours)[0, 0, 0])
    angle = torch.deg2rad(torch.tensor(angle_deg, dtype=torch.float64))
    observations = seen([[[80.0, 50.0], [140.0, 50.0]]], flow=torch.stack([angle.cos(), angle.sin()]) * speed_px_s)
    index = index_contours(contours, (150, 200), 7, INDEX_CELL_PX)
    disagreement, counts = flow_disagreement(observations, index, contours, prediction)
    off_px_s, sine = speed_px_s * (1 - float(angle.cos())), float(angle.sin())
    assert float(disagreement[0, 0]) == pytest.approx((off_px_s / (0.35 * speed_px_s + 30)) ** 2 + (sine / 0.5) ** 2, abs=1e-6)
    # The other one has no contour.
    assert counts.tolist() == [[True, False]] and float(disagreement[0, 1]) == 0
