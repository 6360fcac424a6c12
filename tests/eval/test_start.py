"""Initial poses that are off by a given angle, or in their roundings."""

import pytest
import torch

from torchtrack.config.run import RunConfig
from torchtrack.core.lie import rotation_angle_deg
from torchtrack.eval.start import StartError, start_angle_deg
from torchtrack.run.session import open_session


@pytest.fixture
def session(folder):
    return open_session(RunConfig(source=folder / "two.npz"))


def angles_deg(session, other):
    return rotation_angle_deg(session.T_cam_obj[:, :3, :3], other.T_cam_obj[:, :3, :3])


def test_objects_are_turned_where_they_are_each_about_an_axis_of_its_own(session):
    turned = StartError(20.0).applied(session)
    assert angles_deg(session, turned).tolist() == pytest.approx([20.0, 20.0])
    assert torch.equal(turned.T_cam_obj[:, :3, 3], session.T_cam_obj[:, :3, 3])
    turns = turned.T_cam_obj[:, :3, :3] @ session.T_cam_obj[:, :3, :3].mT
    assert not torch.allclose(turns[0], turns[1], atol=0.01)
    assert torch.equal(turned.T_cam_obj, StartError(20.0).applied(session).T_cam_obj)


def test_the_first_run_is_as_it_is_and_others_differ_by_a_rounding(session):
    first, second, third = (StartError(run=run).applied(session) for run in (1, 2, 3))
    assert torch.equal(first.T_cam_obj, session.T_cam_obj)
    assert angles_deg(session, second).tolist() == pytest.approx([5.73e-5, 5.73e-5], rel=0.01)
    assert not torch.equal(second.T_cam_obj.float(), session.T_cam_obj.float())
    assert not torch.equal(second.T_cam_obj, third.T_cam_obj)


def test_the_angle_is_that_of_the_first_pattern_that_fits():
    angles = {"start_05*": 5.0, "start_*": 20.0}
    assert [start_angle_deg(name, angles) for name in ("start_05_cube", "start_10", "far_cube")] == [5.0, 20.0, 0.0]
