import numpy as np
import pandas as pd
import pytest
import torch
from sampling import generator, quaternions, rotation_vectors
from torch.testing import assert_close
from torch.utils._pytree import tree_map
from unchecked import shapes_unchecked

from hrc_learn.geometry import Pose, quaternion


def poses(*batch, rng):
    position = torch.randn(*batch, 3, generator=rng, dtype=torch.float64)
    return Pose(position, quaternions(*batch, rng=rng))


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_is_its_homogeneous_matrix(batch):
    rng = generator(1)
    a, b = poses(*batch, rng=rng), poses(*batch, rng=rng)
    points = torch.randn(*batch, 3, generator=rng, dtype=torch.float64)
    assert_close((a @ b).matrix(), a.matrix() @ b.matrix())
    assert_close(a.inverse().matrix(), torch.linalg.inv(a.matrix()))
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)
    assert_close(a.apply(points), (a.matrix() @ homogeneous[..., None])[..., :3, 0])
    assert_close(Pose.from_matrix(a.matrix()).matrix(), a.matrix())
    assert_close(Pose.from_vector(a.vector()).matrix(), a.matrix())


def test_twist_to_is_the_base_frame_motion():
    """Turning about base axes after a pose, not about its own."""
    rng = generator(2)
    start, turn = poses(5, rng=rng), rotation_vectors(5, rng=rng)
    move = torch.randn(5, 3, generator=rng, dtype=torch.float64)
    end = Pose(
        start.position + move,
        quaternion.multiply(quaternion.exp(turn), start.orientation),
    )
    assert_close(start.twist_to(end), torch.cat([move, turn], dim=-1))
    assert_close(
        start.twist_to(start), torch.zeros(5, 6, dtype=torch.float64), rtol=0, atol=1e-15
    )


def test_indexing_addresses_batch_dimensions():
    pose = poses(4, 9, rng=generator(3))
    assert_close(pose[..., 8].position, pose.position[:, 8])
    assert_close(pose[1, 2:4].orientation, pose.orientation[1, 2:4])
    assert pose[0].position.shape == (9, 3)


def test_broadcasts():
    rng = generator(4)
    pose = poses(4, 1, rng=rng)
    assert pose.apply(torch.zeros(5, 3, dtype=torch.float64)).shape == (4, 5, 3)
    assert (pose @ poses(5, rng=rng)).position.shape == (4, 5, 3)
    assert pose.twist_to(poses(5, rng=rng)).shape == (4, 5, 6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lists_of_points_have_the_dtype_of_the_pose(dtype):
    half_turn = torch.tensor([0, 0, 0, 1.0], dtype=dtype)
    pose = Pose(torch.tensor([1.0, 0, 0], dtype=dtype), half_turn)
    expected = torch.tensor([[0.5, 2.0, 3.0]], dtype=dtype)
    assert_close(pose.apply([[0.5, -2.0, 3.0]]), expected)
    assert_close(pose.apply(np.array([[0.5, -2.0, 3.0]])), expected)


def test_whole_numbers_become_floats():
    with shapes_unchecked():
        pose = Pose(torch.tensor([1, 2, 3]), torch.tensor([1, 0, 0, 0], dtype=torch.int32))
        masks = tree_map(torch.isfinite, pose)
    assert pose.position.dtype == pose.orientation.dtype == torch.float64
    assert pose.apply([0.0, 0.0, 1.0]).tolist() == [1.0, 2.0, 4.0]
    assert masks.position.dtype == torch.bool


def test_tables_and_lists_become_tensors():
    table = pd.DataFrame({"x": [0.1, 0.2], "y": [0.0, 0.0], "z": [0.5, 0.6]})
    with shapes_unchecked():
        pose = Pose(table, table.assign(w=1.0)[["w", "x", "x", "x"]])
    assert pose.position.tolist() == table.to_numpy().tolist()
    assert pose.orientation[:, 0].tolist() == [1.0, 1.0]
    with shapes_unchecked():
        assert Pose([1, 2, 3], (1, 0, 0, 0)).vector().tolist() == [1.0, 2.0, 3.0, 0, 0, 0]


def test_goes_through_vmap_as_a_value():
    pose = poses(6, rng=generator(5))
    with shapes_unchecked():
        inverse = torch.vmap(Pose.inverse)(pose)
        back = torch.vmap(Pose.from_vector)(torch.vmap(Pose.vector)(pose))
    assert_close(inverse.matrix(), pose.inverse().matrix())
    assert_close(back.matrix(), pose.matrix())


class RoundTrip(torch.nn.Module):
    def forward(self, pose: Pose) -> Pose:
        same = Pose.from_matrix((pose @ pose.inverse() @ pose).matrix())
        return Pose.from_vector(same.vector())


@pytest.mark.long
def test_exports_for_any_batch_size():
    pose = poses(5, rng=generator(6))
    batch = torch.export.Dim("batch")
    with shapes_unchecked():
        program = torch.export.export(
            RoundTrip(), (pose,), dynamic_shapes={"pose": [{0: batch}, {0: batch}]}
        )
    other = poses(3, rng=generator(7))
    assert_close(program.module()(other).matrix(), other.matrix())
