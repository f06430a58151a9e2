"""Cameras as vectors, from those of the simulator, and networks that know them."""

import numpy as np
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.jacobian import CameraFit, RBFImageJacobian, paper_grid
from hrc_learn.vision import CameraModel


def camera_vector(model: CameraModel, marker=(-0.008, 0.145, -0.0834)) -> torch.Tensor:
    """The vector of a camera that sees a marker on the tool [m]."""
    matrix, eye = model.pose[:3, :3].T, model.pose[:3, 3]
    rotation = quaternion.log(quaternion.from_matrix(torch.from_numpy(matrix.copy())))
    values = [np.log(model.focal[0]), *model.principal, model.distortion[0]]
    values += [*rotation.tolist(), *(-matrix @ eye), *marker]
    return torch.tensor(values, dtype=torch.float64)


def camera_network(vector: torch.Tensor) -> RBFImageJacobian:
    """A network without a residual behind a camera known to millimetres."""
    deviation = torch.tensor([1e-3, 2, 2, 2e-3, *[2e-3] * 6, *[5e-4] * 3]).double()
    fit = CameraFit(camera=vector, covariance=deviation.square().diag(), noise=0.1)
    return RBFImageJacobian(paper_grid().double(), 0.1, camera=fit)
