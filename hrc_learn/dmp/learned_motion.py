"""Learning of a motion with the model that best predicts each demonstration from the others.

A primitive is fitted to each of n demonstrations. The coordinates x_j of primitive j are its
weights, start velocity, start and goal. All models except the one with frames compute the
coordinates for a context c (known before the motion) as x(c) = sum_j w_j(c) x_j with
sum_j w_j = 1. These models are the mean, the nearest
demonstration, means weighted by a kernel of the distance of contexts (Nadaraya 1964), and ridge
regression on contexts (Forte et al. 2012, "On-line motion synthesis and adaptation using a
trajectory database"). If demonstration i is held out, the weights of the other demonstrations
have a closed form (for the regression: PRESS from the hat matrix, Allen 1974), so these models
are not fitted again. Each model may be shrunk towards the straight minimum-jerk motion, by the
factor from 0 to 1 that predicts best.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, cast

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.dmp._arguments import contexts_of, finite, to_tensor
from hrc_learn.dmp.framed_dmp import FramedDMP, Frames
from hrc_learn.dmp.joint_dmp import JointDMP, select_basis_count
from hrc_learn.dmp.motion_primitive import MotionPrimitive
from hrc_learn.dmp.pose_dmp import PoseDMP
from hrc_learn.dmp.probabilistic_dmp import (
    KINDS,
    columns_of_ends,
    common_reference,
    mean_primitive,
    with_common_reference,
)
from hrc_learn.dmp.solvers import fit_ridge
from hrc_learn.geometry import Pose
from hrc_learn.model_files import SavedModel, StoredModel

BASIS_COUNTS = (10, 20, 30, 50, 100)
"""Numbers of basis functions compared."""
APPROACHES = (1.0, 0.6)
"""Values of `FitOptions.approach` to compare. With 1, the motion adapts most smoothly. With
0.6, a new goal only shifts the last 40 % of the path."""
WIDTHS = (2.0, 1.0, 0.5, 0.25)
"""Widths of kernels, relative to the spread of the contexts."""
PENALTIES = (1.0, 0.1, 1e-2, 1e-3, 1e-6)
"""Ridges relative to the data. If the context is one number, a ridge of 1 halves its effect."""
FEWEST = 4
"""Smallest number of demonstrations for which a regression is tried besides the mean."""
CLEARLY, DEVIATIONS = 0.02, 0.8
"""A more complex model is chosen only if it decreases the mean error by the fraction `CLEARLY`
and by `DEVIATIONS` standard errors. On seven datasets, 0.5 to 1 standard errors gave the best
predictions of new motions (`benchmarks/bench_learn.py`)."""
GRID = 101
"""Number of times at which motions are compared."""
CONSTANT = 1e-9
"""Spread of a context, relative to its size, below which the context counts as constant."""


Kind = Literal["mean", "kernel", "nearest", "contextual", "frames", "line"]
"""Kinds of model, in this order: the mean, a mean weighted by the distance of contexts, the
nearest demonstration, a regression on contexts, a `FramedDMP`, and a straight line."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidate:
    """A model and its errors."""

    family: str
    """`"kernel"`, `"ridge"` or `"frames"`."""
    strength: float
    """Width of the kernel (infinite: mean; 0: nearest demonstration), or the ridge."""
    approach: float
    shrinkage: float
    """Factor on the deviation from the straight motion: 0 leaves only the straight motion."""
    error: Float[Tensor, "n"]
    """Root mean square error of each demonstration, predicted from all other demonstrations.
    The error of a column is relative to the largest range among columns of its kind
    (`_scale`)."""

    @property
    def kind(self) -> Kind:
        """Kind of the model; every kind except the line may be shrunk towards the line."""
        if self.shrinkage == 0:
            return "line"
        if self.family != "kernel":
            return "contextual" if self.family == "ridge" else "frames"
        named: dict[float, Kind] = {0.0: "nearest", math.inf: "mean"}
        return named.get(self.strength, "kernel")

    @property
    def name(self) -> str:
        """Model in words."""
        name = {
            "line": "straight line",
            "mean": "mean",
            "nearest": "nearest demonstration",
            "kernel": f"kernel of width {self.strength:g}",
            "contextual": f"regression with ridge {self.strength:g}",
            "frames": "frames",
        }[self.kind]
        if self.shrinkage == 0:
            return name
        shrunk = "" if self.shrinkage == 1 else f", shrunk to {self.shrinkage:.2f}"
        return f"{name}{shrunk}, approach {self.approach:g}"


def learn(
    demonstrations: Sequence[Any],
    *,
    context: Any = None,
    frames: Frames | None = None,
    n_basis: int | None = None,
    approach: float | None = None,
    **options: Any,
) -> "LearnedMotion":
    """Learn a motion from demonstrations; held-out errors select basis, approach and model.

    Args:
        demonstrations: Demonstrations as from `load_demos`, with `time` and `joint_position`,
            or with `time`, `position` and perhaps `orientation`. Alternatively, pairs (times,
            values): times (T,) [s]; values are joints or other coordinates (T, D), or a `Pose`
            with batch shape (T,).
        context: Values (n, C) that are known before each motion. None: start and goal.
        frames: Frames of each demonstration, (n, F), for positions in space.
        n_basis: Number of basis functions. None: the smallest of `BASIS_COUNTS` whose error on
            held-out samples is close to the smallest error.
        approach: As in `FitOptions`. None: one of `APPROACHES`.
        options: Further options for `fit` of the primitive.

    Raises:
        ValueError: No demonstrations, bad samples, or a wrong number of contexts or frames.
    """
    if not len(demonstrations):
        raise ValueError("there are no demonstrations to learn from")
    times, values = zip(*map(_samples, demonstrations), strict=True)
    fit, linear = _fit_of(times, values)
    if n_basis is None:
        n_basis = _basis_count(times, linear)
    options = {"smooth": True, **options}
    tried = APPROACHES if approach is None else (approach,)
    return choose([fit(n_basis, approach=b, **options) for b in tried], context, frames)


def choose(
    fits: Sequence[MotionPrimitive],
    context: Any = None,
    frames: Frames | None = None,
    *,
    regression_only: bool = False,
) -> "LearnedMotion":
    """Choose a model by its held-out error, for primitives fitted with different options.

    Args:
        fits: For each choice of options, a batch of primitives of the n demonstrations, fitted
            with `scaling="none"`.
        context: Values (n, C) known before each motion. None: start and goal, in columns.
        frames: Frames of each demonstration, (n, F); joint primitives only.
        regression_only: True to choose among the regressions on contexts only.

    Raises:
        ValueError: A context that is not finite, frames for orientations, or too few
            demonstrations for a regression.
    """
    if frames is not None and not isinstance(fits[0], JointDMP):
        raise ValueError("frames apply to positions only: leave out orientations or frames")
    fits = [with_common_reference(each) for each in fits]
    x = _coordinates(fits[0])
    n = len(x)
    given = torch.cat([x[..., -2], x[..., -1]], dim=-1)
    if context is not None:
        given = contexts_of(context, n, x.device)
    found = [c for each in fits for c in _candidates(each, given, frames)]
    only = regression_only
    eligible = [c for c in found if not only or (c.family == "ridge" and c.shrinkage == 1)]
    if not eligible:
        raise ValueError(f"a regression needs {FEWEST} demonstrations or more, got {n}")
    best = eligible[0]
    for candidate in eligible[1:] if n > 1 else ():
        better = best.error - candidate.error
        chance = DEVIATIONS * better.std() / n**0.5
        if better.mean() > max(CLEARLY * best.error.mean(), chance):
            best = candidate
    each = next(f for f in fits if f.motion.response.approach == best.approach)
    return LearnedMotion(
        each=each,
        context=given,
        by_ends=context is None,
        frames=frames if best.family == "frames" else None,
        chosen=best,
        candidates=tuple(found),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class LearnedMotion(StoredModel):
    """Motion as a function of start, goal, and a context or frames, predicted by one model."""

    each: MotionPrimitive
    """Batch of n primitives, one per demonstration; orientations have a common reference."""
    context: Float[Tensor, "n C"]
    by_ends: bool
    """True if the context consists of start and goal, in columns."""
    frames: Frames | None
    """Frames (n, F) if the model uses frames."""
    chosen: Candidate
    candidates: tuple[Candidate, ...] = ()
    """All models compared; none after loading."""

    def at(
        self,
        start: Any = None,
        goal: Any = None,
        duration: Any = None,
        *,
        context: Any = None,
        frames: Frames | None = None,
    ) -> Any:
        """Primitive for a start, goal and duration; by default, the model predicts them.

        Args:
            start: Start of one motion, in the form that `rollout` of the primitives accepts.
            goal: Goal of the motion, in the same form.
            duration: Duration [s].
            context: Context of the motion, (C,), if the demonstrations had contexts.
            frames: Frames of the motion, (F,), if the model uses frames.

        Raises:
            ValueError: A context or frames are missing or have the wrong size, or a context
                is given to a model without contexts.
        """
        by_frames = self.chosen.family == "frames"
        if context is not None and (by_frames or self.by_ends):
            known = "frames" if by_frames else "start and goal"
            raise ValueError(f"this model predicts from {known}: leave out the context")
        if by_frames:
            assert self.frames is not None
            if frames is None:
                raise ValueError(f"give the {self.frames.b.shape[-2]} frames of the motion")
            x = FramedDMP.of(cast(JointDMP, self.each), self.frames).at(frames).coordinates()
            w = torch.full((1, len(self.context)), 1 / len(self.context)).to(x)
            found = self._primitives(x[None], w)
        else:
            if self.by_ends:
                like = mean_primitive(self.each)
                like = self.each.with_motion(like.motion, common_reference(self.each))
                context = columns_of_ends(like, like.with_boundary(start, goal))
            elif context is None:
                size = self.context.shape[1]
                raise ValueError(f"give the context of the motion, {size} numbers")
            found = self.at_contexts(to_tensor(context, torch.float64).reshape(1, -1))
        return found[0].with_boundary(start, goal, duration)

    def at_contexts(self, context: Float[Tensor, "q C"]) -> MotionPrimitive:
        """Primitives for contexts; the model also predicts start, goal and duration.

        Gradients flow to the contexts.

        Raises:
            ValueError: The model uses frames, or contexts have the wrong size.
        """
        if self.chosen.family == "frames":
            raise ValueError("a model of frames has no contexts: use `at`")
        if context.shape[-1] != self.context.shape[-1]:
            raise ValueError(
                f"context must have {self.context.shape[-1]} numbers, got {context.shape[-1]}"
            )
        finite("context", context)
        w = _weights(self.chosen.family, self.chosen.strength, self.context, context)
        x = torch.einsum("qn,ndm->qdm", w, _coordinates(self.each))
        return self._primitives(x, w)

    def _primitives(
        self, x: Float[Tensor, "q D M"], w: Float[Tensor, "q n"]
    ) -> MotionPrimitive:
        """Primitives with the coordinates `x` after shrinkage.

        Durations are geometric means of the demonstrated durations with weights `w`.
        """
        lasting = (w @ self.each.motion.duration.detach().double().log()).exp()
        x = _shrunk(x, self.chosen.shrinkage)
        middle, reference = mean_primitive(self.each).motion, common_reference(self.each)
        return self.each.with_motion(middle.with_coordinates(x, lasting), reference)

    def rollout(self, time: Any = None, *arguments: Any, **options: Any) -> Any:
        """Motion at times [s]; other arguments as for `at`."""
        return self.at(*arguments, **options).rollout(time)

    @property
    def reasons(self) -> str:
        """Chosen model with its held-out error, and the errors of simple models, as text."""
        each, known = self.each.motion, {"chosen": self.chosen}
        for candidate in self.candidates:
            if candidate.kind in ("mean", "nearest", "line"):
                known.setdefault(candidate.name.split(",")[0], candidate)
        lines = [
            f"{name}: {100 * c.error.median():.2f} % median, "
            f"{100 * c.error.quantile(0.9):.2f} % at the 90th percentile"
            for name, c in known.items()
        ]
        about = f"{self.chosen.name}, {each.basis.count} basis functions"
        return "\n".join([f"{about}; held-out error relative to the range:", *lines])

    def config(self) -> dict[str, Any]:
        """Config of the primitives, and the chosen model."""
        own = {k: v for k, v in vars(self.chosen).items() if k != "error"}
        # JSON has no infinite numbers.
        own["strength"] = None if math.isinf(self.chosen.strength) else self.chosen.strength
        own |= {"by_ends": self.by_ends, "primitive": type(self.each).__name__}
        return self.each.config() | {"learned": own}

    def tensors(self) -> dict[str, Tensor]:
        """Tensors of the primitives, contexts, errors, and frames if the model uses them."""
        own = {"context": self.context, "error": self.chosen.error}
        if self.frames is not None:
            own |= {"frames.A": self.frames.A, "frames.b": self.frames.b}
        return self.each.tensors() | own

    @classmethod
    def restore[S: "LearnedMotion"](cls: type[S], saved: SavedModel) -> S:
        error = saved.tensor("error")

        def parts(own: dict[str, Any]) -> tuple[type[MotionPrimitive], bool, Candidate]:
            kind, by_ends = KINDS[own.pop("primitive")], bool(own.pop("by_ends"))
            own["strength"] = math.inf if own["strength"] is None else float(own["strength"])
            return kind, by_ends, Candidate(**own, error=error)

        kind, by_ends, chosen = saved.part("learned", dict, parts)
        frames = None
        if chosen.family == "frames":
            frames = Frames(saved.tensor("frames.A"), saved.tensor("frames.b"))
        each, context = kind.restore(saved), saved.tensor("context")
        return cls(each=each, context=context, by_ends=by_ends, frames=frames, chosen=chosen)


def _samples(demonstration: Any) -> tuple[Tensor, Any]:
    """Times and values of one demonstration."""
    is_sequence = isinstance(demonstration, Sequence)
    parts = tuple(demonstration) if is_sequence else ()
    if len(parts) == 2:
        time, values = parts
        if isinstance(values, Pose):
            return to_tensor(time), values
        values = to_tensor(values)
        return to_tensor(time), values[:, None] if values.ndim == 1 else values
    for name in ("joint_position", "position"):
        values = getattr(demonstration, name, None)
        turned = getattr(demonstration, "orientation", None)
        if values is not None and name == "position" and turned is not None:
            return to_tensor(demonstration.time), Pose(to_tensor(values), to_tensor(turned))
        if values is not None:
            return to_tensor(demonstration.time), to_tensor(values)
    raise ValueError("found neither joint positions nor positions, nor a pair (times, values)")


def _fit_of(
    times: Sequence[Tensor], values: Sequence[Any]
) -> tuple[Callable[..., MotionPrimitive], list[Tensor]]:
    """Fit function for these values, and the coordinates by which the basis is chosen."""
    if isinstance(values[0], Pose):
        position = [pose.position for pose in values]
        turned = [pose.orientation for pose in values]
        return partial(PoseDMP.fit, list(times), position, turned), position
    return partial(JointDMP.fit, list(times), list(values)), list(values)


def _basis_count(times: Sequence[Tensor], values: Sequence[Tensor]) -> int:
    """Smallest number of functions whose error on held-out samples is close to the smallest."""
    shortest = min(map(len, times))
    possible = [n for n in BASIS_COUNTS if 2 * n <= shortest]
    if len(possible) < 2:
        return BASIS_COUNTS[0]
    return select_basis_count(list(times), list(values), possible, n_folds=3, smooth=True).count


def _coordinates(each: MotionPrimitive) -> Float[Tensor, "n D M"]:
    x = each.motion.coordinates().detach().double()
    return x.reshape(-1, *x.shape[-2:])


def _shrunk(x: Float[Tensor, "*batch D M"], factor: float) -> Float[Tensor, "*batch D M"]:
    """Coordinates whose deviation from the straight motion is multiplied by `factor`."""
    return torch.cat([factor * x[..., :-2], x[..., -2:]], dim=-1)


def _candidates(
    each: MotionPrimitive, context: Float[Tensor, "n C"], frames: Frames | None
) -> list[Candidate]:
    """Models of primitives, the simplest first, each with and without shrinkage."""
    x, response = _coordinates(each), each.motion.response
    n, make = len(x), partial(Candidate, approach=response.approach)
    if n == 1:
        zero = torch.zeros(1, dtype=torch.float64)
        return [make(family="kernel", strength=math.inf, shrinkage=1.0, error=zero)]
    models = [("kernel", width) for width in (math.inf, *WIDTHS, 0.0)]
    models += [("ridge", penalty) for penalty in PENALTIES if n >= FEWEST]
    held = [
        (family, strength, torch.einsum("in,ndm->idm", w, x))
        for family, strength in models
        for w in [_weights(family, strength, context)]
    ]
    if frames is not None:
        held.append(("frames", 1.0, _from_frames(cast(JointDMP, each), frames)))
    rows = response.evaluate(torch.linspace(0, 1, GRID).to(x))[:, 0]
    shown, found = x @ rows.mT, []
    scale = _scale(each, shown)
    for family, strength, made in held:
        made = torch.cat([made[..., :-2], x[..., -2:]], dim=-1)
        straight = _shrunk(made, 0.0) @ rows.mT / scale
        bent, wanted = made @ rows.mT / scale - straight, shown / scale - straight
        factor = (bent * wanted).sum() / bent.square().sum().clamp(min=1e-30)
        for shrinkage in (1.0, float(factor.clamp(0, 1)), 0.0):
            error = (shrinkage * bent - wanted).square().mean((-2, -1)).sqrt()
            found.append(
                make(family=family, strength=strength, shrinkage=shrinkage, error=error)
            )
    return found


def _scale(each: MotionPrimitive, shown: Float[Tensor, "n D T"]) -> Float[Tensor, "n D 1"]:
    """Unit of the error of each column: the largest range among columns of its kind.

    Positions, orientation errors and body coordinates (see `PoseDMP`) are different kinds.
    The unit of a kind that does not move is 1.
    """
    span = shown.amax(-1) - shown.amin(-1)
    errors = each.error_columns
    parts = [slice(None)]
    if errors is not None:
        parts = [slice(0, errors.start), errors, slice(errors.stop, None)]
    for part in parts:
        if span[:, part].numel():
            largest = span[:, part].amax(1, keepdim=True)
            span[:, part] = torch.where(largest > CONSTANT, largest, 1.0)
    return span[..., None]


def _from_frames(each: JointDMP, frames: Frames) -> Float[Tensor, "n D M"]:
    """Coordinates of each demonstration, predicted from its frames and the others' motions."""
    n, made = len(each), []
    for i in range(n):
        rest = torch.arange(n) != i
        model = FramedDMP.of(each[rest], Frames(frames.A[rest], frames.b[rest]))
        made.append(model.at(Frames(frames.A[i], frames.b[i])).coordinates().detach().double())
    return torch.stack(made)


def _weights(
    family: str,
    strength: float,
    known: Float[Tensor, "n C"],
    asked: Float[Tensor, "q C"] | None = None,
) -> Float[Tensor, "q n"]:
    """Weights w(c) of the demonstrations for the contexts `asked`.

    If `asked` is None: held-out weights for the context of each demonstration.
    """
    held_out, n = asked is None, len(known)
    query = known if asked is None else asked.to(known)
    spread = known.std(0) if n > 1 else torch.zeros_like(known[0])
    varies = spread > CONSTANT * (1 + known.abs().amax(0))
    middle, spread = known.mean(0), torch.where(varies, spread, math.inf)
    a, b = (query - middle) / spread, (known - middle) / spread
    if family == "kernel":
        distance = torch.cdist(a, b) / max(int(varies.sum()), 1) ** 0.5
        if math.isinf(strength):
            distance, strength = torch.zeros_like(distance), 1.0
        if held_out:
            distance.fill_diagonal_(math.inf)
        if strength == 0:
            return torch.nn.functional.one_hot(distance.argmin(1), n).to(known)
        return torch.softmax(-((distance / strength) ** 2) / 2, dim=1)
    # With one unit vector per demonstration as target, the predictions are the weights.
    unit = torch.eye(n).to(b)
    fit = fit_ridge(b, unit, strength, standardize=False)
    if held_out:
        return unit - fit.held_out
    return torch.nn.functional.pad(a - fit.mean, (1, 0), value=1.0) @ fit.coefficients
