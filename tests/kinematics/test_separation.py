"""Distances of the arm from a person: the laws they obey, and MuJoCo as the oracle."""

import mujoco
import numpy as np
import pytest
import sampling
import torch

from hrc_learn.geometry import Pose
from hrc_learn.kinematics import CapsuleArm, GraspedBox, LinkCapsule, panda, separation
from hrc_learn.kinematics.collision import nearest_on_segment_and_box, segment_distance
from hrc_learn.kinematics.franka import TOOL_LINK

BOX = GraspedBox(half_size=(0.04, 0.022, 0.03), centre=(0.0, 0.005, 0.01))
ARM = panda.whole
ROWS = len(ARM.capsules)
NAMES = ("distance", "on_arm", "direction", "fraction", "gradient")


def postures(*batch, seed=0):
    limits = panda.limits
    return sampling.within(
        limits.lower, limits.upper, *batch, rng=sampling.generator(seed), margin=0.1
    )


def person(*batch, capsules=5, seed=1):
    """Capsules up to half a metre long within reach of the arm, and their radii."""
    rng = sampling.generator(seed)
    low, high = torch.tensor([[-0.8, -0.8, -0.2], [0.8, 0.8, 1.1]], dtype=torch.float64)
    start = sampling.within(low, high, *batch, capsules, rng=rng)
    along = sampling.directions(*batch, capsules, rng=rng)
    length = 0.5 * torch.rand(*batch, capsules, 1, generator=rng, dtype=torch.float64)
    radius = 0.03 + 0.1 * torch.rand(*batch, capsules, generator=rng, dtype=torch.float64)
    return torch.stack([start, start + length * along], dim=-2), radius


def simulated(ends, radius, box=None):
    """Distance of the last geom from all others by MuJoCo; the others are capsules or a box."""
    spec = mujoco.MjSpec()
    for (a, b), r in zip(ends.tolist(), radius.tolist(), strict=True):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*a, *b], size=(r, 0, 0)
        )
    if box is not None:
        pose, half_size = box
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=half_size,
            pos=pose.position.tolist(),
            quat=pose.orientation.tolist(),
        )
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def measured(model, data, a, b):
    return mujoco.mj_geomDistance(model, data, a, b, 5.0, None)


def test_distances_are_those_of_the_simulator():
    q, (ends, radius) = postures(25), person(25)
    ours = separation(ARM, q, ends, radius)
    overlapping = 0
    for k in range(len(q)):
        axes = torch.cat([ARM.segments(q[k]), ends[k]])
        model, data = simulated(axes, torch.cat([ARM.radius, radius[k]]))
        for c in range(ROWS):
            for h in range(ends.shape[-3]):
                theirs = measured(model, data, c, ROWS + h)
                # Deep overlaps MuJoCo measures along another way out.
                if theirs > -0.02:
                    assert ours.distance[k, c, h].item() == pytest.approx(theirs, abs=1e-6)
                overlapping += theirs < 0
    assert overlapping > 20


def test_the_distance_of_a_load_is_that_of_the_simulator():
    q, (ends, radius) = postures(60), person(60, capsules=8)
    ours = separation(ARM, q, ends, radius, BOX).distance[:, ROWS]
    near = 0
    for k in range(len(q)):
        pose = panda.forward(q[k])
        place = torch.tensor(BOX.centre, dtype=torch.float64)
        pose = type(pose)(pose.apply(place), pose.orientation)
        model, data = simulated(ends[k], radius[k], (pose, BOX.half_size))
        for h in range(ends.shape[-3]):
            theirs = measured(model, data, h, ends.shape[-3])
            if theirs > 0:
                assert ours[k, h].item() == pytest.approx(theirs, abs=1e-5)
            else:
                assert ours[k, h].item() < 1e-5
            near += theirs < 0.2
    assert near > 10


@pytest.mark.parametrize("grasped", [None, BOX])
def test_the_gradient_is_the_derivative(grasped):
    q, (ends, radius) = postures(3, 2), person(3, 2)
    found = separation(ARM, q, ends, radius, grasped)

    def distance(joints):
        return separation(ARM, joints, ends, radius, grasped).distance.sum((0, 1))

    # Each sample's own distances: derivatives across samples are zero and drop out.
    derivative = torch.autograd.functional.jacobian(distance, q)
    expected = derivative.movedim((-3, -2), (0, 1))
    torch.testing.assert_close(found.gradient, expected, atol=1e-7, rtol=1e-6)
    assert (found.gradient[..., 0, :, :] == 0).all()  # the base does not move


def test_the_rate_is_how_fast_distances_change():
    rng = sampling.generator(4)
    q, (ends, radius) = postures(20), person(20)
    q_dot = torch.randn(20, 7, generator=rng, dtype=torch.float64)
    v = torch.randn(ends.shape, generator=rng, dtype=torch.float64)
    rate = separation(ARM, q, ends, radius, BOX).rate(q_dot, v)
    dt = 1e-6
    later, before = (
        separation(ARM, q + s * q_dot, ends + s * v, radius, BOX).distance for s in (dt, -dt)
    )
    error = (rate - (later - before) / (2 * dt)).abs()
    # Where the nearest point jumps along parallel edges there is no rate: nowhere by chance.
    assert error.quantile(0.99) < 1e-4


@pytest.mark.parametrize("grasped", [None, BOX])
def test_the_nearest_points_are_the_distance_apart_and_on_the_surfaces(grasped):
    q, (ends, radius) = postures(10), person(10)
    found = separation(ARM, q, ends, radius, grasped)
    on_person = found.on_arm + found.distance[..., None] * found.direction
    axis = ends[:, None, :, 0] + found.fraction[..., None] * (
        ends[:, None, :, 1] - ends[:, None, :, 0]
    )
    from_axis = (on_person - axis).norm(dim=-1)
    torch.testing.assert_close(from_axis, radius[:, None].expand_as(from_axis))


def test_postures_and_people_are_batched_alike():
    q, (ends, radius) = postures(4, 1), person(3)
    all_at_once = separation(ARM, q, ends, radius, BOX)
    for i in range(4):
        for j in range(3):
            one = separation(ARM, q[i, 0], ends[j], radius[j], BOX)
            for name in NAMES:
                torch.testing.assert_close(getattr(all_at_once, name)[i, j], getattr(one, name))


def test_axes_that_meet_have_no_direction_and_no_infinite_gradient():
    q = panda.ready.clone().requires_grad_()
    along = ARM.segments(panda.ready)[5:6]
    found = separation(ARM, q, along, torch.tensor([0.05], dtype=torch.float64))
    assert found.distance[5, 0].item() == pytest.approx(-0.05 - ARM.radius[5].item())
    assert (found.direction[5] == 0).all()
    assert (found.gradient[5] == 0).all()
    (gradient,) = torch.autograd.grad(found.distance[5, 0], q)
    assert (gradient == 0).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_distances_from_balls_have_the_gradient_of_the_closed_form(dtype):
    q = panda.ready.to(dtype, copy=True).requires_grad_()
    centre = torch.tensor([0.7, 0.2, 0.4], dtype=dtype)
    found = separation(ARM, q, centre.expand(1, 2, 3), torch.full((1,), 0.1, dtype=dtype))
    rows = [torch.autograd.grad(d, q, retain_graph=True)[0] for d in found.distance[:, 0]]
    torch.testing.assert_close(torch.stack(rows), found.gradient[:, 0].detach())


def test_a_held_box_moves_with_all_joints():
    """Its row of the gradient is that of a capsule on the tool, of the same nearest point."""
    q = postures(5)
    point = panda.forward(q).apply(torch.tensor([0.0, 0.0, 0.3], dtype=torch.float64))
    ends = torch.stack([point, point], dim=-2)[:, None]
    tiny = GraspedBox(half_size=(1e-9, 1e-9, 1e-9))
    found = separation(ARM, q, ends, torch.full((5, 1), 0.01).double(), tiny)
    J = panda.jacobian(q)[:, :3]
    expected = -(found.direction[:, ROWS] @ J).squeeze(-2)
    torch.testing.assert_close(found.gradient[:, ROWS, 0], expected, atol=1e-6, rtol=0)
    assert panda.whole.links[-1] == TOOL_LINK


def test_points_of_a_box_nearest_to_a_segment_are_on_it():
    rng = sampling.generator(7)
    segment = 2 * torch.randn(200, 2, 3, generator=rng, dtype=torch.float64)
    half = torch.tensor([0.3, 0.2, 0.1], dtype=torch.float64)
    point, t = nearest_on_segment_and_box(segment, torch.zeros(3).double(), half)
    assert (point.abs() <= half + 1e-12).all()
    # No point of the segment is nearer to any point of a fine grid of the box.
    grid = torch.cartesian_prod(*[torch.linspace(-1, 1, 9, dtype=torch.float64)] * 3) * half
    s = torch.linspace(0, 1, 101, dtype=torch.float64)[:, None]
    line = segment[:, None, 0] + s * (segment[:, None, 1] - segment[:, None, 0])
    best = torch.cdist(line, grid.expand(200, -1, -1)).amin((-1, -2))
    found = (segment[:, 0] + t[:, None] * (segment[:, 1] - segment[:, 0]) - point).norm(dim=-1)
    # It is found to a millionth of the segment's length.
    assert (found <= best + 1e-5).all()


def test_the_distance_from_boxes_is_the_simulators():
    """Of all links that move; inside a box it counts from the axis of the capsule."""
    q = postures(12, seed=11)
    centres = torch.tensor([[0.5, 0.2, 0.3], [-0.4, 0.0, 0.6], [0.2, -0.7, 0.1]]).double()
    halves = torch.tensor([[0.1, 0.2, 0.05], [0.05, 0.05, 0.5], [0.3, 0.1, 0.1]]).double()
    found = ARM.box_distance(q, centres, halves)
    moving = [k for k, link in enumerate(ARM.links) if link > 0]
    ends = ARM.segments(q)[:, moving]
    for arm, distance in zip(ends, found.tolist(), strict=True):
        nearest = np.inf
        for centre, half in zip(centres, halves.tolist(), strict=True):
            still = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)
            model, data = simulated(arm, ARM.radius[moving], (Pose(centre, still), half))
            away = [measured(model, data, k, len(moving)) for k in range(len(moving))]
            nearest = min(nearest, *away)
        if nearest > 0:
            assert distance == pytest.approx(nearest, abs=1e-5)
        else:
            assert distance <= 1e-5
    one = ARM.box_distance(q.reshape(3, 4, 7), centres[0], halves[0])
    torch.testing.assert_close(one.flatten(), ARM.box_distance(q, centres[:1], halves[:1]))
    assert (found > 0.02).sum() > 3
    assert (found < one.flatten() - 0.01).any()


@pytest.mark.parametrize("length", [1.0, 1e-3])
@pytest.mark.parametrize("slant", [1.0, 1e-5])
def test_distances_of_segments_are_symmetric_and_scale_with_them(length, slant):
    """Of long and short ones, crossing or nearly parallel."""
    rng = sampling.generator(9)
    first = torch.randn(300, 2, 3, generator=rng, dtype=torch.float64)
    along = (first[:, 1] - first[:, 0]) + slant * torch.randn(300, 3, generator=rng).double()
    start = torch.lerp(first[:, 0], first[:, 1], torch.rand(300, 1, generator=rng).double())
    start = start + 0.3 * length * torch.randn(300, 3, generator=rng).double()
    second = torch.stack([start, start + length * along], dim=1)
    found = segment_distance(first, second)
    # Of nearly parallel ones of a metre any point may be the nearest, to some micrometres.
    atol = 1e-9 if slant == 1 else 1e-5 * length
    for other in (segment_distance(second, first), segment_distance(first.flip(1), second)):
        torch.testing.assert_close(other, found, rtol=1e-7, atol=atol)
    for scale in (1e-3, 40.0):
        scaled = segment_distance(scale * first, scale * second)
        torch.testing.assert_close(scaled, scale * found, rtol=1e-7, atol=atol * scale)


def test_a_held_box_ends_at_its_far_face():
    assert BOX.end == pytest.approx((0.0, 0.005, 0.04))


@pytest.mark.parametrize("bad", [-0.01, float("nan"), float("inf")])
def test_radii_that_are_none_are_refused(bad):
    ends, radius = person(capsules=2)
    radius[1] = bad
    with pytest.raises(ValueError, match="radius"):
        separation(ARM, panda.ready, ends, radius)


def test_single_precision_is_near_double():
    q, (ends, radius) = postures(10), person(10)
    double = separation(ARM, q, ends, radius, BOX)
    single = separation(ARM, q.float(), ends.float(), radius.float(), BOX)
    assert single.distance.dtype == torch.float32
    np.testing.assert_allclose(single.distance, double.distance, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_link_that_is_a_ball_has_its_distance_from_boxes_too(dtype):
    """It is its own bound, from which no rounding may leave it out."""
    ball = LinkCapsule(link=4, start=(0.01, 0.02, 0.0), end=(0.01, 0.02, 0.0), radius=0.05)
    arm, q = CapsuleArm(panda, [ball]), postures(30, seed=2).to(dtype)
    centre, half = torch.tensor([[0.5, 0.2, 0.3], [0.1, 0.3, 0.1]]).to(dtype)
    place = panda.link_poses(q)[:, 3].apply(torch.tensor(ball.start).to(dtype))
    outside = ((place - centre).abs() - half).clamp_min(0).norm(dim=-1)
    torch.testing.assert_close(arm.box_distance(q, centre, half), outside - 0.05)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_an_arm_of_one_capsule_touches_itself_nowhere(batch):
    arm = CapsuleArm(
        panda, [LinkCapsule(link=4, start=(0.0,) * 3, end=(0.1, 0, 0), radius=9.0)]
    )
    assert arm.pairs == []
    distance = arm.self_distance(panda.ready.expand(*batch, 7))
    assert torch.equal(distance, torch.full(batch, torch.inf, dtype=torch.float64))
