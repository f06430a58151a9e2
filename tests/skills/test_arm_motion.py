import numpy as np
import pytest
import torch

from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import panda
from hrc_learn.skills.arm_motion import (
    StraightLine,
    joint_line,
    kept_clear,
    null_space_giving_way,
    null_space_slowdown,
    resolved_rate,
    singularity_fade,
)


def random_configurations(n, seed):
    rng = torch.Generator().manual_seed(seed)
    lower, upper = panda.limits.lower, panda.limits.upper
    return lower + (upper - lower) * torch.rand(n, 7, generator=rng, dtype=torch.float64)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_the_hand_moves_as_asked_and_the_body_as_far_as_it_can(batch):
    q = panda.ready.expand(*batch, 7)
    rng = torch.Generator().manual_seed(0)
    twist = torch.randn(*batch, 6, generator=rng, dtype=torch.float64)
    wanted = torch.randn(*batch, 7, generator=rng, dtype=torch.float64)
    J = panda.jacobian(q)
    u = resolved_rate(J, twist, wanted)
    torch.testing.assert_close((J @ u[..., None])[..., 0], twist, atol=1e-9, rtol=0)
    # Of all motions with that twist it is the nearest to the wanted one (normal equations).
    null = torch.eye(7, dtype=torch.float64) - torch.linalg.pinv(J) @ J
    torch.testing.assert_close((null @ (wanted - u)[..., None])[..., 0], torch.zeros_like(u))


def test_the_body_moves_without_the_hand_near_singularities_too():
    J = panda.jacobian(random_configurations(500, seed=1))
    assert (torch.linalg.svdvals(J)[:, -1] < 0.05).sum() > 50
    u = resolved_rate(J, torch.zeros(500, 6, dtype=torch.float64), torch.ones_like(J[:, 0]))
    assert (J @ u[..., None]).abs().max() < 1e-12
    assert u.norm(dim=-1).median() > 0.1


def test_near_a_singularity_velocities_stay_bounded():
    stretched = torch.tensor([0.0, 0.0, 0.0, -0.07, 0.0, 0.07, 0.0], dtype=torch.float64)
    pull = torch.tensor([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    u = resolved_rate(panda.jacobian(stretched), pull, torch.zeros(7, dtype=torch.float64))
    assert u.abs().max() < 50.0


def test_minimum_jerk_starts_and_ends_at_rest():
    assert minimum_jerk(-1.0) == (0.0, 0.0)
    assert minimum_jerk(2.0) == (1.0, 0.0)
    x, h = 0.37, 1e-6
    slope = (minimum_jerk(x + h)[0] - minimum_jerk(x - h)[0]) / (2 * h)
    assert minimum_jerk(x)[1] == pytest.approx(slope, abs=1e-8)


def test_a_straight_line_ends_at_its_goal_and_its_twists_integrate_to_it():
    start = panda.forward(panda.ready)
    turn = quaternion.exp(torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64))
    goal = Pose(
        start.position + torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64),
        quaternion.multiply(turn, start.orientation),
    )
    dt = 0.005
    line = StraightLine(start, goal, speed=0.2)
    steps = round(line.duration / dt)
    assert 0.2 * line.duration == pytest.approx(float((goal.position - start.position).norm()))
    samples = [line.at(k * dt) for k in range(1, steps + 1)]
    last, twist = samples[-1]
    torch.testing.assert_close(last.position, goal.position, atol=1e-4, rtol=0)
    assert float(quaternion.angle(last.orientation, goal.orientation)) < 1e-3
    assert float(twist.norm()) < 1e-2
    travelled = dt * torch.stack([twist[:3] for _, twist in samples]).sum(dim=0)
    torch.testing.assert_close(travelled, goal.position - start.position, atol=1e-4, rtol=0)
    for pose, _ in samples:
        offset = pose.position - start.position
        along = goal.position - start.position
        assert float(torch.linalg.cross(offset, along).norm()) < 1e-12


def test_a_line_in_joint_space_keeps_its_speed():
    start, goal = random_configurations(2, seed=1)
    path = joint_line(start, goal, speed=0.5, dt=0.01)
    torch.testing.assert_close(path[0], start)
    torch.testing.assert_close(path[-1], goal)
    speed = path.diff(dim=0).abs().max() / 0.01
    assert 0.45 < float(speed) < 0.51
    same = joint_line(start, start, speed=0.5, dt=0.01)
    torch.testing.assert_close(same, start.expand_as(same))


def regular_configurations(n, seed):
    q = random_configurations(8 * n, seed)
    return q[torch.linalg.svdvals(panda.jacobian(q))[:, -1] > 0.1][:n]


def self_motion(q, speed):
    """Unit vector of the null space, times a speed."""
    unit = np.linalg.svd(panda.jacobian(q).numpy())[2][6]
    return speed * torch.from_numpy(unit)


def test_the_slowdown_is_that_of_the_bending_of_the_null_space():
    bent = dict.fromkeys(("hand", "elbow", "joint speed", "nothing"), 0)
    for q, speed in zip(regular_configurations(60, seed=8), 20 * [0.3, 1.0, 3.0], strict=True):
        null = self_motion(q, speed)
        allowed = {"nothing": 1.0}
        for here in (q, q + 0.15 * null):
            # The change of the Jacobian along the motion, by automatic differentiation.
            _, change = torch.func.jvp(panda.jacobian, (here,), (null,))
            bending = change @ null
            scale = torch.tensor([1.0, 1.0, 1.0, 0.1, 0.1, 0.1], dtype=torch.float64)
            hand = (0.2 / float((scale * bending).norm())) ** 0.5
            allowed["hand"] = min(allowed.get("hand", 1.0), hand)
        _, moved = torch.func.jvp(panda.joint_origins, (q,), (null,))
        allowed["elbow"] = 0.25 / float(moved.norm(dim=-1).max())
        allowed["joint speed"] = 1.0 / float(null.abs().max())
        least = min(allowed, key=allowed.__getitem__)
        bent[least] += 1
        assert null_space_slowdown(panda, q, null) == pytest.approx(allowed[least], rel=2e-3)
    assert min(bent.values()) > 0, bent


def test_nobody_moves_an_arm_into_a_singularity_but_out_of_one():
    q = regular_configurations(40, seed=5)
    faded = 0
    for joints in q:
        for speed in (-2.0, 2.0):
            null = self_motion(joints, speed)
            way = joints + torch.linspace(0, 0.3, 6, dtype=torch.float64)[:, None] * null
            now, *ahead = torch.linalg.svdvals(panda.jacobian(way))[:, -1]
            later = min(ahead)
            fraction = singularity_fade(panda, joints, null)
            if later > now or later > 0.08:
                assert fraction == 1.0
            else:
                faded += 1
                assert fraction == pytest.approx(max(float(later) - 0.05, 0.0) / 0.03)
    assert faded > 2


def test_the_null_space_gives_way_by_as_little_as_lets_the_task_go_on():
    rng = np.random.default_rng(2)
    given, compromises = 0, 0
    for q in regular_configurations(250, seed=3):
        J = panda.jacobian(q)
        task = torch.from_numpy(rng.normal(0, 0.3, 7))
        null = self_motion(q, float(rng.normal(0, 0.5)))
        lower, upper = (
            -torch.from_numpy(rng.uniform(0, 1, 7)),
            torch.from_numpy(rng.uniform(0, 1, 7)),
        )
        result = null_space_giving_way(J, task, null, lower, upper)
        assert float((J @ result).norm()) < 1e-9
        # Every null-space velocity there is, on a grid.
        unit = self_motion(q, 1.0)
        grid = torch.linspace(-6, 6, 24001, dtype=torch.float64)
        velocities = task + grid[:, None] * unit
        excess = torch.maximum(velocities - upper, lower - velocities).amax(-1)
        mine = float(torch.maximum(task + result - upper, lower - task - result).max())
        if bool((excess <= 0).any()):
            wanted = null @ unit
            nearest = grid[excess <= 0][(grid[excess <= 0] - wanted).abs().argmin()]
            assert float(result @ unit) == pytest.approx(float(nearest), abs=6e-4)
            assert mine < 1e-9
            given += abs(float(nearest - wanted)) > 1e-3
        elif not torch.equal(result, null):
            before = float(torch.maximum(task + null - upper, lower - task - null).max())
            compromises += mine <= before + 1e-9
    assert given > 5
    assert compromises > 5


def test_an_arm_slides_along_what_is_around_it_and_stops_before_it():
    q, task = panda.ready, torch.zeros(7, dtype=torch.float64)
    null = self_motion(q, 0.5)
    along = null / null.norm()

    def wall(at):
        return lambda joints: at - (joints - q) @ along

    def kept(at):
        part, waits, distance = kept_clear(q, task, null, wall(at), margin=0.03)
        assert not waits
        assert distance == pytest.approx(at)
        return float(part @ along)

    assert kept(1.0) == pytest.approx(0.5)
    # At the margin 2 mm/s, 5 mm within it nothing; continuous in between and beyond.
    assert kept(0.03) == pytest.approx(0.002, rel=1e-3)
    assert kept(0.0275) == pytest.approx(0.001, rel=1e-3)
    assert kept(0.025) == pytest.approx(0.0, abs=1e-9)
    assert kept(0.03 + 0.15 * 0.1) == pytest.approx(0.102, rel=1e-3)

    # What is met half-way and left behind again ends the way there.
    def post(joints):
        return 0.031 - 0.02 * torch.exp(-((((joints - q) @ along) / 0.03 - 1) ** 2) / 0.05)

    half_way = float(kept_clear(q, task, null, post, margin=0.03)[0] @ along)
    # 20 mm nearer where 1.3 mm are allowed, at 0.4 of the way.
    assert half_way == pytest.approx(0.5 * 0.4 * 1.3 / 20, rel=0.02)
    # Away from the wall, or along it, it is free.
    assert float(kept_clear(q, task, -null, wall(0.0), 0.03)[0] @ along) == pytest.approx(-0.5)
    aside = kept_clear(q, task, null, lambda joints: 0.02 + 0 * joints[..., 0], 0.03)[0]
    torch.testing.assert_close(aside, null)


def test_arms_of_a_batch_give_way_and_keep_clear_as_each_alone():
    rng, q = torch.Generator().manual_seed(6), regular_configurations(30, seed=6)
    J, bound = panda.jacobian(q), torch.full((30, 7), 0.4, dtype=torch.float64)
    task, null = 0.3 * torch.randn(2, 30, 7, generator=rng, dtype=torch.float64)
    null = null_projection(J, null)

    def clearance(joints):
        return 0.05 + 0.1 * torch.sin(5 * joints).amin(-1)

    gives = null_space_giving_way(J, task, null, -bound, bound)
    kept, waits, now = kept_clear(q, task, null, clearance, 0.03)
    torch.testing.assert_close(now, clearance(q))
    assert (gives != null).any()
    assert 0 < waits.sum() < 30
    for k in range(30):
        alone = null_space_giving_way(J[k], task[k], null[k], -bound[k], bound[k])
        torch.testing.assert_close(gives[k], alone)
        part, waiting, _ = kept_clear(q[k], task[k], null[k], clearance, 0.03)
        torch.testing.assert_close(kept[k], part)
        assert waits[k] == waiting
