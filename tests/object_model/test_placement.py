"""Unit, scale and origin of a model, whatever it is made of."""

import numpy as np
import pytest
import torch
import trimesh

from torchtrack.errors import ModelError
from torchtrack.object_model import ObjectModel
from torchtrack.object_model.placement import Placement, plausible_units


def box() -> trimesh.Trimesh:
    return trimesh.creation.box((10.0, 20.0, 30.0)).apply_translation((100.0, 0.0, -50.0))


def test_numbers_become_metres_and_the_origin_stays():
    model = ObjectModel.from_mesh(box(), unit="mm", scale=4.0)
    assert torch.allclose(2 * model.half_extent, torch.tensor([0.04, 0.08, 0.12]))
    assert torch.allclose(model.centre, torch.tensor([0.4, 0.0, -0.2]))


def test_a_centred_model_is_the_same_around_its_middle(tmp_path):
    box().export(tmp_path / "box.ply")
    plain, centred = (ObjectModel.from_file(tmp_path / "box.ply", unit="cm", centre=centre) for centre in (False, True))
    assert torch.allclose(centred.centre, torch.zeros(3), atol=1e-6)
    assert torch.allclose(centred.edge_points, plain.edge_points - plain.centre, atol=1e-6)
    assert torch.allclose(centred.triangles, plain.triangles - plain.centre, atol=1e-6)
    assert centred.mesh is not None
    assert np.allclose(centred.mesh.bounds.mean(0), 0, atol=1e-9)


def test_lines_are_placed_alike():
    model = ObjectModel.from_polylines([[(10, 0, 5), (30, 0, 5)]], unit="mm", scale=2.0, centre=True)
    assert torch.allclose(model.segments, torch.tensor([[[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0]]]))


def test_a_model_far_from_its_origin_may_be_centred():
    points = box().vertices + 1e5
    with pytest.raises(ModelError, match="Set centre to true"):
        Placement("mm").metres(points, "box")
    factor, origin = Placement("mm", centre=True).metres(points, "box")
    assert factor == 0.001
    assert np.allclose(origin, [100.1, 100.0, 99.95])


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_a_scale_that_is_none_is_refused(scale):
    with pytest.raises(ModelError, match="give a scale that is a positive number"):
        Placement("m", scale).metres(np.eye(3), "box")


def test_a_size_that_does_not_fit_names_scale_and_units():
    with pytest.raises(ModelError, match=r"with unit='m' and scale=10; expected 5 mm to 5 m\. Plausible would be unit='cm'"):
        Placement("m", 10.0).metres(np.eye(3), "box")
    assert plausible_units(187.0) == ["cm", "mm", "inch"]
    assert plausible_units(1e7) == []
