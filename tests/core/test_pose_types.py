"""Poses of other libraries become the same matrices."""

from types import SimpleNamespace

import pytest
import torch
from kornia.geometry.liegroup import Se3, So3
from scipy.spatial.transform import RigidTransform, Rotation

from torchtrack.core.lie import quaternion_from_rotation, se3_exp
from torchtrack.core.pose_types import as_pose_matrices
from torchtrack.errors import PoseError

POSES = se3_exp(torch.tensor([[0.3, -0.2, 0.5, 0.1, 0.2, 0.6], [2.0, 1.0, -0.5, 0.0, 0.1, 0.9]], dtype=torch.float64))
ROTATIONS, TRANSLATIONS = POSES[:, :3, :3], POSES[:, :3, 3]
SCIPY = RigidTransform.from_matrix(POSES.numpy())

FORMS = {
    "tensor": POSES,
    "float32": POSES.float(),
    "array": POSES.numpy(),
    "lists": POSES.tolist(),
    "scipy": SCIPY,
    "scipy, one by one": [RigidTransform.from_matrix(pose.numpy()) for pose in POSES],
    "scipy rotation and translation": (Rotation.from_matrix(ROTATIONS.numpy()), TRANSLATIONS.numpy()),
    "pairs, one by one": [(Rotation.from_matrix(R.numpy()), t.tolist()) for R, t in zip(ROTATIONS, TRANSLATIONS, strict=True)],
    "matrix and translation": (ROTATIONS, TRANSLATIONS),
    "kornia": Se3.from_matrix(POSES),
    "kornia rotation and translation": (So3.from_matrix(ROTATIONS), TRANSLATIONS),
    "tensors, one by one": list(POSES),
    "jaxlie": SimpleNamespace(as_matrix=lambda: POSES.numpy()),
}


@pytest.mark.parametrize("name", FORMS)
def test_every_form_is_the_same(name):
    matrices = as_pose_matrices(FORMS[name])
    assert matrices.dtype == torch.float64 and type(matrices) is torch.Tensor
    torch.testing.assert_close(matrices, POSES, atol=1e-6 if name == "float32" else 1e-12, rtol=0)


def test_one_pose_has_no_batch():
    assert as_pose_matrices(RigidTransform.from_matrix(POSES[0].numpy())).shape == (4, 4)
    assert as_pose_matrices((ROTATIONS[0], TRANSLATIONS[0])).shape == (4, 4)
    assert as_pose_matrices((ROTATIONS[0], TRANSLATIONS)).shape == (2, 4, 4)


def test_two_poses_are_no_pair():
    torch.testing.assert_close(as_pose_matrices([POSES[0].numpy(), POSES[1].numpy()]), POSES)


def test_gradients_stay():
    T = POSES.clone().requires_grad_()
    as_pose_matrices(list(T)).sum().backward()
    assert T.grad is not None and bool((T.grad == 1).all())


def test_pypose():
    pypose = pytest.importorskip("pypose", reason="pypose is not installed")
    matrices = as_pose_matrices(pypose.mat2SE3(POSES))
    assert type(matrices) is torch.Tensor
    torch.testing.assert_close(matrices, POSES)
    torch.testing.assert_close(as_pose_matrices(pypose.mat2SE3(POSES).Log()), POSES)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (Rotation.identity(), "a rotation alone is no pose"),
        (torch.eye(3), "a rotation alone is no pose"),
        (torch.zeros(7), r"expected poses of shape \[..., 4, 4\], got \[7\]"),
        ((Rotation.identity(), [0.0, 0.0]), r"translation of shape \[..., 3\], got \[2\]"),
        ("pose.txt", "poses cannot be made a tensor of numbers"),
        ([[[1.0, 2.0], [3.0]], [1.0]], "poses cannot be made a tensor of numbers"),
        ([[1.0, 2.0], [3.0]], "poses cannot be made a tensor of numbers"),
    ],
)
def test_what_is_no_pose_is_refused(poses, message):
    with pytest.raises(PoseError, match=message):
        as_pose_matrices(poses)


def test_orders_of_twists_and_quaternions_are_as_the_docs_say():
    xi = torch.tensor([[0.3, -0.2, 0.5, 0.1, 0.2, 0.6]], dtype=torch.float64)
    exchanged = torch.cat([xi[:, 3:], xi[:, :3]], 1)
    torch.testing.assert_close(as_pose_matrices(RigidTransform.from_exp_coords(xi.numpy())), se3_exp(xi))
    torch.testing.assert_close(as_pose_matrices(Se3.exp(exchanged)), se3_exp(xi))
    xyzw = quaternion_from_rotation(ROTATIONS)
    torch.testing.assert_close(torch.from_numpy(Rotation.from_quat(xyzw.numpy()).as_matrix()), ROTATIONS)
    torch.testing.assert_close(So3.from_wxyz(xyzw[:, [3, 0, 1, 2]]).matrix(), ROTATIONS)
