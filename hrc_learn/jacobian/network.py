"""Image Jacobian of a fitted camera plus a network of radial basis functions.

Without a camera, the network is the whole image Jacobian, as in the paper by Yan et al.
(`docs/concepts/paper.md`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.geometry import Pose
from hrc_learn.jacobian.fitting import (
    ImageDemonstration,
    ImageJacobianFitConfig,
    ImageJacobianFitReport,
    RBFCenters,
    component_scale,
    fit_weights,
    pose_inputs,
    prior_precision,
    radial_basis,
    statistics_by_fold,
)
from hrc_learn.jacobian.perspective import (
    SIZE,
    CameraFit,
    camera_jacobian,
    marker_pixels,
    stepped,
    unexplained,
)
from hrc_learn.model_files import SavedModel, write_model

_KIND = "RBFImageJacobian"
_UNITS = {"position": "m", "rotation": "rad", "jacobian": "px/m, px/rad", "pixels": "u, v"}


class RBFImageJacobian(nn.Module):
    """Estimate J_s_hat of the image Jacobian, which maps the tool's twist to the motion of its
    image feature.

        x_dot = J_s(r) r_dot,   vec(J_s_hat(r)^T) = vec(J_camera(r)^T) + W theta(r)

    The first term is the image Jacobian of a camera fitted to demonstrations. The second term,
    the network, represents the residual: lens, misalignment and unmodelled kinematics. Without
    a camera, the first term is zero and the second is equation (approxNN_vec) of the paper.

    r is position [m] and rotation vector [rad]; r_dot is the geometric twist (linear, angular)
    in the base frame, *not* the derivative of the rotation vector. Therefore J_s J, with the
    geometric Jacobian J of the arm, maps joint velocities to pixels per second. vec stacks the
    columns of J_s^T, which are the rows of J_s.
    """

    weight: nn.Parameter
    """W, (12, K) [px/m and px/rad]; 12 more rows for each further point of the feature."""
    centers: Tensor
    """Centres of the neurons, (K, n), in the units of the chosen components of r."""
    width: Tensor
    """Standard deviation of the neurons, one number in the same units."""
    reference: Tensor | None
    """Orientation (w, x, y, z) to which the rotation vector is relative; None: the base."""
    covariance: Tensor | None
    """Posterior covariance of the weights of one image row, (6 K, 6 K) in (component, neuron)
    order, with rotation scaled to metres (`rotation_scale`); None if not fitted."""
    rotation_scale: float = 0.15
    """Length by which the fit converted the rotations of `covariance` [m/rad]."""
    camera: Tensor | None
    """Vector of the camera and its marker (see `perspective`), (13,); None: no camera."""
    camera_covariance: Tensor | None
    """Covariance of a step from the camera (see `perspective.stepped`), (13, 13)."""

    def __init__(
        self,
        centers: Float[Tensor, "K n"],
        width: float,
        *,
        weight: Float[Tensor, "entries K"] | None = None,
        input_indices: Sequence[int] = (0, 1),
        reference: Float[Tensor, "4"] | None = None,
        normalized: bool = True,
        camera: CameraFit | None = None,
    ):
        """Build a network with the dtype and device of `centers`.

        Args:
            centers: Centre of each neuron (row), one column per input.
            width: Standard deviation of the neurons.
            weight: W; None: zero.
            input_indices: Components of r = (x, y, z, rotation vector) that are inputs. A
                rotation vector jumps at half turns; prefer positions, or give a reference.
            reference: Orientation in the middle of the expected orientations. The rotation
                vector of r is relative to it (see `pose_inputs`). None: relative to the base.
            normalized: Divide the neurons by their sum (see `radial_basis`).
            camera: Camera whose image Jacobian is the first term; None: no camera.

        Raises:
            ValueError: Centres and indices do not match, or the width is not positive.
        """
        super().__init__()
        self.input_indices = _checked_indices(input_indices, centers)
        if not 0 < width < torch.inf:
            raise ValueError(f"width must be positive and finite, got {width}.")
        self.normalized = normalized
        self.register_buffer("centers", centers.detach().clone())
        self.register_buffer("width", torch.as_tensor(width, dtype=centers.dtype))
        if reference is not None:
            reference = reference.detach().clone().to(centers)
        self.register_buffer("reference", reference)
        self.register_buffer("covariance", None)
        found = (None, None) if camera is None else (camera.camera, camera.covariance)
        for name, value in zip(("camera", "camera_covariance"), found, strict=True):
            self.register_buffer(name, None if value is None else value.to(centers))
        weight = centers.new_zeros(12, len(centers)) if weight is None else weight
        self.weight = nn.Parameter(weight.detach().clone().to(centers))
        self.report: ImageJacobianFitReport | None = None

    @classmethod
    def from_jacobian(
        cls, jacobian: Float[Tensor, "rows 6"], centers: Float[Tensor, "K n"], width: float
    ) -> RBFImageJacobian:
        """Network whose image Jacobian is the same initial guess everywhere.

        Args:
            jacobian: The guess J_s0 [px/m, px/rad].
            centers: Centres of the neurons, x and y [m].
            width: Standard deviation of the neurons.
        """
        network = cls(centers, width)
        network.weight.data = jacobian.to(centers).flatten()[:, None].repeat(1, len(centers))
        return network

    @classmethod
    def fit(
        cls,
        demonstrations: Sequence[ImageDemonstration],
        neurons: RBFCenters,
        config: ImageJacobianFitConfig | None = None,
        camera: CameraFit | None = None,
    ) -> RBFImageJacobian:
        """Fit a network to demonstrations, which are read one by one.

        In a distributed run, each process reads a part of the demonstrations.

        Args:
            demonstrations: Demonstrations in memory, or a sequence that reads them on access.
            neurons: Neurons of the network; their centres give its dtype and device.
            config: Noise, prior and the choice of key frames.
            camera: Camera fitted to these demonstrations: the network then learns the residual,
                so choose `ImageJacobianFitConfig.of_residual`. None: no camera.

        Returns:
            The network, with `report` and `covariance` set; the same in all processes.

        Raises:
            ValueError: There is no pair of key frames.
        """
        config = config or ImageJacobianFitConfig()
        network = cls(
            neurons.centers.double(),
            float(neurons.width),
            input_indices=neurons.input_indices,
            reference=neurons.reference,
            camera=camera,
        )
        if camera is not None:
            demonstrations = unexplained(demonstrations, camera.camera)
        K = len(network.centers)
        parts = statistics_by_fold(network.basis, K, demonstrations, config)
        precision = prior_precision(network.centers, config)
        mean, covariance, report = fit_weights(parts, precision, config)
        rows = mean.mT.unflatten(-1, (6, -1))  # (2, 6, K)
        scale = component_scale(rows, config.rotation_scale)
        network.weight.data = (rows * scale[:, None]).flatten(0, 1)
        network.covariance, network.rotation_scale = covariance, config.rotation_scale
        network.report = report
        return network.to(neurons.centers.dtype)

    @property
    def rows(self) -> int:
        """Number of rows of J_s_hat: u and v of each point of the feature."""
        return self.weight.shape[0] // 6

    def forward(self, r: Pose | Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch rows 6"]:
        """J_s_hat at a pose.

        Args:
            r: Position [m] and rotation vector [rad], or a pose.

        Returns:
            Rows u and v; columns linear [px/m] then angular [px/rad].
        """
        learned = (self.basis(r) @ self.weight.mT).unflatten(-1, (-1, 6))
        first = self.first(r)
        return learned if first is None else first + learned

    @property
    def camera_fit(self) -> CameraFit | None:
        """The camera with its uncertainty; None without a camera."""
        if self.camera is None or self.camera_covariance is None:
            return None
        return CameraFit(
            camera=self.camera.double(),
            covariance=self.camera_covariance.double(),
            noise=float("nan"),
        )

    def first(self, r: Pose | Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 2 6"] | None:
        """Image Jacobian of the camera at a pose; None without a camera."""
        if self.camera is None:
            return None
        pose, batch = _frames(r)
        return camera_jacobian(self.camera, pose).reshape(*batch, 2, 6)

    def first_pixel(
        self, r: Pose | Float[Tensor, "*batch 6"]
    ) -> Float[Tensor, "*batch 2"] | None:
        """Pixel at which the camera sees the marker at a pose [px]; None without a camera."""
        if self.camera is None:
            return None
        pose, batch = _frames(r)
        return marker_pixels(self.camera, pose)[0].reshape(*batch, 2)

    def basis(self, r: Pose | Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch K"]:
        """Activation theta(r) of the neurons."""
        return radial_basis(
            self._inputs(r), self.centers, self.width, normalized=self.normalized
        )

    def uncertainty(self, r: Pose | Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 6"]:
        """Posterior standard deviation of each column of J_s_hat, for the less certain row.

        Args:
            r: Pose, as for `forward`.

        Raises:
            ValueError: The network was not fitted.
        """
        if self.covariance is None:
            raise ValueError(
                "a network without a fit has no uncertainty: fit it to demonstrations."
            )
        theta = self.basis(r)
        blocks = self.covariance.unflatten(0, (6, -1)).unflatten(-1, (6, -1))
        blocks = blocks.diagonal(dim1=0, dim2=2)  # (K, K, 6)
        variance = torch.einsum("...k,klj,...l->...j", theta, blocks, theta)
        variance = variance.clamp_min(0) * component_scale(variance, self.rotation_scale) ** 2
        if self.camera is not None and self.camera_covariance is not None:
            pose, batch = _frames(r)
            # Steps of one standard deviation along independent directions.
            steps = torch.linalg.cholesky(self.camera_covariance).mT
            moved = camera_jacobian(stepped(self.camera.expand(SIZE, SIZE), steps), pose)
            change = (moved - camera_jacobian(self.camera, pose)).square().sum(0)
            variance = variance + change.amax(-2).reshape(*batch, 6)
        return variance.sqrt()

    def save(self, folder: str | Path) -> None:
        """Write `config.json` and `model.safetensors` into a folder, replacing an older save.

        Raises:
            ValueError: The folder holds other files.
        """
        config = {
            "units": _UNITS,
            "input_indices": list(self.input_indices),
            "normalized": self.normalized,
            "rotation_scale": self.rotation_scale,
            "report": None if self.report is None else asdict(self.report),
        }
        write_model(folder, _KIND, config, self.state_dict())

    @classmethod
    def load(cls, folder: str | Path) -> RBFImageJacobian:
        """Read a saved network, without the fit report in `config.json`.

        Raises:
            FileNotFoundError: There is no such folder or file.
            ValueError: A file is damaged or of another kind; the message names file and field.
        """
        saved = SavedModel(folder, _KIND)
        try:
            network = cls(
                saved.tensor("centers"),
                float(saved.tensor("width")),
                weight=saved.tensor("weight"),
                input_indices=saved.get("input_indices", list),
                reference=saved.tensor("reference") if "reference" in saved.tensors else None,
                normalized=saved.get("normalized", bool),
                camera=_saved_camera(saved),
            )
        except (TypeError, ValueError) as error:
            raise saved.invalid(error) from error
        if "covariance" in saved.tensors:
            network.covariance = saved.tensor("covariance")
        # Older files lack this field; their networks were fitted with the default.
        network.rotation_scale = saved.config.get("rotation_scale", network.rotation_scale)
        return network

    def _inputs(self, r: Pose | Tensor) -> Tensor:
        if max(self.input_indices) < 3:  # avoids the logarithm of the orientation
            vector = r if isinstance(r, Tensor) else r.position
        elif self.reference is None:
            vector = r if isinstance(r, Tensor) else r.vector()
        else:
            pose = Pose.from_vector(r) if isinstance(r, Tensor) else r
            vector = pose_inputs(pose, self.reference)
        return _components(vector, self.input_indices)


def _saved_camera(saved: SavedModel) -> CameraFit | None:
    if "camera" not in saved.tensors:
        return None
    camera, covariance = saved.tensor("camera"), saved.tensor("camera_covariance")
    if camera.shape != (SIZE,) or covariance.shape != (SIZE, SIZE):
        raise ValueError(
            f"camera and camera_covariance must have {SIZE} rows, but have shapes "
            f"{tuple(camera.shape)} and {tuple(covariance.shape)}: fit again."
        )
    return CameraFit(camera=camera, covariance=covariance, noise=float("nan"))


def _frames(r: Pose | Float[Tensor, "*batch 6"]) -> tuple[Pose, tuple[int, ...]]:
    """Poses flattened to one axis of frames, and their batch shape."""
    pose = Pose.from_vector(r) if isinstance(r, Tensor) else r
    flat = Pose(pose.position.reshape(-1, 3), pose.orientation.reshape(-1, 4))
    return flat, tuple(pose.position.shape[:-1])


def _components(vector: Tensor, indices: tuple[int, ...]) -> Tensor:
    """Some components of a vector; a slice if they are adjacent, which is far faster."""
    first, after = indices[0], indices[0] + len(indices)
    if indices == tuple(range(first, after)):
        return vector[..., first:after]
    return vector[..., indices]


def _checked_indices(indices: Sequence[int], centers: Tensor) -> tuple[int, ...]:
    if centers.shape[-1] != len(indices) or not all(0 <= i <= 5 for i in indices):
        raise ValueError(
            f"input_indices choose components 0 to 5 of r, one for each column of centers, "
            f"but got {tuple(indices)} for centers with {centers.shape[-1]} columns."
        )
    return tuple(indices)
