"""Principal components of motions that continue from the current state of an arm.

A motion is a cubic spline. The first control points follow from the state, so that the spline
continues the current motion. The other control points are predicted from the state, and their
deviation from the prediction is a sum of orthogonal components of decreasing variance. A
network predicts the components, as continuous parameters (flows, diffusion) or as tokens
(`tokens.py`).
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp._arguments import Times, Vectors, checked_vector, seconds
from hrc_learn.dmp.samples import Samples

MARGIN = 0.1
"""Distance by which motions may exceed the demonstrated range, relative to the range."""
SHRINKAGE = 0.1
"""Weight of a separable covariance, the product of a covariance over time and a covariance
over columns. A few motions are enough to determine it."""
RIDGE = 1e-3
"""Ridge of the prediction from the start: values from 1e-4 to 1e-2 are equally good."""
POINTS = (6, 8, 10, 13, 16, 20, 26, 32, 40, 50, 64)
"""Numbers of control points to choose from."""
ROUGHNESS = 1e-8
"""Weight of squared second differences of control points; it matters where samples are few."""
SAME_DURATION = 0.01
"""Relative difference of durations up to which they count as equal."""
LONGEST = 3.0
"""Largest |log(duration / mean duration)|: durations differ from the mean by a factor of up to
20."""
TINY = 1e-24
"""Smallest variance, for columns that never move."""
TURN = 6.0
"""If the second control point lies beyond a limit, the third lies this many times as far inside
the limit. The motion then stays within the limit if the second control point exceeds it by at
most 2.5 times the margin."""
KNOWN_STATE = 2
DEGREE = 3


class MotionComponents(nn.Module):
    """Map from P parameters and a start to motions of D columns, linear within the limits.

    Parameters have unit variance; if all are zero, the motion is the most likely one from the
    given start. The map is computed in float64 and differentiable in parameters and start.
    """

    centre: Tensor
    """Middle of each column, (D,)."""
    scale: Tensor
    """Unit of each column, (D,)."""
    low: Tensor
    """Lower limit of each column, (D,)."""
    high: Tensor
    """Upper limit of each column, (D,)."""
    start: Tensor
    """Mean start, (D,)."""
    prediction: Tensor
    """Map from features of the start to free control points, (features, F)."""
    synthesis: Tensor
    """Map from components to free control points, (P, F)."""
    analysis: Tensor
    """Map from free control points to components, (F, P)."""
    spread: Tensor
    """Standard deviations of the components, (P,), largest first. The sum of their squares is
    the mean square deviation from the prediction, summed over the columns in their units."""

    def __init__(self, config: dict[str, float | int], tensors: dict[str, Tensor]):
        """Restore components; `fit` makes them.

        Args:
            config: Four numbers. `points` is the number of control points, and `duration` the
                geometric mean of durations [s]. `known` is the number of control points that
                the start determines, 1 by its position or 2 by position and velocity. `varying`
                is 1 if the logarithm of the duration is the last free value.
            tensors: The buffers of this class, by name.
        """
        super().__init__()
        self.config = config
        self.points, self.known = int(config["points"]), int(config["known"])
        self.duration, self.varying = float(config["duration"]), bool(config["varying"])
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)

    @classmethod
    @torch.no_grad()
    def fit(
        cls,
        samples: Samples,
        units: dict[str, Tensor],
        start_velocity: Float[Tensor, "N D"] | None,
        start_known: bool,
        accuracy: float,
    ) -> "MotionComponents":
        """Learn from N motions.

        Args:
            samples: Samples of the motions.
            units: Buffers `centre`, `scale`, `low` and `high`.
            start_velocity: Velocity at the start [1/s], if it will be known.
            start_known: True if the start will be known; False: the components determine it.
            accuracy: Largest root mean square error of the splines, in units of the columns.
        """
        duration = samples.duration.log().mean().exp()
        varying = bool(((samples.duration / duration).log().abs() > SAME_DURATION).any())
        known = (1 if start_velocity is None else KNOWN_STATE) if start_known else 0
        config = {"known": known, "duration": float(duration), "varying": int(varying)}
        units = units | {"start": samples.first.mean(0)}
        for points in POINTS:
            found = cls(config | {"points": points}, units)
            features, free, C = found._splines(samples, start_velocity)
            y = (samples.position.mT - found.centre) / found.scale
            error = (spline(samples.s, points) @ C - y)[samples.mask]
            if error.square().mean() <= accuracy**2 or points > y.shape[1]:
                break
        found._learn(features, free, C)
        return found

    def forward(
        self,
        parameters: Float[Tensor, "*batch P"],
        time: Times,
        start: Vectors | None = None,
        start_velocity: Vectors | None = None,
        *,
        order: int = 0,
    ) -> Float[Tensor, "*batch T D"]:
        """Motion that begins with the given position and velocity.

        Args:
            parameters: All P parameters, or the first ones if the others are zero.
            time: Time since the start [s], (T,) or (*batch, T). After its end a motion rests.
            start: Start, (*batch, D). None: the mean start if the components were fitted with
                known starts, else the start that the parameters encode.
            start_velocity: Velocity at the start [1/s], (*batch, D). None: zero if the
                components were fitted with start velocities, else the velocity that the
                parameters encode.
            order: Derivative with respect to time, 0, 1 or 2.

        Raises:
            ValueError: A wrong number of columns, more than P parameters, or bad times.
        """
        if order not in (0, 1, 2):
            raise ValueError(f"order must be 0, 1 or 2, got {order}")
        polygon, duration = self.polygon(parameters, start, start_velocity)
        s = seconds(time, polygon.device) / duration[..., None]
        y = spline(s.clamp(max=1), self.points, order) @ polygon
        y = y / duration[..., None, None] ** order * self.scale
        return y + self.centre if order == 0 else torch.where((s <= 1)[..., None], y, 0.0)

    @torch.no_grad()
    def encode(
        self, samples: Samples, start_velocity: Float[Tensor, "*batch D"] | None = None
    ) -> Float[Tensor, "B P"]:
        """Parameters of B recorded motions; arguments as for `fit`."""
        features, free, _ = self._splines(samples, start_velocity)
        return (free - features @ self.prediction) @ self.analysis / self.spread

    def polygon(
        self,
        parameters: Float[Tensor, "*batch P"],
        start: Vectors | None = None,
        start_velocity: Vectors | None = None,
    ) -> tuple[Float[Tensor, "*batch n D"], Float[Tensor, "*batch"]]:
        """Control points in units of the columns, and durations [s]; see `forward`."""
        z = parameters.to(self.spread)
        P = z.shape[-1]
        if len(self.spread) < P:
            raise ValueError(f"there are {len(self.spread)} parameters, got {P}")
        given = start is not None
        first = self.start if start is None else checked_vector("start", start, self.start)
        first = (first - self.centre) / self.scale
        velocity = None
        if start_velocity is not None:
            velocity = checked_vector("start_velocity", start_velocity, first) / self.scale
        x = self._features(first, velocity) @ self.prediction
        x = x + (z * self.spread[:P]) @ self.synthesis[:P]
        duration = torch.full_like(x[..., 0], self.duration)
        if self.varying:
            duration, x = duration * x[..., -1].clamp(-LONGEST, LONGEST).exp(), x[..., :-1]
        free = x.unflatten(-1, (-1, len(self.start)))
        if given and not self.known:
            # Bend the encoded motion towards the given start, less and less along the motion.
            bend = 1 - torch.arange(self.points).to(free)[:, None] / (self.points - 1)
            free = free + bend**2 * (first - free[..., 0, :])[..., None, :]
        low, high = ((edge - self.centre) / self.scale for edge in (self.low, self.high))
        # If the start lies beyond a limit, this limit moves outwards with it.
        margin = MARGIN / (1 + 2 * MARGIN) * (high - low)
        low = torch.minimum(low, first - margin)[..., None, :]
        high = torch.maximum(high, first + margin)[..., None, :]
        points = list(torch.minimum(torch.maximum(free, low), high).unbind(-2))
        begun = [first] if given or self.known else points[:1]
        if velocity is not None or self.known == KNOWN_STATE:
            rate = 0 if velocity is None else velocity * duration[..., None]
            begun.append(begun[0] + rate / (DEGREE * (self.points - DEGREE)))
        points = [*begun, *points[len(begun) - self.known :]]
        if len(begun) == KNOWN_STATE:
            # If the start velocity puts the second control point beyond a limit, the third
            # turns the motion back before it reaches the limit.
            low, high = low[..., 0, :], high[..., 0, :]
            turned = points[1].clamp(low, high) * (1 + TURN) - TURN * points[1]
            turned = turned.clamp(low, high)
            most = torch.where(points[1] > high, turned, torch.inf)
            least = torch.where(points[1] < low, turned, -torch.inf)
            points[2] = points[2].clamp(least, most)
        return torch.stack(torch.broadcast_tensors(*points), -2), duration

    def _features(self, first: Tensor, velocity: Tensor | None) -> Float[Tensor, "*batch K"]:
        """Features of a start, in units of the columns, on which the prediction depends."""
        rate = torch.zeros_like(first) if velocity is None else velocity * self.duration
        first, rate = torch.broadcast_tensors(first, rate)
        return torch.cat([torch.ones_like(first[..., :1]), first, rate][: 1 + self.known], -1)

    def _splines(self, samples: Samples, start_velocity: Tensor | None) -> tuple[Tensor, ...]:
        """Features of the start, free values, and least-squares control points."""
        y = (samples.position.mT.double() - self.centre) / self.scale
        velocity = None
        if start_velocity is not None and self.known == KNOWN_STATE:
            velocity = start_velocity.reshape(-1, y.shape[-1]) / self.scale
        rate = 0 if velocity is None else velocity * samples.duration[:, None]
        second = y[:, 0] + rate / (DEGREE * (self.points - DEGREE))
        fixed = torch.stack([y[:, 0], second], 1)[:, : self.known]
        shared = slice(0, 1 if samples.shared_grid else None)  # one solution serves all
        weight = samples.mask[shared, :, None] / samples.mask[shared].sum(-1)[:, None, None]
        B = spline(samples.s[shared], self.points)
        rough = torch.diff(torch.eye(self.points).to(y), n=2, dim=0)
        normal = (weight * B).mT @ B + ROUGHNESS * rough.mT @ rough
        # Masked samples may have any value, even NaN.
        right = (weight * B).mT @ torch.where(samples.mask[..., None], y, 0.0)
        right = (right - normal[..., : self.known] @ fixed)[:, self.known :]
        free = torch.linalg.solve(normal[:, self.known :, self.known :], right)
        C, free = torch.cat([fixed, free], 1), free.flatten(1)
        if self.varying:
            free = torch.cat([free, (samples.duration / self.duration).log()[:, None]], 1)
        return self._features(y[:, 0], velocity), free, C

    def _learn(self, features: Tensor, free: Tensor, C: Tensor) -> None:
        """Learn prediction and components from N motions."""
        N, _, D = C.shape
        s = torch.linspace(0, 1, 10 * self.points, dtype=C.dtype)
        B = spline(s, self.points)[:, self.known :]
        # The mean square of a motion is the squared norm of (free values @ metric).
        root = torch.linalg.cholesky(B.mT @ B / len(B)).contiguous()
        metric = torch.kron(root, torch.eye(D).to(C))
        if self.varying:
            # A relative error of the duration moves samples by the speed times this error.
            speed = (spline(s, self.points, 1) @ C).square().sum(-1).mean().sqrt()
            metric = torch.block_diag(metric, speed[None, None])
        ridge = RIDGE * N * torch.eye(features.shape[1]).to(C)
        ridge[0, 0] = 0  # the constant is not penalised
        W = torch.linalg.solve(features.mT @ features + ridge, features.mT @ free)
        x = (free - features @ W) @ metric
        covariance, F = x.mT @ x / N, len(root) * D
        y = x[:, :F].unflatten(1, (-1, D))
        over_time = torch.einsum("nfd,ngd->fg", y, y) / N
        over_columns = torch.einsum("nfd,nfe->de", y, y) / N
        separable = covariance.clone()
        separable[:F, :F] = torch.kron(over_time, over_columns)
        separable[:F, :F] /= over_columns.trace().clamp(min=TINY)
        variance, V = torch.linalg.eigh(covariance.lerp(separable, SHRINKAGE))
        V, back = V.flip(-1), torch.linalg.inv(metric)
        self.register_buffer("prediction", W)
        self.register_buffer("synthesis", V.mT @ back)
        self.register_buffer("analysis", metric @ V)
        self.register_buffer("spread", variance.flip(-1).clamp(min=TINY).sqrt())


def spline(s: Float[Tensor, "*batch T"], points: int, order: int = 0) -> Tensor:
    """Clamped uniform cubic B-splines on [0, 1], or their derivatives, (*batch, T, points).

    Recursion of Cox and de Boor (de Boor 1978, "A practical guide to splines", chapter X).
    """
    inner = torch.linspace(0, 1, points - DEGREE + 1, dtype=s.dtype, device=s.device)
    knots = torch.cat([inner.new_zeros(DEGREE), inner, inner.new_ones(DEGREE)])
    interval = torch.bucketize(s.detach(), inner[1:-1], right=True) + DEGREE
    B = nn.functional.one_hot(interval, points + DEGREE).to(s)
    for degree in range(1, DEGREE + 1):
        width = knots[degree:] - knots[:-degree]
        share = torch.where(width > 0, 1 / torch.where(width > 0, width, 1.0), 0.0)
        n = B.shape[-1] - 1
        left, right = B[..., :-1] * share[:n], B[..., 1:] * share[1 : n + 1]
        if degree > DEGREE - order:
            B = degree * (left - right)
        else:
            behind = s[..., None] - knots[:n]
            B = behind * left + (knots[degree + 1 :][:n] - s[..., None]) * right
    return B
