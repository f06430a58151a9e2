"""What every region promises, checked on each of them in every formulation."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import sampling
import torch
from torch import Tensor
from torch.utils import _pytree

from hrc_learn.geometry import quaternion
from hrc_learn.regions import (
    AxisRegion,
    JointRegion,
    OrientationRegion,
    PositionRegion,
    PostureRegion,
    Region,
    VisionRegion,
)


def translate(x: Tensor, step: Tensor) -> Tensor:
    return x + step


def rotate(x: Tensor, step: Tensor) -> Tensor:
    return quaternion.multiply(quaternion.exp(step), x)


@dataclass(frozen=True)
class Case:
    """One region: how to make it for a batch, where to probe it, how its space moves."""

    make: Callable[..., Region]
    sample: Callable[..., Tensor]
    delicate: Callable[[], Tensor]
    """Points where a careless formula is singular, all for the region of batch ()."""
    freedom: int
    exact: bool = True
    """Whether the gradient is that of the potential."""
    move: Callable[[Tensor, Tensor], Tensor] = translate


def rand(*shape: int, rng: torch.Generator) -> Tensor:
    return torch.rand(*shape, generator=rng, dtype=torch.float64)


def joint(formulation: str) -> Case:
    def make(*batch: int, rng: torch.Generator) -> JointRegion:
        lower = -1.5 - rand(*batch, 7, rng=rng)
        return JointRegion.from_limits(lower, lower + 4, formulation=formulation)

    def delicate() -> Tensor:
        region = make(rng=sampling.generator())
        edges = region.half_range - torch.tensor([[0.0], [0.1], [0.3], [2.0], [-0.2]])
        return torch.cat([region.centre + edges, region.centre - edges]).double()

    return Case(make, lambda *b, rng: -3 + 6 * rand(*b, 7, rng=rng), delicate, 7)


def position(stiffness=4e-3, formulation="paper") -> Case:
    def make(*batch: int, rng: torch.Generator) -> PositionRegion:
        return PositionRegion(
            centre=rand(*batch, 3, rng=rng),
            half_size=0.05 + 0.1 * rand(*batch, 3, rng=rng),
            stiffness=stiffness,
            formulation=formulation,
        )

    def delicate() -> Tensor:
        region = make(rng=sampling.generator())
        edges = [region.centre + k * region.half_size for k in range(3)]
        return torch.stack(edges)

    return Case(make, lambda *b, rng: rand(*b, 3, rng=rng), delicate, 3)


def step_rotation_vector(x: Tensor, step: Tensor) -> Tensor:
    return quaternion.exp(quaternion.log(x) + step)


def orientation(formulation: str, coordinates: str = "rotation") -> Case:
    def make(*batch: int, rng: torch.Generator) -> OrientationRegion:
        goal = sampling.quaternions(*batch, rng=rng)
        return OrientationRegion(goal=goal, formulation=formulation, coordinates=coordinates)

    def delicate() -> Tensor:
        region = make(rng=sampling.generator())
        angles = [0.0, 1e-9, region.tolerance, torch.pi, torch.pi - 1e-9, 2 * torch.pi]
        vectors = torch.tensor([[a, 0, 0] for a in angles], dtype=torch.float64)
        return quaternion.multiply(quaternion.exp(vectors), region.goal)

    return Case(
        make,
        lambda *b, rng: sampling.quaternions(*b, rng=rng),
        delicate,
        3,
        exact=formulation == "exact",
        move=rotate if coordinates == "rotation" else step_rotation_vector,
    )


def axis() -> Case:
    def make(*batch: int, rng: torch.Generator) -> AxisRegion:
        return AxisRegion(goal=sampling.quaternions(*batch, rng=rng))

    def delicate() -> Tensor:
        region = make(rng=sampling.generator())
        angles = [0.0, 1e-9, region.tolerance, torch.pi, torch.pi - 1e-9, 2 * torch.pi]
        tilts = [[a, 0, 0] for a in angles] + [[0, 0, a] for a in angles]
        vectors = torch.tensor(tilts, dtype=torch.float64)
        return quaternion.multiply(region.goal, quaternion.exp(vectors))

    return Case(
        make, lambda *b, rng: sampling.quaternions(*b, rng=rng), delicate, 3, move=rotate
    )


def vision(formulation: str, points: int = 1) -> Case:
    rows = 2 * points

    def make(*batch: int, rng: torch.Generator) -> VisionRegion:
        target = 300 + 400 * rand(*batch, rows, rng=rng)
        return replace(VisionRegion.inside_image(target, (1440, 1080)), formulation=formulation)

    def delicate() -> Tensor:
        region = make(rng=sampling.generator())
        edge = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0], [3.0, 3.0]])
        return region.target + edge.repeat(1, points) * region.half_size

    return Case(make, lambda *b, rng: 1000 * rand(*b, rows, rng=rng), delicate, rows)


def posture() -> Case:
    def make(*batch: int, rng: torch.Generator) -> PostureRegion:
        return PostureRegion(goal=rand(*batch, 7, rng=rng))

    def delicate() -> Tensor:
        goal = make(rng=sampling.generator()).goal
        return torch.stack([goal, goal + 0.05 * torch.eye(7)[0], goal + 100])

    return Case(make, lambda *b, rng: -3 + 6 * rand(*b, 7, rng=rng), delicate, 7)


CASES = {
    "joint": joint("one_sided"),
    "joint-paper": joint("paper"),
    "position": position(),
    "position-per-axis": position(stiffness=(4e-3, 4e-3, 4e-4)),
    "position-saturated": position(stiffness=(4e-3, 4e-3, 4e-4), formulation="saturated"),
    "orientation": orientation("exact"),
    "orientation-paper": orientation("paper"),
    "orientation-vector": orientation("exact", "rotation_vector"),
    "orientation-vector-paper": orientation("paper", "rotation_vector"),
    "axis": axis(),
    "posture": posture(),
    "vision": vision("paper"),
    "vision-saturated": vision("saturated"),
    "vision-corners": vision("paper", points=4),
    "vision-corners-saturated": vision("saturated", points=4),
}
every_region = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
exact_regions = pytest.mark.parametrize(
    "case", [c for c in CASES.values() if c.exact], ids=[n for n, c in CASES.items() if c.exact]
)


@exact_regions
def test_gradient_is_the_derivative_of_the_potential(case: Case):
    rng = sampling.generator(1)
    region, x = case.make(200, rng=rng), case.sample(200, rng=rng)
    step = torch.zeros(200, case.freedom, dtype=torch.float64, requires_grad=True)
    P = region.potential(case.move(x, step))
    (automatic,) = torch.autograd.grad(P.sum(), step)
    gradient = region.gradient(x)
    assert gradient.abs().max() > 1e-5  # the samples do leave the regions
    torch.testing.assert_close(gradient, automatic, rtol=1e-9, atol=1e-12)


@exact_regions
def test_gradient_equals_central_differences(case: Case):
    rng = sampling.generator(2)
    region, x = case.make(50, rng=rng), case.sample(50, rng=rng)
    # Pixels are larger than metres and radians: a step too short drowns in rounding.
    h = 1e-3 if isinstance(region, VisionRegion) else 1e-6
    steps = h * torch.eye(case.freedom, dtype=torch.float64)
    columns = [
        (region.potential(case.move(x, s)) - region.potential(case.move(x, -s))) / (2 * h)
        for s in steps
    ]
    torch.testing.assert_close(
        region.gradient(x), torch.stack(columns, -1), rtol=1e-6, atol=1e-6
    )


@every_region
def test_everything_is_finite_where_formulas_are_delicate(case: Case):
    region, x = case.make(rng=sampling.generator()), case.delicate()
    step = torch.zeros(len(x), case.freedom, dtype=torch.float64, requires_grad=True)
    moved = case.move(x, step)
    for output in (region.value(moved), region.potential(moved), region.gradient(moved)):
        (derivative,) = torch.autograd.grad(output.sum(), step, retain_graph=True)
        assert output.isfinite().all()
        assert derivative.isfinite().all()


@every_region
@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_a_batch_is_a_loop(case: Case, batch: tuple[int, ...]):
    rng = sampling.generator(3)
    region, x = case.make(*batch, rng=rng), case.sample(*batch, rng=rng)
    whole = (region.value(x), region.potential(x), region.gradient(x))
    for i in np.ndindex(batch):
        one = _pytree.tree_map(lambda t, i=i: t[i], region)
        for part, total in zip(
            (one.value(x[i]), one.potential(x[i]), one.gradient(x[i])), whole, strict=True
        ):
            torch.testing.assert_close(part, total[i], rtol=1e-12, atol=1e-14)


@every_region
def test_one_region_serves_many_points_and_many_regions_one_point(case: Case):
    rng = sampling.generator(4)
    one, many = case.make(rng=rng), case.make(5, rng=rng)
    x = case.sample(5, rng=rng)
    assert one.gradient(x).shape == many.gradient(x[0]).shape == (5, case.freedom)
    assert one.potential(x).shape == many.potential(x[0]).shape == (5,)


@every_region
def test_goes_through_vmap(case: Case):
    rng = sampling.generator(5)
    region, x = case.make(4, rng=rng), case.sample(4, rng=rng)
    mapped = torch.vmap(lambda region, x: region.gradient(x))(region, x)
    torch.testing.assert_close(mapped, region.gradient(x), rtol=1e-12, atol=1e-14)


@every_region
def test_follows_the_dtype(case: Case):
    rng = sampling.generator(6)
    region, x = case.make(rng=rng), case.sample(rng=rng)
    region = _pytree.tree_map(lambda t: t.float(), region)
    assert region.gradient(x.float()).dtype == torch.float32
