"""Speeds of allowed contacts, against impacts integrated by SciPy and against Pinocchio."""

import math
from itertools import product

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from unchecked import shapes_unchecked

from hrc_learn.controller import BODY_REGIONS, ContactConfig, SeparationConfig
from hrc_learn.controller.contact_limits import (
    ContactLimits,
    clamped,
    contact_speed,
    region_numbers,
)
from hrc_learn.controller.task_pace import capped_scale
from hrc_learn.geometry import Box
from hrc_learn.kinematics import panda, separation
from hrc_learn.kinematics.inertia import MassMatrix

DOUBLE = torch.float64
TOUCHABLE = [name for name, region in BODY_REGIONS.items() if region.force > 0]
T, A = 0.056, 2.0
TABLE = Box(centre=(0.5, 0.0, 0.1), half_size=(0.3, 0.4, 0.02))


def allowed(name, mass, *, held=False, config=None):
    found = contact_speed(
        torch.tensor(1 / mass, dtype=DOUBLE),
        region_numbers([name])[0],
        torch.tensor(held),
        near(config),
    )
    return float(found)


def near(config=None):
    return SeparationConfig(
        reaction_time=T, deceleration=A, mode="pfl", contact=config or ContactConfig()
    )


def peak_of_free_masses(v, m_arm, m_body, k):
    """Peak of the force between two free masses that meet at the speed v [N]."""

    def motion(t, y):
        force = k * max(y[0] - y[1], 0.0)
        return [y[2], y[3], -force / m_arm, force / m_body]

    period = math.pi * math.sqrt(k / (1 / m_arm + 1 / m_body)) / k
    solution = solve_ivp(motion, (0, 2 * period), [0, 0, v, 0], max_step=period / 200)
    return k * np.max(solution.y[0] - solution.y[1])


def peak_of_a_driven_mass(v, m_arm, k):
    """Peak against a wall of a mass that a stiff servo drives for T, then brakes with A [N]."""
    gain = 3e6  # [N s/m]

    def motion(t, y):
        wanted = max(v - A * max(t - T, 0.0), 0.0)
        return [y[1], (gain * (wanted - y[1]) - k * max(y[0], 0.0)) / m_arm]

    solution = solve_ivp(motion, (0, T + v / A), [0, v], method="LSODA", max_step=1e-3)
    return k * np.max(solution.y[0])


@pytest.mark.parametrize("name", TOUCHABLE)
@pytest.mark.parametrize("mass", [0.8, 3.5, 12.0])
def test_a_free_contact_at_this_speed_just_keeps_the_limits(name, mass):
    region, config = BODY_REGIONS[name], ContactConfig(used=1.0, area=0.7)
    # The smaller of force and pressure times area, twice as large for a transient contact.
    limit = 2 * min(region.force, 0.7 * region.pressure)
    # Between linear springs the peak is proportional to the speed.
    expected = limit / peak_of_free_masses(1.0, mass, region.mass, 1e3 * region.stiffness)
    assert allowed(name, mass, config=config) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("name", ["hand", "chest", "lower arm"])
def test_a_clamped_contact_keeps_the_limits_of_both_kinds_of_arm(name):
    region, mass = BODY_REGIONS[name], 4.0
    k, limit = 1e3 * region.stiffness, min(region.force, region.pressure)
    config = ContactConfig(used=1.0)
    driven = brentq(lambda v: peak_of_a_driven_mass(v, mass, k) - limit, 1e-3, 2.0, xtol=1e-5)
    loose = limit / peak_of_free_masses(1.0, mass, 1e9, k)
    found = allowed(name, mass, held=True, config=config)
    assert found == pytest.approx(min(driven, loose), rel=0.02)
    assert found < 0.3 * allowed(name, mass, config=config)


def test_what_the_issue_expects_of_force_alone():
    """1.4 m/s at hand and upper arm, 1 m/s at the chest, with 3.5 kg."""
    wide = ContactConfig(used=1.0, area=100.0)
    assert allowed("hand", 3.5, config=wide) == pytest.approx(1.43, abs=0.01)
    assert allowed("upper arm", 3.5, config=wide) == pytest.approx(1.36, abs=0.01)
    assert allowed("chest", 3.5, config=wide) == pytest.approx(0.99, abs=0.01)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("name", ["head", "neck"])
def test_head_and_neck_are_never_touched(name, held):
    assert allowed(name, 0.5, held=held) == 0.0


def test_padding_and_area_raise_the_speed():
    assert allowed("hand", 3.5, config=ContactConfig(padding=50.0)) > 1.2 * allowed("hand", 3.5)
    small = allowed("chest", 3.5, config=ContactConfig(area=0.2))
    assert small < 0.3 * allowed("chest", 3.5, config=ContactConfig(area=2.0))


def person(*points, radius=0.04):
    """Balls at the points, at rest."""
    at = torch.tensor(points, dtype=DOUBLE)
    ends = at[:, None].repeat(1, 2, 1)
    return ends, torch.full((len(points),), radius, dtype=DOUBLE)


@pytest.mark.parametrize("load", [0.0, 1.2])
def test_the_mass_behind_a_contact_is_that_of_the_arm_at_its_posture(load):
    """1/(n^T J M^-1 J^T n), J by finite differences and M by MuJoCo's own method elsewhere."""
    q = panda.ready.clone()
    ends, radius = person((0.5, 0.1, 0.6), (0.2, -0.3, 0.7), (0.45, 0.0, 0.1))
    found = separation(panda.whole, q, ends, radius)
    config = near(ContactConfig(used=1.0, load=load))
    limits = ContactLimits(panda.whole, config, ())
    speeds = limits.speeds(found, q, region_numbers(["hand"] * 3), holds=load > 0).first
    region, h = BODY_REGIONS["hand"], 1e-6
    M = MassMatrix(panda, 0.1)(q, load).numpy()
    for c, p in product((3, 6, 9, -1), range(3)):
        slope = np.array(
            [
                float(
                    separation(panda.whole, q + h * e, ends, radius).distance[c, p]
                    - separation(panda.whole, q - h * e, ends, radius).distance[c, p]
                )
                / (2 * h)
                for e in torch.eye(7, dtype=DOUBLE)
            ]
        )
        inverse = slope @ np.linalg.solve(M, slope)
        k, F = 1e3 * region.stiffness, 2 * min(region.force, region.pressure)
        expected = F / math.sqrt(k / (1 / region.mass + inverse))
        assert float(speeds[c, p]) == pytest.approx(expected, rel=1e-4)


def test_a_load_makes_contacts_slower():
    q = panda.ready.clone()
    ends, radius = person((0.6, 0.0, 0.48))
    found = separation(panda.whole, q, ends, radius)
    limits = ContactLimits(panda.whole, near(ContactConfig(load=3.0)), ())
    light, heavy = (
        limits.speeds(found, q, region_numbers(["chest"]), holds).first[-1]
        for holds in (False, True)
    )
    assert (heavy < 0.95 * light).all()


def test_only_what_lies_between_arm_and_furniture_is_clamped():
    q = panda.inverse(
        panda.forward(panda.ready).__class__(
            torch.tensor([0.5, 0.0, 0.215], dtype=DOUBLE),
            panda.forward(panda.ready).orientation,
        ),
        near=panda.ready,
    )
    ends, radius = person((0.5, 0.0, 0.16), (0.62, 0.0, 0.30), (0.3, 0.1, 0.9))
    found = separation(panda.whole, q, ends, radius)
    gap = torch.tensor([[0.12, 0.12, 0.12]], dtype=DOUBLE)
    held = clamped(found, [TABLE], gap)
    hand = found.distance[:, 0].argmin()
    beside = found.distance[:, 1].argmin()
    assert held[hand].tolist() == [True, False, False]
    assert not held[beside, 1]
    assert not clamped(found, [TABLE], 0.02 * gap).any()
    assert not clamped(found, [], gap).any()
    free, squeezed = (
        ContactLimits(panda.whole, near(), boxes)
        .speeds(found, q, region_numbers(["hand"] * 3), holds=False)
        .first
        for boxes in ([], [TABLE])
    )
    assert squeezed[hand, 0] < 0.1 * free[hand, 0]
    assert (squeezed[~held] == free[~held]).all()


def test_each_mode_allows_its_speed():
    distance = torch.tensor([0.3, 0.9, 2.5, 0.3], dtype=DOUBLE)
    v_h = torch.tensor([0.2, 0.2, 0.0, 0.2], dtype=DOUBLE)
    contact = torch.tensor([1.1, 1.1, 1.1, 0.0], dtype=DOUBLE)
    apart = SeparationConfig().highest_speed(distance, v_h)

    def speeds(mode):
        return SeparationConfig(mode=mode).allowed_speed(distance, v_h, contact)

    assert (speeds("ssm") == apart).all()
    torch.testing.assert_close(speeds("pfl")[:3], contact[:3] - v_h[:3])
    torch.testing.assert_close(speeds("ssm+pfl"), torch.maximum(apart, contact - v_h))
    # Where contact is not allowed the protective distance holds in every mode.
    assert speeds("pfl")[3] == speeds("ssm+pfl")[3] == apart[3]
    # A person who comes faster than any contact may be is met by an arm at rest.
    fast = SeparationConfig(mode="ssm+pfl").allowed_speed(
        distance[:1] * 0, v_h[:1] + 2, contact[:1]
    )
    assert fast.item() == 0.0


@pytest.mark.parametrize(
    ("mode", "speed", "contact", "gentle"),
    [
        ("pfl", 0.8, 1.1, True),
        ("ssm+pfl", 0.9, 1.1, True),
        ("pfl", 0.95, 1.1, False),  # with 0.2 m/s of the person
        ("pfl", -0.3, 0.0, False),
        ("ssm", 0.1, 1.1, False),
        ("pfl", 0.1, None, False),
    ],
)
def test_a_contact_is_gentle_below_its_speed_where_one_is_allowed(mode, speed, contact, gentle):
    given = [torch.tensor([x], dtype=DOUBLE) for x in (speed, 0.2)]
    contact = None if contact is None else torch.tensor([contact], dtype=DOUBLE)
    found = SeparationConfig(mode=mode).touches_gently(*given, contact)
    assert found.tolist() == [gentle]


@pytest.mark.parametrize(
    "wrong",
    [
        {"area": 0.0},
        {"padding": -1.0},
        {"used": 1.5},
        {"load": -1.0},
        {"rotor_inertia": math.nan},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ContactConfig(**wrong)


def test_unknown_names_list_the_known_ones():
    with pytest.raises(ValueError, match=r"no body region 'nose'; there are head, neck"):
        region_numbers(["hand", "nose"])
    modes = r"mode must be ssm or pfl or ssm\+pfl, but is 'fast'"
    with pytest.raises(ValueError, match=modes), shapes_unchecked():
        SeparationConfig(mode="fast")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("cap", [0.0, 0.1, 0.7, math.inf])
def test_the_cap_near_people_holds_for_tool_and_joints(cap):
    rng = torch.Generator().manual_seed(1)
    q = panda.ready + 0.3 * torch.randn(20, 7, generator=rng, dtype=DOUBLE)
    u = 0.4 * torch.randn(20, 7, generator=rng, dtype=DOUBLE)
    u[0] = 0.0
    limit = torch.full((20,), cap, dtype=DOUBLE)
    scale = capped_scale(panda, q, panda.jacobian(q), u, limit)
    speeds = torch.stack(
        [
            (panda.joint_jacobian(q, joint)[:, :3] @ u.unsqueeze(-1)).squeeze(-1).norm(dim=-1)
            for joint in range(1, 8)
        ]
        + [(panda.jacobian(q)[:, :3] @ u.unsqueeze(-1)).squeeze(-1).norm(dim=-1)]
    ).amax(0)
    expected = (limit / speeds.clamp(min=1e-12)).clamp(max=1.0)
    torch.testing.assert_close(scale[1:], expected[1:], rtol=0, atol=1e-3)
    assert scale[0] == (1.0 if cap else 0.0)
