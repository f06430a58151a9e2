"""The image Jacobian as a network of radial basis functions of the tool's pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.geometry import Pose
from hrc_learn.jacobian.fitting import (
    ImageJacobianFitConfig,
    ImageJacobianFitReport,
    RBFCenters,
    fit_weights,
    pose_inputs,
    prior_precision,
    radial_basis,
)
from hrc_learn.jacobian.samples import (
    ImageDemonstration,
    component_scale,
    image_demonstrations,
    statistics_by_fold,
)
from hrc_learn.model_files import SavedModel, write_model

_KIND = "RBFImageJacobian"
_UNITS = {"position": "m", "rotation": "rad", "jacobian": "px/m, px/rad", "pixels": "u, v"}


class RBFImageJacobian(nn.Module):
    """Estimate J_s_hat of the Jacobian from the tool's twist to the motion of its image.

        x_dot = J_s(r) r_dot,   vec(J_s_hat(r)^T) = W theta(r)      (approxNN_vec)

    r is position [m] and rotation vector [rad]; r_dot is the geometric twist (linear,
    angular) in the base frame, *not* the derivative of the rotation vector, so that
    J_s J is the Jacobian from joint velocities to pixels per second. vec stacks columns,
    which for J_s^T are the rows of J_s.
    """

    weight: nn.Parameter
    """W, (12, K) [px/m and px/rad]; 12 rows more for each further point of the feature."""
    centers: Tensor
    """Of the neurons, (K, n), in the units of the chosen components of r."""
    width: Tensor
    """Standard deviation of the neurons, one number in the same unit."""
    reference: Tensor | None
    """Orientation (w, x, y, z) from which the neurons count rotation; None: r itself."""
    covariance: Tensor | None
    """Posterior covariance of one image row of W, (6 K, 6 K) in (component, neuron) order,
    with rotation counted in metres (`rotation_scale`); None if not fitted."""

    def __init__(
        self,
        centers: Float[Tensor, "K n"],
        width: float,
        *,
        weight: Float[Tensor, "entries K"] | None = None,
        input_indices: Sequence[int] = (0, 1),
        reference: Float[Tensor, "4"] | None = None,
        normalized: bool = True,
    ):
        """Build a network; its dtype and device are those of `centers`.

        Args:
            centers: One row a neuron, one column an input.
            width: Standard deviation of the neurons.
            weight: W; zero if None.
            input_indices: Components of r = (x, y, z, three of the rotation vector) that the
                neurons see. A rotation vector jumps at half turns; prefer positions, or
                give a reference.
            reference: Orientation in the middle of those to come: the last three inputs are
                then the rotation vector from it (see `pose_inputs`).
            normalized: Whether neurons are divided by their sum (see `radial_basis`).

        Raises:
            ValueError: Centres and indices do not match, or the width is not positive.
        """
        super().__init__()
        self.input_indices = _checked_indices(input_indices, centers)
        if not width > 0:
            raise ValueError(f"width must be positive, got {width}.")
        self.normalized = normalized
        self.register_buffer("centers", centers.detach().clone())
        self.register_buffer("width", torch.as_tensor(width, dtype=centers.dtype))
        if reference is not None:
            reference = reference.detach().clone().to(centers)
        self.register_buffer("reference", reference)
        self.register_buffer("covariance", None)
        if weight is None:
            weight = centers.new_zeros(12, len(centers))
        self.weight = nn.Parameter(weight.detach().clone().to(centers))
        self.report: ImageJacobianFitReport | None = None

    @classmethod
    def from_jacobian(
        cls,
        jacobian: Float[Tensor, "rows 6"],
        centers: Float[Tensor, "K n"],
        width: float,
        *,
        input_indices: Sequence[int] = (0, 1),
        formulation: Literal["exact", "paper"] = "exact",
        start: Float[Tensor, "6"] | None = None,
    ) -> RBFImageJacobian:
        """Start from one guess of the image Jacobian for the whole workspace.

        Args:
            jacobian: J_s0 [px/m, px/rad].
            centers: Of the neurons.
            width: Of the neurons.
            input_indices: Components of r that the neurons see.
            formulation: "exact" reproduces J_s0 everywhere. "paper" is (eq_w0) as printed:
                neurons are not normalised, so the estimate grows or fades away from `start`,
                and the entries of vec(J_s) stand where those of vec(J_s^T) belong, which
                mixes the two image rows.
            start: r at which the paper's formulation starts; it alone needs it.

        Raises:
            ValueError: `start` is missing or superfluous, or the formulation is unknown.
        """
        jacobian = jacobian.to(centers)
        if formulation == "exact":
            if start is not None:
                raise ValueError("start is only used by formulation='paper': leave it out.")
            network = cls(centers, width, input_indices=input_indices)
            column = jacobian.flatten()
        elif formulation == "paper":
            if start is None:
                raise ValueError("formulation='paper' needs start, the pose vector at t0.")
            network = cls(centers, width, input_indices=input_indices, normalized=False)
            column = jacobian.mT.flatten() / network.basis(start).sum()
        else:
            raise ValueError(f"formulation must be 'exact' or 'paper', got {formulation!r}.")
        network.weight.data = column[:, None].repeat(1, len(centers))
        return network

    @classmethod
    def fit(
        cls,
        poses: Sequence[Pose],
        features: Sequence[Float[Tensor, "_ 2"]],
        visible: Sequence[Bool[Tensor, "_"]] | None = None,
        *,
        centers: Float[Tensor, "K n"],
        width: float,
        input_indices: Sequence[int] = (0, 1),
        config: ImageJacobianFitConfig | None = None,
    ) -> RBFImageJacobian:
        """Fit to demonstrations in which the camera watched the tool.

        Args:
            poses: Of the tool along each demonstration, (time,).
            features: Image feature along each [px]; anything where it is not visible.
            visible: Where the feature was found; None: wherever it is not NaN.
            centers: Of the neurons.
            width: Of the neurons.
            input_indices: Components of r that the neurons see.
            config: Noise, prior and the choice of key frames.

        Returns:
            The network, with `report` and `covariance` set.

        Raises:
            ValueError: Lengths differ, or no pair of key frames is left.
        """
        neurons = RBFCenters(centers=centers, width=width, input_indices=tuple(input_indices))
        return cls.fit_demonstrations(
            image_demonstrations(poses, features, visible), neurons, config
        )

    @classmethod
    def fit_demonstrations(
        cls,
        demonstrations: Sequence[ImageDemonstration],
        neurons: RBFCenters,
        config: ImageJacobianFitConfig | None = None,
    ) -> RBFImageJacobian:
        """Fit to demonstrations read one by one; of several processes, each reads its share.

        Args:
            demonstrations: In memory, or a sequence that reads them when asked.
            neurons: Of the network; its dtype and device are those of their centres.
            config: Noise, prior and the choice of key frames.

        Returns:
            The network, with `report` and `covariance` set; the same in all processes.

        Raises:
            ValueError: No pair of key frames is left.
        """
        config = config or ImageJacobianFitConfig()
        network = cls(
            neurons.centers.double(),
            float(neurons.width),
            input_indices=neurons.input_indices,
            reference=neurons.reference,
        )
        K = len(network.centers)
        parts = statistics_by_fold(network.basis, K, demonstrations, config)
        precision = prior_precision(network.centers, config)
        posterior, report = fit_weights(parts, precision, config)
        rows = posterior.mean.mT.unflatten(-1, (6, -1))  # (2, 6, K)
        scale = component_scale(rows, config.rotation_scale)
        network.weight.data = (rows * scale[:, None]).flatten(0, 1)
        network.covariance = posterior.covariance
        network.report = report
        return network.to(neurons.centers.dtype)

    @property
    def rows(self) -> int:
        """Rows of J_s_hat: u and v of every point of the feature."""
        return self.weight.shape[0] // 6

    def forward(self, r: Pose | Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch rows 6"]:
        """J_s_hat at a pose.

        Args:
            r: Position [m] and rotation vector [rad], or a pose.

        Returns:
            Rows u and v; columns linear [px/m] then angular [px/rad].
        """
        return (self.basis(r) @ self.weight.mT).unflatten(-1, (-1, 6))

    def basis(self, r: Pose | Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch K"]:
        """Activation theta(r) of the neurons."""
        return radial_basis(
            self._inputs(r), self.centers, self.width, normalized=self.normalized
        )

    def uncertainty(
        self, r: Pose | Float[Tensor, "*batch 6"], rotation_scale: float = 0.15
    ) -> Float[Tensor, "*batch 6"]:
        """Posterior standard deviation of the columns of J_s_hat, alike for both rows.

        Args:
            r: Where, as for `forward`.
            rotation_scale: As in the configuration of the fit [m/rad].

        Raises:
            ValueError: The network was not fitted.
        """
        if self.covariance is None:
            raise ValueError("only a network fitted to demonstrations knows its uncertainty.")
        theta = self.basis(r)
        blocks = self.covariance.unflatten(0, (6, -1)).unflatten(-1, (6, -1))
        blocks = blocks.diagonal(dim1=0, dim2=2)  # (K, K, 6)
        variance = torch.einsum("...k,klj,...l->...j", theta, blocks, theta)
        return variance.clamp_min(0).sqrt() * component_scale(variance, rotation_scale)

    def save(self, folder: str | Path) -> None:
        """Write `config.json` and `model.safetensors` into a folder, replacing an older save.

        Raises:
            ValueError: The folder holds something else.
        """
        config = {
            "units": _UNITS,
            "input_indices": list(self.input_indices),
            "normalized": self.normalized,
            "report": None if self.report is None else self.report.summary(),
        }
        write_model(folder, _KIND, config, self.state_dict())

    @classmethod
    def load(cls, folder: str | Path) -> RBFImageJacobian:
        """Read what `save` wrote; the summary of the fit stays in `config.json`.

        Raises:
            FileNotFoundError: There is no such folder or file.
            ValueError: A file is damaged or not ours; the message names file and field.
        """
        saved = SavedModel(folder, _KIND)
        try:
            network = cls(
                saved.tensor("centers"),
                float(saved.tensor("width")),
                weight=saved.tensor("weight"),
                input_indices=saved.get("input_indices", list),
                reference=saved.tensor("reference") if "reference" in saved.tensors else None,
                normalized=saved.flag("normalized"),
            )
        except (TypeError, ValueError) as error:
            raise saved.invalid(error) from error
        if "covariance" in saved.tensors:
            network.covariance = saved.tensor("covariance")
        return network

    def _inputs(self, r: Pose | Tensor) -> Tensor:
        if max(self.input_indices) < 3:  # saves the logarithm of the orientation
            vector = r if isinstance(r, Tensor) else r.position
        elif self.reference is None:
            vector = r if isinstance(r, Tensor) else r.vector()
        else:
            pose = Pose.from_vector(r) if isinstance(r, Tensor) else r
            vector = pose_inputs(pose, self.reference)
        return _components(vector, self.input_indices)


def _components(vector: Tensor, indices: tuple[int, ...]) -> Tensor:
    """Some components; a slice where they follow each other, as picking takes far longer."""
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


def stack_networks(networks: Sequence[RBFImageJacobian]) -> RBFImageJacobian:
    """One network for all points of a feature, from one for each of them.

    Points fitted to the same demonstrations have the same regressors, so their image rows share
    one covariance: here that of the least certain point.

    Raises:
        ValueError: Their neurons differ.
    """
    first = networks[0]
    for i, other in enumerate(networks[1:], start=1):
        if not _same_neurons(first, other):
            raise ValueError(
                f"network {i} has other neurons than network 0: fit all points with the same "
                "centers, width and input_indices"
            )
    stack = RBFImageJacobian(
        first.centers,
        float(first.width),
        weight=torch.cat([network.weight.detach() for network in networks]),
        input_indices=first.input_indices,
        reference=first.reference,
        normalized=first.normalized,
    )
    known = [network.covariance for network in networks if network.covariance is not None]
    if len(known) == len(networks):
        stack.covariance = max(known, key=lambda covariance: float(covariance.trace()))
    return stack


def _same_neurons(a: RBFImageJacobian, b: RBFImageJacobian) -> bool:
    references = [network.reference for network in (a, b) if network.reference is not None]
    return (
        torch.equal(a.centers, b.centers)
        and torch.equal(a.width, b.width)
        and (a.input_indices, a.normalized) == (b.input_indices, b.normalized)
        and (not references or (len(references) == 2 and torch.equal(*references)))
    )


def nominal_network(
    model: Callable[[Pose], Tensor],
    around: Pose,
    centers: Float[Tensor, "K n"],
    width: float,
    *,
    input_indices: Sequence[int] = (0, 1, 2),
) -> RBFImageJacobian:
    """A network that agrees with a model of the image Jacobian at its neurons.

    A rough guess of where the camera stands tells how the Jacobian shrinks with the depth of
    the marker and how it turns with the tool; one Jacobian for the whole workspace cannot.
    Online estimators start from it as from any other network.

    Args:
        model: From poses (K,) to image Jacobians (K, rows, 6), such as
            `PinholeCamera.image_jacobian`.
        around: Pose of the tool in the middle of the workspace; supplies the components of r
            that the neurons do not see.
        centers: Of the neurons.
        width: Of the neurons.
        input_indices: Components of r = (x, y, z, three of the rotation vector) that the
            neurons see; depth needs z.
    """
    network = RBFImageJacobian(centers, width, input_indices=input_indices)
    r = around.vector().to(centers).expand(len(centers), 6).clone()
    r[:, list(network.input_indices)] = centers
    with torch.no_grad():
        J = model(Pose.from_vector(r))
    network.weight.data = J.flatten(1).mT.contiguous()
    return network
