"""Primitives from several demonstrations of one motion: their mean, and a Gaussian over them.

Orientations, poses and limited joints move linearly in columns of their own: what is true of
linear primitives is worked out once, on their `motion`.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Points, Scalars, Times, Vectors, to_tensor
from hrc_learn.dmp._via_points import ViaPoints
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive
from hrc_learn.dmp.orientation_error import (
    intrinsic_mean,
    nearest_turn,
    reference_of,
    to_error,
)
from hrc_learn.geometry import Pose

SAME = 1e-9
"""Orientations closer than this [rad] are one: well above rounding, well below any sensor."""


via_point_primitive = AdaptedPrimitive.condition
"""The method as a function of the primitive, and of what the method takes."""
with_ends = AdaptedPrimitive.with_ends
"""Likewise."""


def mean_primitive[P: AdaptedPrimitive](primitives: P) -> P:
    """The mean over all batch dimensions of a primitive.

    A rollout is linear in weights, start, goal and start velocity. So for one duration, and
    forcing that does not scale with start and goal, its mean is the rollout of the means.

    Args:
        primitives: Fitted to several demonstrations of one motion.

    Returns:
        A primitive without batch dimensions, and without a fit report.

    Raises:
        ValueError: Primitives whose scaling turns them, each with the way of its own.
    """
    motion, columns = _mean_motion(primitives.motion), primitives.adapter.error_columns
    if columns is None:
        return primitives.with_motion(motion)
    goal = _mean_goal(_goal_orientation(primitives))
    return primitives.with_motion(motion, reference_of(motion.goal[..., columns], goal))


def alike[P: AdaptedPrimitive](primitives: P) -> P:
    """A batch of primitives in columns that mean the same for all of them.

    Orientations with goals of their own are taken as errors to the mean of those. That is
    not linear, so the errors are fitted anew.
    """
    columns = primitives.adapter.error_columns
    if columns is None:
        return primitives
    own = reference(primitives)
    middle = intrinsic_mean(own.reshape(-1, 4))
    motion = primitives.linear_motion()
    if (to_error(own, middle).abs() < SAME).all():
        return primitives
    if motion.basis.periodic:
        raise ValueError("rhythms about different centres have no distribution")
    with torch.no_grad():
        shown: Any = primitives.rollout()
        errors = shown_columns(motion)[..., columns]
    fitted = JointDMP.fit(
        shown.time,
        nearest_turn(to_error(shown.orientation, middle), errors),
        basis=motion.basis,
        spring=motion.spring,
        approach=motion.response.approach,
    )
    x = motion.coordinates().detach().clone()
    x[..., columns, :] = fitted.coordinates().detach()
    motion = motion.with_coordinates(x, motion.duration)
    return primitives.with_motion(motion, middle.expand_as(own))


def reference(primitive: Any) -> Float[Tensor, "*batch 4"]:
    """What orientation errors of a primitive that has them are taken to."""
    return primitive.reference


def shown_columns(motion: LinearPrimitive) -> Float[Tensor, "*batch T D"]:
    """Columns along the demonstration."""
    return motion.roll(Ends(), motion.duration).position


def _goal_orientation(primitives: Any) -> Float[Tensor, "*batch 4"]:
    goal = primitives.goal
    return goal if isinstance(goal, Tensor) else goal.orientation


def _mean_goal(goals: Float[Tensor, "*batch 4"]) -> Float[Tensor, "4"]:
    goals = goals.reshape(-1, 4)
    # Both signs are the same orientation: bring all to the side of the first.
    goals = goals * torch.where((goals @ goals[0])[:, None] < 0, -1.0, 1.0).to(goals)
    return torch.nn.functional.normalize(goals.mean(dim=0), dim=-1)


def _mean_motion(motions: LinearPrimitive) -> LinearPrimitive:
    if motions.forcing_scale.turns and motions.weights.ndim > 2:
        raise ValueError(
            f"scaling {motions.scaling!r} gives each primitive a frame of its own: fit with "
            "'none' to average them"
        )
    x, count = motions.coordinates().detach(), motions.timestamps.shape[-1]
    batch = x.ndim - 2

    def mean(tensor: Tensor) -> Tensor:
        return tensor.flatten(0, batch - 1).mean(dim=0) if batch else tensor

    return motions.with_coordinates(
        mean(x),
        mean(motions.duration),
        amplitude=mean(motions.amplitude),
        timestamps=torch.linspace(0, 1, count, dtype=torch.float64).to(motions.timestamps),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ProbabilisticDMP[P: AdaptedPrimitive]:
    """Gaussian over the coordinates x = (weights, start velocity, start, goal) of a primitive.

    A motion is linear in its coordinates, y(s) = H(s) x, so it is Gaussian too: means,
    likelihoods and conditioning on via points are closed form. Coordinates of all joints
    vary together, in float64. Any kind of primitive will do: of orientations and poses it is
    the error to one reference that is Gaussian.
    """

    primitive: P
    """Its spring, basis, duration and names serve all, and its reference."""
    mean: Float[Tensor, "D M"]
    spread: Float[Tensor, "DM rank"]
    """Square root of the covariance, which has the rank of the demonstrations."""

    @classmethod
    def fit(cls, primitives: P, slack: float = 0.0) -> "ProbabilisticDMP[P]":
        """Mean and covariance of a batch of primitives.

        Args:
            primitives: Of one motion, fitted with `scaling="none"`.
            slack: Freedom beyond what the demonstrations vary, as in `around`. Without, a via
                point that none of their mixtures passes is approached, not reached.

        Raises:
            ValueError: Fewer than two, or scaled primitives, whose motion is not linear.
        """
        motion = primitives.linear_motion()
        batch = motion.weights.shape[:-2]
        if batch.numel() < 2 or not batch:
            raise ValueError("a distribution needs a batch of at least 2 primitives")
        _coordinates(motion)
        primitives = alike(primitives)
        motion = primitives.linear_motion()
        x = _coordinates(motion).flatten(0, -3)
        mean, middle = x.mean(0), mean_primitive(primitives).motion
        reference = getattr(primitives, "reference", None)
        if reference is not None:
            reference = reference.reshape(-1, 4)[0]
        # n - 1: the mean is taken from the same primitives.
        spread = (x - mean).flatten(1).mT / (len(x) - 1) ** 0.5
        if slack:
            spread = torch.cat([spread, _free_forcing(middle, slack)], dim=1)
        return cls(
            primitive=primitives.with_motion(middle, reference), mean=mean, spread=spread
        )

    @classmethod
    def around(cls, primitive: P, slack: float = 1.0) -> "ProbabilisticDMP[P]":
        """One primitive whose forcing may change, for via points without other examples.

        Start, start velocity and goal are certain.

        Args:
            primitive: Without batch dimensions, fitted with `scaling="none"`.
            slack: Standard deviation of the forcing term, alike at all times, in units of the
                force that holds a coordinate away from its goal by the range it covers.
        """
        motion = primitive.linear_motion()
        certain = _coordinates(motion)
        if certain.ndim != 2:
            raise ValueError(f"needs one primitive, got a batch {tuple(certain.shape[:-2])}")
        return cls(primitive=primitive, mean=certain, spread=_free_forcing(motion, slack))

    def mean_primitive(self) -> P:
        """The most likely primitive."""
        return self._with_coordinates(self.mean)

    def sample(self, n: int, generator: torch.Generator | None = None) -> P:
        """A batch of n primitives drawn at random."""
        rank = self.spread.shape[1]
        z = torch.randn(n, rank, generator=generator, dtype=torch.float64).to(self.spread)
        return self._with_coordinates(
            self.mean + (z @ self.spread.mT).unflatten(-1, self.mean.shape)
        )

    def position(self, time: Times) -> tuple[Float[Tensor, "T D"], Float[Tensor, "T D"]]:
        """Mean and standard deviation of the motion at times [s].

        Of the coordinates that move linearly: joints, position, error to the primitive's
        reference, body. `mean_primitive().rollout` has orientations.
        """
        motion = self.primitive.linear_motion()
        time = to_tensor(time, torch.float64, motion.start.device)
        if time.ndim != 1 or not (time >= 0).all():
            raise ValueError("time must be (n,), none negative")
        rows = motion.response.evaluate(time / motion.duration.double())[:, 0]
        mean, root = self._observe(rows)
        shape = (len(time), self.mean.shape[0])
        return mean.view(shape), root.norm(dim=-1).view(shape)

    def condition(
        self,
        time: Times,
        value: Points | Pose | None = None,
        velocity: Points | None = None,
        *,
        body: Points | None = None,
        body_velocity: Points | None = None,
        noise: Scalars | Vectors = 1e-6,
    ) -> "ProbabilisticDMP[P]":
        """The distribution, given where the motion passes at some times, and how fast.

        Gradients flow to times, values, velocities, mean and spread.

        Args:
            time: Of the via points [s], (n,).
            value: Joints (n, D), unit quaternions (n, 4) or a `Pose` of (n). NaN leaves a
                coordinate free, in a quaternion all of the orientation.
            velocity: Of joints (n, D), angular (n, 3) or a twist (n, 6), per second. An
                angular one without an orientation is taken at that of the mean motion.
            body: Of a pose, (n, K).
            body_velocity: Of a pose, (n, K).
            noise: Standard deviation of each value, in the units of its coordinate (of an
                orientation [rad]), or per second; of all alike, or (D,) or (n, D).
        """
        via = self._via(time, value, velocity, body, body_velocity)
        motion = self.primitive.linear_motion()
        H, tau = motion.response.evaluate(via.s), motion.duration.double()
        mean, root = self._observe(torch.cat([H[:, 0], H[:, 1] / tau]))
        wanted = torch.cat([via.position, via.rate / tau]).reshape(-1)
        given = ~wanted.isnan()
        deviation = to_tensor(noise, mean.dtype, mean.device).expand_as(via.position)
        deviation = deviation.repeat(2, 1).reshape(-1)[given]
        # In units of the noise, and in the coordinates z of the spread, where the Gaussian is
        # a unit one beforehand.
        root = root[given] / deviation[:, None]
        residual = (wanted[given] - mean[given]) / deviation
        # The unit covariance keeps it positive definite, however many via points agree.
        precision = root.mT @ root + torch.eye(root.shape[1]).to(root)
        factor = torch.linalg.cholesky(precision)
        z = torch.cholesky_solve((root.mT @ residual)[:, None], factor)[:, 0]
        # precision^-1 = L^-T L^-1: L^-T is a square root of what variance is left.
        left = torch.linalg.solve_triangular(factor, self.spread.mT, upper=False).mT
        moved = self.mean + (self.spread @ z).view(self.mean.shape)
        return replace(self, mean=moved, spread=left)

    def log_prob(
        self,
        time: Times,
        value: Points | Pose,
        *,
        body: Points | None = None,
        noise: float,
    ) -> Float[Tensor, ""]:
        """Log density of what was observed at times (n,), with that sensor noise.

        Of orientations it is the density of the error to the primitive's reference. NaN was
        not observed.
        """
        via = self._via(time, value, None, body, None)
        motion = self.primitive.linear_motion()
        mean, root = self._observe(motion.response.evaluate(via.s)[:, 0])
        seen = ~via.position.isnan().reshape(-1)
        diagonal = torch.full_like(mean[seen], noise**2)
        observed = torch.distributions.LowRankMultivariateNormal(
            mean[seen], root[seen], diagonal
        )
        return observed.log_prob(via.position.reshape(-1)[seen])

    def _via(
        self,
        time: Times,
        value: Points | Pose | None,
        velocity: Points | None,
        body: Points | None,
        body_velocity: Points | None,
    ) -> ViaPoints:
        with torch.no_grad():
            middle = self.mean_primitive()
        via = middle.via_points(time, value, velocity, body=body, body_velocity=body_velocity)
        if via.position.ndim != 2:
            raise ValueError(f"via points must be (n, D), got {tuple(via.position.shape)}")
        return via

    def _observe(self, rows: Float[Tensor, "T M"]) -> tuple[Tensor, Tensor]:
        """Mean (T D) of all joints at all times, and a square root of their covariance."""
        spread = self.spread.view(*self.mean.shape, -1)
        root = torch.einsum("tm,dmr->tdr", rows, spread)
        return (rows @ self.mean.mT).reshape(-1), root.flatten(0, 1)

    def _with_coordinates(self, x: Float[Tensor, "*batch D M"]) -> P:
        motion = self.primitive.linear_motion()
        return self.primitive.with_motion(motion.with_coordinates(x))


def _coordinates(primitives: LinearPrimitive) -> Float[Tensor, "*batch D M"]:
    if primitives.scaling != "none":
        raise ValueError(f"scaling {primitives.scaling!r} is not linear: fit with 'none'")
    return primitives.coordinates().detach().double()


def _free_forcing(primitive: LinearPrimitive, slack: float) -> Float[Tensor, "DM DN"]:
    """Spread of weights that are independent and make the forcing vary alike at all times."""
    basis, amplitude = primitive.basis, primitive.amplitude.detach().double()
    D, N = len(amplitude), basis.count
    share = 1 / basis.phase(basis.centre_times().to(amplitude))
    deviation = slack * primitive.spring.stiffness * amplitude[:, None] * share
    spread = torch.zeros(D, N + 3, D, N).to(amplitude)
    spread[:, :N] = torch.diag_embed(deviation.flatten()).view(D, N, D, N)
    return spread.flatten(0, 1).flatten(1)
