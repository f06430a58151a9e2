"""Gaussians over primitives, and means of primitives, from several demonstrations.

For orientations and poses too, the motion of the columns is a linear map of coordinates. All
functions therefore compute with the columns of `motion`.
"""

import warnings
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import LowRankMultivariateNormal, kl_divergence

from hrc_learn.dmp._arguments import (
    Points,
    Scalars,
    Times,
    Vectors,
    check_not_negative,
    positive,
    seconds,
    to_tensor,
)
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.linear_primitive import LinearPrimitive
from hrc_learn.dmp.motion_primitive import REFIT_SAMPLES, MotionPrimitive
from hrc_learn.dmp.moving_goal_dmp import MovingGoalDMP
from hrc_learn.dmp.orientation_dmp import OrientationDMP
from hrc_learn.dmp.orientation_error import intrinsic_mean, nearest_turn, reference_of, to_error
from hrc_learn.dmp.pose_dmp import PoseDMP
from hrc_learn.dmp.samples import expanded
from hrc_learn.dmp.via_points import ViaPoints
from hrc_learn.geometry import Pose
from hrc_learn.model_files import SavedModel, StoredModel

KINDS: dict[str, type[MotionPrimitive]] = {
    kind.__name__: kind for kind in (JointDMP, OrientationDMP, PoseDMP, MovingGoalDMP)
}
"""Kinds of primitive by their names in files."""

PATH_TIMES = 30
"""Number of times at which paths are compared."""
FEWEST, SINGULAR = 4, 1e-6
"""`FEWEST`: smallest number of primitives from which the dependence of paths on start and goal
is estimated. `SINGULAR`: relative singular value below which start and goal count as
constant."""
KNOWN_DURATION = 1e-6
"""Standard deviation of the logarithm of a duration that is given as known."""
CERTAIN, FAR = 1e-3, 3.0
"""`CERTAIN`: standard deviation of a motion, in units of the noise of a via point, below which
conditioning does not move it. `FAR`: distance at which a via point counts as missed, in these
units."""
GAUSSIAN = ("mean", "spread", "timing")
SAME_ORIENTATION = 1e-9
"""Angle [rad] below which orientations count as equal. The bound is larger than rounding errors
and smaller than the resolution of any sensor."""


def mean_primitive[P: MotionPrimitive](primitives: P) -> P:
    """Mean over all batch dimensions of a primitive.

    A rollout is linear in weights, start, goal and start velocity. If durations are equal and
    the scaling does not depend on start and goal, the mean of the rollouts is therefore the
    rollout of the means. The duration of the result is the geometric mean.

    Args:
        primitives: Primitives fitted to several demonstrations of one motion.

    Returns:
        A primitive without batch dimensions and without a fit report.

    Raises:
        ValueError: The scaling is `"rotation"`, for which the weights of each demonstration
            are in a different frame.
    """
    motion, columns = _mean_motion(primitives.motion), primitives.error_columns
    if columns is None:
        return primitives.with_motion(motion)
    oriented: Any = primitives
    middle = intrinsic_mean(oriented.goal_orientation.reshape(-1, 4))
    return primitives.with_motion(motion, reference_of(motion.goal[..., columns], middle))


def with_common_reference[P: MotionPrimitive](primitives: P) -> P:
    """Batch of primitives whose orientation errors have one common reference.

    Orientations with different goals become errors to the mean of their references. This
    conversion is not linear, so the errors are fitted again.
    """
    columns = primitives.error_columns
    if columns is None:
        return primitives
    own: Any = primitives.reference
    middle = intrinsic_mean(own.reshape(-1, 4))
    motion: Any = primitives.motion
    if (to_error(own, middle).abs() < SAME_ORIENTATION).all():
        return primitives
    if motion.basis.periodic:
        raise ValueError("rhythms about different centres have no distribution")
    s = torch.linspace(0, 1, REFIT_SAMPLES * motion.basis.count + 1).to(middle).double()
    with torch.no_grad():
        shown: Any = primitives.rollout(s * motion.duration[..., None])
    errors = nearest_turn(
        to_error(shown.orientation, middle), shown.motion.position[..., columns]
    )
    x = motion.coordinates().detach().clone()
    x[..., columns, :] = motion.refit(s, errors).coordinates().detach()
    motion = motion.with_coordinates(x, motion.duration)
    return primitives.with_motion(motion, middle.expand_as(own))


def common_reference(primitives: MotionPrimitive) -> Tensor | None:
    """Common reference of the orientation errors of a batch, (4,); None for joints."""
    found = getattr(primitives, "reference", None)
    return None if found is None else found.reshape(-1, 4)[0]


def _mean_motion(motions: LinearPrimitive) -> LinearPrimitive:
    if motions.forcing_scale.turns and motions.weights.ndim > 2:
        raise ValueError(
            f"scaling {motions.scaling!r} expresses each primitive in a different frame: fit "
            "with 'none' to average them"
        )
    x, count = motions.coordinates().detach(), motions.timestamps.shape[-1]
    if not x.numel():
        raise ValueError("there are no primitives to average")
    return motions.with_coordinates(
        x.reshape(-1, *x.shape[-2:]).mean(0),
        motions.duration.log().mean().exp(),
        amplitude=motions.amplitude.reshape(-1, x.shape[-2]).mean(0),
        timestamps=torch.linspace(0, 1, count, dtype=torch.float64).to(motions.timestamps),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ProbabilisticDMP[P: MotionPrimitive](StoredModel):
    """Gaussian over the coordinates x = (weights, start velocity, start, goal) of a primitive.

    A motion is linear in its coordinates, y(s) = H(s) x, and therefore Gaussian too: means,
    likelihoods and conditioning on via points have a closed form. The Gaussian is joint over
    all columns, in float64. Any kind of primitive is accepted; for orientations and poses, the
    error to one reference is Gaussian.
    """

    primitive: P
    """Primitive with the common spring, basis, duration, names and reference."""
    mean: Float[Tensor, "D M"]
    spread: Float[Tensor, "DM rank"]
    """Square root of the covariance: one column for each demonstration, then the columns that
    `slack` adds."""
    timing: Float[Tensor, "rank"]
    """Deviation of the logarithm of the duration for each column of `spread`."""
    dependence: float = 1.0
    """Factor, 0 to 1, that `at` applies to the covariance between paths and their ends."""

    @classmethod
    def fit(cls, primitives: P, slack: float = 0.0) -> "ProbabilisticDMP[P]":
        """Compute mean and covariance of a batch of primitives and of their durations.

        Args:
            primitives: Primitives of one motion, fitted with `scaling="none"`.
            slack: Freedom beyond the variation of the demonstrations, as in `around`. Without
                slack, the motion approaches but does not reach a via point that lies on no
                combination of the demonstrations.

        Raises:
            TypeError: Not primitives, but a list of them or demonstrations.
            ValueError: Fewer than two primitives, or a scaling other than `"none"`.
        """
        if not isinstance(primitives, MotionPrimitive):
            raise TypeError(f"fit primitives as one batch, got {type(primitives).__name__}")
        batch = primitives.motion.weights.shape[:-2]
        if batch.numel() < 2:
            raise ValueError("a distribution needs a batch of at least 2 primitives")
        _linear_coordinates(primitives.motion)  # before orientations are fitted again
        primitives = with_common_reference(primitives)
        motion, reference = primitives.motion, common_reference(primitives)
        x = _linear_coordinates(motion).flatten(0, -3)
        lasting = motion.duration.detach().double().flatten().log()
        mean, logarithm = x.mean(0), lasting.mean()
        # The mean costs a degree of freedom.
        scale = (len(x) - 1) ** -0.5
        spread, timing = scale * (x - mean).flatten(1).mT, scale * (lasting - logarithm)
        middle = mean_primitive(primitives).motion
        if slack:
            free = _free_forcing(middle, slack)
            spread = torch.cat([spread, free], dim=1)
            timing = torch.nn.functional.pad(timing, (0, free.shape[1]))
        middle = middle.with_coordinates(mean, logarithm.exp())
        return cls(
            primitive=primitives.with_motion(middle, reference),
            mean=mean,
            spread=spread,
            timing=timing,
            dependence=_dependence_on_ends(motion, x),
        )

    @classmethod
    def around(cls, primitive: P, slack: float = 1.0) -> "ProbabilisticDMP[P]":
        """Gaussian around one primitive whose forcing may vary, for via points.

        Start, start velocity and goal have no variance.

        Args:
            primitive: A single primitive, fitted with `scaling="none"`.
            slack: Standard deviation of the forcing term, equal at all times. Its unit is the
                spring force at a distance from the goal equal to the range of the coordinate.
        """
        motion = primitive.motion
        certain = _linear_coordinates(motion)
        if certain.ndim != 2:
            raise ValueError(f"needs one primitive, got a batch {tuple(certain.shape[:-2])}")
        spread = _free_forcing(motion, slack)
        certain_time = torch.zeros_like(spread[0])
        return cls(primitive=primitive, mean=certain, spread=spread, timing=certain_time)

    def mean_primitive(self) -> P:
        """Most likely primitive."""
        motion = self.primitive.motion
        return self.primitive.with_motion(motion.with_coordinates(self.mean))

    def sample(self, n: int, generator: torch.Generator | None = None) -> P:
        """Batch of n random primitives; each has its own random duration."""
        rank = self.spread.shape[1]
        z = torch.randn(n, rank, generator=generator, dtype=torch.float64).to(self.spread)
        motion = self.primitive.motion
        x = self.mean + (z @ self.spread.mT).unflatten(-1, self.mean.shape)
        duration = motion.duration.double() * (z @ self.timing).exp()
        return self.primitive.with_motion(motion.with_coordinates(x, duration))

    def rollout(self, *arguments: Any, **options: Any) -> Any:
        """Most likely motion; arguments as for `rollout` of the primitive."""
        return self.mean_primitive().rollout(*arguments, **options)

    def initial_state(self, *arguments: Any, **options: Any) -> Any:
        """State at the start of the most likely motion, for `step`."""
        return self.mean_primitive().initial_state(*arguments, **options)

    def step(self, state: Any, dt: Scalars, **inputs: Any) -> Any:
        """Advance the most likely motion by `dt` [s]; `inputs` as for the primitive."""
        return self.mean_primitive().step(state, dt, **inputs)

    def to(self, device: torch.device | str) -> "ProbabilisticDMP[P]":
        """The same distribution on another device."""
        return on_device(self, device)

    def config(self) -> dict[str, Any]:
        """Config of the primitive, its kind, and the dependence on start and goal."""
        own = {"dependence": self.dependence, "primitive": type(self.primitive).__name__}
        return self.primitive.config() | own

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of the primitive and of the Gaussian."""
        own = {f"gaussian.{name}": getattr(self, name) for name in GAUSSIAN}
        return self.primitive.tensors() | own

    @classmethod
    def restore[S: "ProbabilisticDMP"](cls: type[S], saved: SavedModel) -> S:
        kind = saved.get("primitive", str)
        if kind not in KINDS:
            raise saved.invalid(f"unknown primitive {kind!r}; choose from {', '.join(KINDS)}")
        own: Any = {name: saved.tensor(f"gaussian.{name}") for name in GAUSSIAN}
        dependence = float(saved.get("dependence", float, int))
        return cls(primitive=KINDS[kind].restore(saved), dependence=dependence, **own)

    def position(self, time: Times) -> tuple[Float[Tensor, "T D"], Float[Tensor, "T D"]]:
        """Mean and standard deviation of the columns at times [s].

        Columns are joints, position, error to the primitive's reference, or body. For
        orientations, use `mean_primitive().rollout`.
        """
        motion = self.primitive.motion
        time = seconds(time, motion.start.device)
        if time.ndim != 1:
            raise ValueError(f"time must be (n,), got {tuple(time.shape)}")
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
        noise: Scalars | Vectors = 1e-6,
        duration: float | None = None,
    ) -> "ProbabilisticDMP[P]":
        """Gaussian conditioned on values and velocities at some times, and on a duration.

        Gradients flow to times, values, velocities, mean and spread.

        Args:
            time: Times of the via points [s], (n,), on the time scale of the most likely
                motion. Empty: only the duration is known.
            value: Joints (n, D), unit quaternions (n, 4) or a `Pose` of (n). NaN leaves a
                coordinate free; a quaternion with a NaN leaves the orientation free.
            velocity: Joint velocities (n, D), angular velocities (n, 3) or twists (n, 6), per
                second. An angular velocity without an orientation refers to the orientation of
                the mean motion.
            noise: Standard deviation of each value in the units of its coordinate ([rad] for an
                orientation), or of each velocity per second; one number, (D,) or (n, D).
            duration: Known duration [s].

        Raises:
            ValueError: Noise that is not positive and finite, or values that do not fit.
        """
        if duration is not None:
            motion = self.primitive.motion
            ratio = positive("duration", duration, self.mean) / motion.duration.double()
            if ratio.ndim:
                raise ValueError(f"duration must be one number, got {tuple(ratio.shape)}")
            # Condition on the logarithm of the duration, almost without noise.
            known = self._given(
                self.timing[None] / KNOWN_DURATION, ratio.log()[None] / KNOWN_DURATION
            )
            middle = motion.with_coordinates(known.mean, motion.duration.double() * ratio)
            primitive = self.primitive.with_motion(middle)
            self = replace(known, primitive=primitive)
        if not len(seconds(time, self.mean.device)):
            return self
        via = self._via(time, value, velocity)
        motion = self.primitive.motion
        H, tau = motion.response.evaluate(via.s), motion.duration.double()
        mean, root = self._observe(torch.cat([H[:, 0], H[:, 1] / tau]))
        wanted = torch.cat([via.position, via.rate / tau]).reshape(-1)
        given = ~wanted.isnan()
        deviation = positive("noise", noise, mean)
        deviation = expanded("noise", deviation, via.position.shape, via.position)
        deviation = deviation.repeat(2, 1).reshape(-1)[given]
        # Rows are in units of the noise. The unknowns z are factors on the columns of the
        # spread, with a unit Gaussian as prior.
        root, missing = root[given] / deviation[:, None], (wanted - mean)[given] / deviation
        if (root.norm(dim=-1) < CERTAIN).all() and (missing.abs() > FAR).any():
            text = "all demonstrations agree on other values at the via points: fit with slack"
            warnings.warn(text, stacklevel=2)
        return self._given(root, missing)

    def _given(
        self, root: Float[Tensor, "k rank"], residual: Float[Tensor, "k"]
    ) -> "ProbabilisticDMP[P]":
        """Gaussian given root z = residual with unit noise, where z are factors on `spread`."""
        # The precision of z is root' root + I = R' R. The QR decomposition keeps the digits of
        # the prior next to precise via points, and R^-1 is a square root of the remaining
        # variance.
        Q, R = torch.linalg.qr(torch.cat([root, torch.eye(root.shape[1]).to(root)]))
        solve = torch.linalg.solve_triangular
        z = solve(R, (Q[: len(root)].mT @ residual)[:, None], upper=True)[:, 0]
        remaining = solve(R.mT, self.spread.mT, upper=False).mT
        moved = self.mean + (self.spread @ z).view(self.mean.shape)
        timing = solve(R.mT, self.timing[:, None], upper=False)
        motion = self.primitive.motion
        primitive = self.primitive
        if self.timing.any():
            later = motion.duration.double() * (self.timing @ z).exp()
            primitive = primitive.with_motion(motion.with_coordinates(moved, later))
        return replace(
            self, primitive=primitive, mean=moved, spread=remaining, timing=timing[:, 0]
        )

    def at(
        self, start: Any = None, goal: Any = None, duration: float | None = None
    ) -> "ProbabilisticDMP[P]":
        """Gaussian given a start and a goal; by default, the start and goal of the mean.

        A few demonstrations do not show reliably how a path depends on start and goal. The
        covariance between the path and its ends is therefore multiplied by `dependence`, the
        factor that best predicts each demonstration from the others. On average, this predicts
        at least as well as the mean of all demonstrations.

        Args:
            start: Start of one motion, in the form that `rollout` of the primitive accepts.
            goal: Goal of the motion, in the same form.
            duration: Known duration [s].

        Raises:
            ValueError: Start or goal has a wrong shape, or is a batch.
        """
        if duration is not None:
            return self.condition([], duration=duration).at(start, goal)
        like = self.mean_primitive()
        moved: Any = like.with_boundary(start, goal)
        if batch := tuple(moved.motion.start.shape[:-1]):
            raise ValueError(f"start and goal must be those of one motion, got a batch {batch}")
        ends = columns_of_ends(like, moved).mT.to(self.mean)
        spread = self.spread.view(*self.mean.shape, -1)
        E, k = spread[:, -2:].flatten(0, 1), self.dependence
        back = torch.linalg.pinv(E, rtol=SINGULAR)
        z = k * (back @ (ends - self.mean[:, -2:]).flatten())
        # Square root of I - k^2 P. The unknowns are factors on the columns of the spread, and P
        # projects onto the subspace of factors that start and goal determine.
        left = torch.eye(len(z)).to(E) - (1 - (1 - k**2) ** 0.5) * (back @ E)
        mean = torch.cat([(self.mean + spread @ z)[:, :-2], ends], dim=1)
        remaining = torch.nn.functional.pad(spread[:, :-2] @ left, (0, 0, 0, 2))
        later = self.primitive.motion.duration.double() * (self.timing @ z).exp()
        motion = self.primitive.motion.with_coordinates(mean, later)
        return replace(
            self,
            primitive=self.primitive.with_motion(motion),
            mean=mean,
            spread=remaining.flatten(0, 1),
            timing=self.timing @ left,
        )

    def observed(self, noise: float) -> LowRankMultivariateNormal:
        """Gaussian of all columns at `PATH_TIMES` evenly spaced times of the motion, followed
        by the logarithm of the duration, observed with independent noise.

        Its entropy, log density, samples and divergences apply to the motion together with its
        duration, in float64.
        """
        s = torch.linspace(0, 1, PATH_TIMES).to(self.mean)
        mean, root = self._observe(self.primitive.motion.response.evaluate(s)[:, 0])
        lasting = self.primitive.motion.duration.double().log().reshape(1)
        mean, root = torch.cat([mean, lasting]), torch.cat([root, self.timing[None]])
        return gaussian(mean, root, positive("noise", noise, mean))

    def entropy(self, noise: float) -> Float[Tensor, ""]:
        """Entropy of motion and duration observed with this noise; see `observed`."""
        return self.observed(noise).entropy()

    def kl(self, other: "ProbabilisticDMP[P]", noise: float) -> Float[Tensor, ""]:
        """KL(self || other) of motion and duration observed with this noise.

        Raises:
            ValueError: The distributions differ in kind, columns, or reference of orientations.
        """
        one, two = (common_reference(each.primitive) for each in (self, other))
        alike = type(self.primitive) is type(other.primitive)
        if one is not None and two is not None:
            alike &= bool((to_error(one, two).abs() < SAME_ORIENTATION).all())
        if not alike or len(self.mean) != len(other.mean):
            raise ValueError("kl needs motions of one kind, with equal columns and references")
        return kl_divergence(self.observed(noise), other.observed(noise))

    def log_prob(
        self, time: Times, value: Points | Pose, *, noise: float
    ) -> Float[Tensor, "*batch"]:
        """Log density of values (*batch, n, D) observed at times (n,) with this sensor noise.

        For orientations, this is the density of the error to the primitive's reference. NaN
        marks values that were not observed.
        """
        deviation = positive("noise", noise, self.mean)
        value = value if isinstance(value, Pose) else to_tensor(value)
        batch = (value.position if isinstance(value, Pose) else value).shape[:-2]
        if batch:
            densities = [self.log_prob(time, value[i], noise=noise) for i in range(batch[0])]
            return torch.stack(densities) if densities else self.mean.new_zeros(batch)
        via = self._via(time, value, None)
        motion = self.primitive.motion
        mean, root = self._observe(motion.response.evaluate(via.s)[:, 0])
        seen = ~via.position.isnan().reshape(-1)
        values = via.position.reshape(-1)[seen]
        return gaussian(mean[seen], root[seen], deviation).log_prob(values)

    def _via(
        self, time: Times, value: Points | Pose | None, velocity: Points | None
    ) -> ViaPoints:
        with torch.no_grad():
            middle = self.mean_primitive()
        via = middle.via_points(time, value, velocity)
        if via.position.ndim != 2:
            raise ValueError(f"via points must be (n, D), got {tuple(via.position.shape)}")
        return via

    def _observe(self, rows: Float[Tensor, "T M"]) -> tuple[Tensor, Tensor]:
        """Mean (T D) of all columns at all times, and a square root of their covariance."""
        spread = self.spread.view(*self.mean.shape, -1)
        root = torch.einsum("tm,dmr->tdr", rows, spread)
        return (rows @ self.mean.mT).reshape(-1), root.flatten(0, 1)


def on_device(model: Any, device: torch.device | str) -> Any:
    """Dataclass of float64 tensors and a primitive on another device.

    Raises:
        ValueError: A dtype instead of a device.
    """
    if isinstance(device, torch.dtype):
        raise ValueError(f"{type(model).__name__} needs float64: change its device only")
    parts = {k: x.to(device) for k, x in vars(model).items() if isinstance(x, Tensor)}
    return replace(model, primitive=deepcopy(model.primitive).to(device), **parts)


def gaussian(
    mean: Float[Tensor, "*batch n"], root: Float[Tensor, "*batch n rank"], noise: Tensor
) -> LowRankMultivariateNormal:
    """Gaussian with covariance root root' + noise^2 I."""
    return LowRankMultivariateNormal(
        mean, root, noise.square().expand_as(mean), validate_args=False
    )


def _dependence_on_ends(motion: LinearPrimitive, x: Float[Tensor, "n D M"]) -> float:
    """Factor on the dependence of paths on start and goal that best predicts held-out paths."""
    n, s = len(x), torch.linspace(0, 1, PATH_TIMES).to(x)
    if n < FEWEST:
        return 1.0
    rows = motion.response.evaluate(s)[:, 0, :-2]
    ends, paths = x[..., -2:].flatten(1), (x[..., :-2] @ rows.mT).flatten(1)
    agree = size = 0.0
    for i in range(n):
        rest = torch.arange(n) != i
        e, p = ends[rest].mean(0), paths[rest].mean(0)
        predicted = (ends[i] - e) @ torch.linalg.pinv(ends[rest] - e, rtol=SINGULAR)
        predicted = predicted @ (paths[rest] - p)
        agree += float(predicted @ (paths[i] - p))
        size += float(predicted @ predicted)
    return min(max(agree / size, 0.0), 1.0) if size > 0 else 1.0


def columns_of_ends(like: Any, moved: Any) -> Float[Tensor, "2 D"]:
    """Start and goal of the primitive `moved`, in the columns of `like` (of the same kind)."""
    ends = torch.stack([moved.motion.start, moved.motion.goal])
    if (errors := like.error_columns) is not None:
        turned = [getattr(end, "orientation", end) for end in (moved.start, moved.goal)]
        usual = torch.stack([like.motion.start, like.motion.goal])[:, errors]
        error = to_error(torch.stack(turned), like.reference)
        ends[:, errors] = nearest_turn(error, usual)
    return ends


def _linear_coordinates(primitives: LinearPrimitive) -> Float[Tensor, "*batch D M"]:
    if primitives.scaling != "none":
        raise ValueError(f"scaling {primitives.scaling!r} is not linear: fit with 'none'")
    return primitives.coordinates().detach().double()


def _free_forcing(primitive: LinearPrimitive, slack: float) -> Float[Tensor, "DM DN"]:
    """Spread of independent weights that makes the forcing vary equally at all times."""
    check_not_negative("slack", slack)
    basis, amplitude = primitive.basis, primitive.amplitude.detach().double()
    D, N = len(amplitude), basis.count
    unit = 1 / basis.phase(basis.centre_times().to(amplitude))
    deviation = slack * primitive.spring.stiffness * amplitude[:, None] * unit
    spread = torch.zeros(D, N + 3, D, N).to(amplitude)
    spread[:, :N] = torch.diag_embed(deviation.flatten()).view(D, N, D, N)
    return spread.flatten(0, 1).flatten(1)
