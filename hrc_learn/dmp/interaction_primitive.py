"""Prediction of a person's and the robot's motion from the beginning of the person's motion.

In an interaction primitive (Ben Amor et al. 2014; Maeda et al. 2017, "Probabilistic movement
primitives for coordination of multiple human-robot collaborative tasks"), the motions of person
and robot are jointly Gaussian. The observed part of the person's motion therefore determines
the most likely motion of the robot. The kind of interaction and its duration are inferred too:
each combination of kind and duration has a likelihood in closed form.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import Points, Times, finite, positive, seconds, to_tensor
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.probabilistic_dmp import ProbabilisticDMP, gaussian
from hrc_learn.dmp.samples import padded

DURATIONS = 31
"""Number of durations compared for each kind. Their logarithms lie within three standard
deviations of the mean, 0.2 standard deviations apart; the likelihoods of closer durations
hardly differ for a few samples."""
MINIMUM_SPREAD = 0.05
"""Smallest standard deviation of the logarithm of durations. A person repeats a duration to
about five percent at best; the durations of a few demonstrations may agree better by chance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class InteractionPrimitive:
    """Joint Gaussians over the motions of a person and a robot, one per kind of interaction."""

    kinds: tuple[str, ...]
    models: tuple[ProbabilisticDMP[JointDMP], ...]
    """Gaussian of each kind over all columns, the person's columns first."""
    prior: Float[Tensor, "K"]
    """Fraction of the demonstrations that belong to each kind."""
    log_duration: Float[Tensor, "K 2"]
    """Mean and standard deviation of the logarithm of durations [s]."""
    observed: int
    """Number of columns of the person."""

    @classmethod
    def fit(
        cls,
        time: Times | Sequence[Times],
        person: Points | Sequence[Points],
        robot: Points | Sequence[Points],
        kinds: Sequence[str] | None = None,
        *,
        n_basis: int = 15,
        slack: float = 0.0,
    ) -> "InteractionPrimitive":
        """Learn from demonstrations of a person and a robot.

        Args:
            time: Timestamps [s] of person and robot, (T,), (B, T) or a list of (T_i,).
            person: Observed columns of the person, (B, T, H) or a list of (T_i, H).
            robot: Columns of the robot, (B, T, R) or a list of (T_i, R).
            kinds: Kind of each demonstration; None: all are of one kind.
            n_basis: Number of basis functions of each column.
            slack: Freedom beyond the variation of the demonstrations; see
                `ProbabilisticDMP.fit`.

        Raises:
            ValueError: Fewer than two demonstrations of a kind, or lengths that differ.
        """
        time, mask, (person, robot) = padded(time, None, person, robot)
        person, robot = (to_tensor(x, torch.float64) for x in (person, robot))
        if person.ndim != 3 or robot.shape[:2] != person.shape[:2]:
            raise ValueError(
                "person and robot must be (B, T, columns) with equal B and T, got "
                f"{tuple(person.shape)} and {tuple(robot.shape)}"
            )
        kinds = ["interaction"] * len(person) if kinds is None else list(kinds)
        if len(kinds) != len(person):
            raise ValueError(f"{len(kinds)} kinds for {len(person)} demonstrations")
        names = tuple(dict.fromkeys(kinds))
        both = JointDMP.fit(time, torch.cat([person, robot], -1), n_basis, mask=mask)
        models, durations = [], []
        for name in names:
            members = [i for i, kind in enumerate(kinds) if kind == name]
            if len(members) < 2:
                raise ValueError(f"kind {name!r} has one demonstration: it needs two or more")
            models.append(ProbabilisticDMP.fit(both[members], slack))
            logarithm = both.duration[members].double().log()
            spread = logarithm.std().clamp(min=MINIMUM_SPREAD)
            durations.append(torch.stack([logarithm.mean(), spread]))
        counts = torch.tensor([kinds.count(name) for name in names], dtype=torch.float64)
        return cls(
            kinds=names,
            models=tuple(models),
            prior=counts / counts.sum(),
            log_duration=torch.stack(durations),
            observed=person.shape[-1],
        )

    def observe(self, time: Times, person: Points, noise: float) -> "InteractionEstimate":
        """Estimate of the interaction from the observed part of the person's motion.

        Args:
            time: Time since the person started [s], (n,).
            person: Observed columns, (n, H); NaN where nothing was observed.
            noise: Standard deviation of each value, from the sensor and from the person's
                variation between samples.

        Raises:
            ValueError: Wrong shapes, times that are negative or not finite, infinite values, or
                no observation at all.
        """
        values = to_tensor(person, torch.float64)
        seen_at = seconds(time, values.device)
        if seen_at.ndim != 1 or values.shape != (len(seen_at), self.observed):
            raise ValueError(
                f"time and person must be (n,) and (n, {self.observed}), got "
                f"{tuple(seen_at.shape)} and {tuple(values.shape)}"
            )
        if values.isnan().all():
            raise ValueError("no value of the person was observed")
        finite("person", values[~values.isnan()])
        deviation = positive("noise", noise, values)
        steps = torch.linspace(-3, 3, DURATIONS, dtype=torch.float64)
        duration = (self.log_duration[:, :1] + self.log_duration[:, 1:] * steps).exp()
        likelihood = torch.stack(
            [
                self._log_likelihood(model, seen_at / tau[:, None], values, deviation)
                for model, tau in zip(self.models, duration, strict=True)
            ]
        )
        score = likelihood - steps.square() / 2 + self.prior.log()[:, None]
        posterior = torch.softmax(score.flatten(), 0).view_as(score)
        probability = posterior.sum(-1)
        kind = int(probability.argmax())
        # Durations are log-normal: average their logarithms.
        within = posterior[kind] / probability[kind]
        expected = (within * duration[kind].log()).sum().exp()
        model = self.models[kind]
        free = len(model.mean) - self.observed
        whole = torch.nn.functional.pad(values, (0, free), value=math.nan)
        scale = model.primitive.duration.double() / expected
        return InteractionEstimate(
            kind=self.kinds[kind],
            probability=probability,
            duration=expected.item(),
            phase=(seen_at.max() / expected).clamp(max=1).item(),
            motion=model.condition(seen_at * scale, whole, noise=noise),
            observed=self.observed,
        )

    def _log_likelihood(
        self,
        model: ProbabilisticDMP[JointDMP],
        s: Float[Tensor, "G n"],
        values: Float[Tensor, "n H"],
        noise: Tensor,
    ) -> Float[Tensor, "G"]:
        """Log density of the observation for G durations, each with normalised times in `s`."""
        rows = model.primitive.response.evaluate(s)[:, :, 0]
        mean = rows @ model.mean[: self.observed].mT
        spread = model.spread.view(*model.mean.shape, -1)[: self.observed]
        seen = ~values.isnan().flatten()
        root = torch.einsum("gnm,hmr->gnhr", rows, spread).flatten(1, 2)[:, seen]
        return gaussian(mean.flatten(1)[:, seen], root, noise).log_prob(values.flatten()[seen])


@dataclass(frozen=True, kw_only=True, eq=False)
class InteractionEstimate:
    """Estimated interaction, and the predicted motion of person and robot."""

    kind: str
    """Most likely kind."""
    probability: Float[Tensor, "K"]
    """Probability of each kind, summed over durations."""
    duration: float
    """Expected duration [s]."""
    phase: float
    """Elapsed fraction of the duration, 0 to 1."""
    motion: ProbabilisticDMP[JointDMP]
    """Motion of person and robot given the observation, with the duration of its primitive."""
    observed: int
    """Number of columns of the person."""

    def robot(self, time: Times) -> tuple[Float[Tensor, "T R"], Float[Tensor, "T R"]]:
        """Mean and standard deviation of the robot at times [s] since the person started."""
        mean, deviation = self._both(time)
        return mean[:, self.observed :], deviation[:, self.observed :]

    def person(self, time: Times) -> tuple[Float[Tensor, "T H"], Float[Tensor, "T H"]]:
        """Mean and standard deviation of the person at times [s] since the person started."""
        mean, deviation = self._both(time)
        return mean[:, : self.observed], deviation[:, : self.observed]

    def stiffness(self, time: Times, largest: float, tolerance: float) -> Float[Tensor, "T R"]:
        """Stiffness for tracking the mean, lower where the prediction is uncertain.

        It is `largest` times tolerance^2 / (tolerance^2 + variance), the weight of the
        prediction in a product with a Gaussian of standard deviation `tolerance`.
        """
        variance = self.robot(time)[1].square()
        return largest * tolerance**2 / (tolerance**2 + variance)

    def _both(self, time: Times) -> tuple[Tensor, Tensor]:
        scale = self.motion.primitive.duration.double() / self.duration
        return self.motion.position(to_tensor(time, torch.float64) * scale)
