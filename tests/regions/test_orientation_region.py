import math

import pytest
import sampling
import torch

from hrc_learn.geometry import quaternion
from hrc_learn.regions import OrientationRegion

GOAL = quaternion.normalize(torch.tensor([-0.28, 0.63, 0.66, 0.28], dtype=torch.float64))


def turned(angle: float, axis=(0.0, 0.6, 0.8)) -> torch.Tensor:
    vector = angle * torch.tensor(axis, dtype=torch.float64)
    return quaternion.multiply(quaternion.exp(vector), GOAL)


def test_the_tolerance_of_table_one_is_seven_and_a_half_degrees():
    """The norm of the quaternion logarithm is half the angle: 2/15 rad, not 1/15."""
    region = OrientationRegion(goal=GOAL)
    assert math.degrees(region.tolerance) == pytest.approx(7.639, abs=1e-3)
    assert region.value(turned(region.tolerance)).item() == pytest.approx(0, abs=1e-12)
    assert (region.gradient(turned(0.99 * region.tolerance)) == 0).all()


@pytest.mark.parametrize("coordinates", ["rotation", "rotation_vector"])
@pytest.mark.parametrize("formulation", ["exact", "paper"])
def test_both_signs_are_one_orientation(formulation, coordinates):
    options = {"formulation": formulation, "coordinates": coordinates}
    region = OrientationRegion(goal=GOAL, **options)
    flipped = OrientationRegion(goal=-GOAL, **options)
    half_turn = torch.tensor([0.0, 0.6, 0.0, 0.8], dtype=torch.float64)
    samples = torch.cat(
        [
            sampling.quaternions(200, rng=sampling.generator()),
            torch.stack([GOAL, quaternion.multiply(half_turn, GOAL), turned(math.pi)]),
        ]
    )
    for p, other in ((-samples, region), (samples, flipped)):
        torch.testing.assert_close(other.value(p), region.value(samples))
        torch.testing.assert_close(other.potential(p), region.potential(samples))
    # At half a turn either way is shortest: there alone the direction may differ.
    torch.testing.assert_close(region.gradient(-samples), region.gradient(samples))
    torch.testing.assert_close(flipped.gradient(samples[:-2]), region.gradient(samples[:-2]))


def test_an_exact_half_turn_has_one_direction_whatever_the_sign():
    region = OrientationRegion(goal=torch.tensor([1.0, 0, 0, 0], dtype=torch.float64))
    p = torch.tensor([0.0, 0.0, -1.0, 0.0], dtype=torch.float64)
    gradient = region.gradient(p)
    assert gradient.norm() > 0.1
    assert (gradient == region.gradient(-p)).all()


def test_the_printed_form_is_twice_the_angle_too_long():
    exact = OrientationRegion(goal=GOAL)
    paper = OrientationRegion(goal=GOAL, formulation="paper")
    for angle in (0.2, 1.0, 3.0):
        p = turned(angle)
        torch.testing.assert_close(paper.gradient(p), 2 * angle * exact.gradient(p))


def test_the_printed_derivatives_entry_by_entry():
    """(PartialV2Quat) and (JacobianQuatAngAxisDetailed) with every term written out.

    The potential is k_o/2 f^2 with f = alpha_o acos(v_e) - 1, v_e the real part of the error.
    """
    p = quaternion.canonical(sampling.quaternions(rng=sampling.generator(4)))
    p_g = sampling.quaternions(rng=sampling.generator(5))
    if quaternion.multiply(p, quaternion.conjugate(p_g))[0] < 0:
        p_g = -p_g
    v_o, *u_o = p.tolist()
    v_g, *u_g = quaternion.conjugate(p_g).tolist()
    ratios = [g / o for g, o in zip(u_g, u_o, strict=True)]
    over_p = [v_g + v_o * sum(ratios)]
    for i in range(3):
        others = sum(ratios) - ratios[i]
        over_p.append(-u_g[i] + u_o[i] * (-v_g / v_o + others))
    r = quaternion.log(p).tolist()
    phi = math.hypot(*r)
    sine, cosine = math.sin(phi / 2), math.cos(phi / 2)
    J_rot = [[-r_i / (2 * phi) * sine for r_i in r]]
    for i in range(3):
        row = []
        for k in range(3):
            product = r[i] * r[k]
            entry = product / (2 * phi**2) * cosine - product / phi**3 * sine
            if i == k:
                rest = sum(r[m] ** 2 for m in range(3) if m != i)
                entry = product / (2 * phi**2) * cosine + rest / phi**3 * sine
            row.append(entry)
        J_rot.append(row)
    over_p, J_rot = (torch.tensor(m, dtype=torch.float64) for m in (over_p, J_rot))
    paper = OrientationRegion(goal=p_g, coordinates="rotation_vector", formulation="paper")
    v_e = quaternion.multiply(p, quaternion.conjugate(p_g))[0]
    f = paper.sharpness * v_e.acos() - 1
    slope = -paper.stiffness * f * paper.sharpness / (1 - v_e**2).sqrt()
    torch.testing.assert_close(paper.gradient(p), slope * (over_p @ J_rot))


def test_descending_the_gradient_turns_the_short_way_to_the_cone():
    region = OrientationRegion(goal=GOAL)
    p = turned(2.5)
    angles = []
    for _ in range(400):
        p = quaternion.multiply(quaternion.exp(-0.1 * region.gradient(p)), p)
        angles.append(quaternion.angle(p, GOAL).item())
    assert max(angles) <= 2.5
    assert angles[-1] == pytest.approx(region.tolerance, abs=1e-3)
