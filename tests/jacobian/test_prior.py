"""A rough camera as prior."""

import torch
from pinhole import Pinhole
from sampling import generator

from hrc_learn.geometry import Pose
from hrc_learn.jacobian import RBFImageJacobian, grid, nominal_network

DOWN = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
MIDDLE = torch.tensor([0.2, 0.5, 0.3], dtype=torch.float64)
CENTERS = grid((0.05, 0.35, 3), (0.35, 0.65, 3), (0.1, 0.5, 3))


def tools(count: int) -> Pose:
    unit = torch.rand(count, 3, generator=generator(), dtype=torch.float64) - 0.5
    offset = unit * torch.tensor([0.3, 0.3, 0.4], dtype=torch.float64)
    return Pose(MIDDLE + offset, DOWN.expand(count, 4))


def test_it_is_the_model_at_its_neurons():
    camera = Pinhole.overhead()
    around = Pose(MIDDLE, DOWN)
    network = nominal_network(camera.jacobian, around, CENTERS, 0.02)
    poses = Pose(CENTERS, DOWN.expand(len(CENTERS), 4))
    # Narrow neurons: each speaks alone at its own centre.
    torch.testing.assert_close(network(poses), camera.jacobian(poses), rtol=1e-9, atol=1e-6)


def test_a_rough_camera_predicts_better_than_one_jacobian_for_all():
    """Guessed 3 degrees and 5 cm off, the tool up to 0.2 m above or below the middle."""
    true, guessed = Pinhole.overhead(), Pinhole.overhead(roll=0.25, height=1.45)
    around = Pose(MIDDLE, DOWN)
    network = nominal_network(guessed.jacobian, around, CENTERS, 0.1)
    flat = RBFImageJacobian.from_jacobian(guessed.jacobian(around), CENTERS[:, :2], 0.1)
    poses = tools(200)
    truth = true.jacobian(poses)[..., :3]
    errors = [(J(poses)[..., :3] - truth).norm(dim=(-2, -1)).mean() for J in (network, flat)]
    assert errors[0] < 0.75 * errors[1]
