"""The limits of Franka's arms beside their formula, written out in plain numbers."""

import math
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import pytest
import torch
from fr3_tables import FR3_TABLES
from sampling import generator, within
from torch.testing import assert_close

from hrc_learn.kinematics import JointLimits, fr3, panda


def everywhere(*batch: int) -> torch.Tensor:
    """Joint positions within any vintage's limits and up to 0.2 rad past them."""
    limits = FR3_TABLES["documentation"]
    return within(limits.lower, limits.upper, *batch, rng=generator(), margin=-0.2)


def published(limits: JointLimits, q: list[float]) -> tuple[list[float], list[float]]:
    """Franka's formula, joint by joint as it stands in the documentation."""
    assert limits.velocity_offset is not None
    assert limits.deceleration is not None
    lower, upper = [], []
    for i, angle in enumerate(q):
        fastest, o, d, least, most = (
            float(row[i])
            for row in (
                limits.velocity,
                limits.velocity_offset,
                limits.deceleration,
                limits.lower,
                limits.upper,
            )
        )
        up = max(0.0, -o + math.sqrt(max(0.0, 2 * d * (most - angle))))
        down = min(0.0, o - math.sqrt(max(0.0, 2 * d * (-least + angle))))
        upper.append(min(fastest, up))
        lower.append(max(-fastest, down))
    return lower, upper


@pytest.mark.parametrize("vintage", FR3_TABLES)
def test_velocity_limits_are_those_of_the_published_formula(vintage):
    limits = FR3_TABLES[vintage]
    q = everywhere(300)
    lower, upper = limits.velocity_bounds(q)
    for k, row in enumerate(q.tolist()):
        least, most = published(limits, row)
        assert upper[k].tolist() == pytest.approx(most, abs=1e-12)
        assert lower[k].tolist() == pytest.approx(least, abs=1e-12)
    assert (upper == 0).any()
    assert (upper == limits.velocity).any(0).all(), "each joint is free somewhere"


@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_velocity_limits_of_any_batch(batch):
    q = everywhere(*batch)
    for arm in (fr3, panda):
        for bound in arm.limits.velocity_bounds(q):
            assert bound.shape == (*batch, 7)
        for bound in arm.limits.velocity_bounds(q.float()):
            assert bound.dtype == torch.float32


def test_those_of_the_panda_are_the_same_everywhere():
    lower, upper = panda.limits.velocity_bounds(everywhere(20))
    assert bool((upper == panda.limits.velocity).all())
    assert bool((lower == -panda.limits.velocity).all())


def test_they_are_differentiable_at_limits_and_past_them_too():
    limits = fr3.limits
    # On the curve, whose ends are corners: 13 mrad before a limit and further than 0.15 rad.
    near = within(torch.full((7,), 0.03), torch.full((7,), 0.15), 20, rng=generator(2)).double()

    def both(x: torch.Tensor) -> torch.Tensor:
        return torch.cat(limits.velocity_bounds(x), dim=-1)

    for q in (limits.lower + near, limits.upper - near):
        assert torch.autograd.gradcheck(both, q.clone().requires_grad_())
    for edge in (limits.lower, limits.upper, limits.upper + 0.1):
        x = edge.clone().requires_grad_()
        torch.cat(limits.velocity_bounds(x)).sum().backward()
        assert x.grad is not None
        assert bool(x.grad.isfinite().all())


def test_the_arm_keeps_the_limits_of_every_vintage_and_no_tighter_ones():
    limits = fr3.limits
    q = torch.lerp(limits.lower, limits.upper, torch.linspace(0, 1, 20_001).double()[:, None])
    lower, upper = limits.velocity_bounds(q)
    strict = [k.velocity_bounds(q) for k in FR3_TABLES.values()]
    room_up = torch.stack([k[1] for k in strict]).amin(0) - upper
    room_down = lower - torch.stack([k[0] for k in strict]).amax(0)
    assert float(room_up.min()) > -1e-12
    assert float(room_down.min()) > -1e-12
    # With less of an offset some vintage would be broken on either side, of each joint.
    assert limits.velocity_offset is not None
    bolder = replace(limits, velocity_offset=limits.velocity_offset - 1e-3)
    up = bolder.velocity_bounds(q)[1] > torch.stack([k[1] for k in strict]).amin(0) + 1e-9
    assert bool(up.any(0).all())
    for k in FR3_TABLES.values():
        assert bool((limits.lower >= k.lower).all())
        assert bool((limits.upper <= k.upper).all())


def test_an_offset_comes_with_a_deceleration():
    with pytest.raises(ValueError, match="give both, or neither"):
        replace(fr3.limits, deceleration=None)
    with pytest.raises(ValueError, match="give both, or neither"):
        replace(panda.limits, deceleration=fr3.limits.deceleration)


@pytest.mark.parametrize("arm", [panda, fr3], ids=["panda", "fr3"])
def test_slowed_limits_are_a_fraction_at_each_position(arm):
    q = everywhere(100)
    slowed = arm.limits.slowed(0.1)
    for bound, full in zip(
        slowed.velocity_bounds(q), arm.limits.velocity_bounds(q), strict=True
    ):
        assert_close(bound, 0.1 * full, rtol=0, atol=1e-12)
    assert slowed.vintage == arm.limits.vintage
    assert torch.equal(slowed.upper, arm.limits.upper)


@pytest.mark.skipif(find_spec("franky_sim") is None, reason="franky-sim has Franka's URDF")
def test_the_numbers_are_those_of_the_urdf_with_franky_sim():
    spec = find_spec("franky_sim")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    path = Path(spec.submodule_search_locations[0]) / "assets" / "fr3_clean.urdf"
    limits = FR3_TABLES["description"]
    assert limits.velocity_offset is not None
    assert limits.deceleration is not None
    joints = {j.get("name"): j for j in ElementTree.parse(path).getroot().iter("joint")}
    for i in range(7):
        joint = joints[f"joint{i + 1}"]
        limit, curve = joint.find("limit"), joint.find("position_based_velocity_limits")
        assert limit is not None
        assert curve is not None
        for tag, name, ours in (
            (limit, "lower", limits.lower),
            (limit, "upper", limits.upper),
            (limit, "velocity", limits.velocity),
            (limit, "effort", limits.torque),
            (curve, "velocity_offset", limits.velocity_offset),
            (curve, "deceleration_limit", limits.deceleration),
        ):
            assert float(tag.get(name, "nan")) == float(ours[i])


@pytest.mark.parametrize("order", [1, 2, 3])
def test_a_path_that_lasts_as_many_times_longer_keeps_its_limits(order):
    """Of t^n the difference of order n is exactly n! dt^n, and those above are zero."""
    bounds = {"lower": -torch.ones(2), "upper": torch.ones(2)}
    kinds = ("velocity", "acceleration", "jerk")
    limits = JointLimits(
        vintage="test",
        torque=torch.ones(2),
        **bounds,
        **{
            kind: torch.tensor([1e9, 0.5 if n == order else 1e9])
            for n, kind in enumerate(kinds, 1)
        },
    )
    dt, t = 0.01, 0.01 * torch.arange(40, dtype=torch.float64)
    # At joint 2 a constant 4 in this derivative.
    path = torch.stack([t, 4 * t**order / math.factorial(order)], -1)
    factor, at = limits.excess(path, dt)
    assert factor == pytest.approx(8.0 ** (1 / order), rel=1e-6)
    assert at == 2 * (order - 1) + 1
    slower, _ = limits.excess(path, float(factor) * dt)
    assert slower == pytest.approx(1.0, rel=1e-6)
    both, _ = limits.excess(torch.stack([path, 2 * path]), dt, kinds[:order])
    assert both.tolist() == pytest.approx([8.0 ** (1 / order), 16.0 ** (1 / order)], rel=1e-6)
    resting = torch.cat([path, path[-1:].expand(5, 2)])
    assert limits.excess(resting, dt)[0] >= factor
    # Without samples for a derivative, there is nothing to exceed.
    assert [float(limits.excess(path[:n], dt, kinds[:order])[0]) > 0 for n in range(order)] == [
        n > 1 for n in range(order)
    ]
