import pytest
import torch
from demo_motions import arm_motion, turning_motion
from dmp_contract import DMPContract
from unchecked import shapes_unchecked

from hrc_learn.dmp import DualArmDMP
from hrc_learn.geometry import Pose, quaternion

HANDS = ("left", "right")


def two_hands(n_samples=400, seed=0):
    """Time, positions (T, 2, 3) and orientations (T, 2, 4), each hand a motion of its own."""
    time, position = arm_motion(n_samples, n_joints=6, seed=seed, moving_start=True)
    turns = [turning_motion(n_samples, seed=seed + k)[1] for k in (10, 20)]
    return time, position.unflatten(-1, (2, 3)), torch.stack(turns, dim=-2)


def carrying(seed=0):
    """Two hands on one rigid object that is moved and turned."""
    time, position = arm_motion(n_joints=3, seed=seed)
    turn = turning_motion(seed=seed)[1]
    grasp = Pose(
        torch.tensor([[0.0, 0.25, 0.0], [0.0, -0.25, 0.0]]).double(),
        quaternion.exp(torch.tensor([[1.0, 0.0, 0.3], [-1.0, 0.2, 0.0]]).double()),
    )
    hands = Pose(position[:, None], turn[:, None]) @ grasp
    return time, hands.position, hands.orientation


def poses(seed, *shape):
    rng = torch.Generator().manual_seed(seed)
    return Pose.from_vector(torch.rand(*shape, 6, generator=rng, dtype=torch.float64) - 0.5)


class TestDualArm(DMPContract):
    reproduction = 3e-5

    def demonstrate(self, seed, n_samples=300):
        return two_hands(n_samples, seed)

    def fit(self, *demonstration, **kwargs):
        # Steps of up to 0.1 s: held over one, a stronger coupling does not settle.
        return DualArmDMP.fit(*demonstration, gain=5.0, **kwargs)

    def outputs(self, trajectory):
        outputs = {}
        for k, hand in enumerate(HANDS):
            outputs[f"{hand} position"] = trajectory.position[..., k, :, :]
            outputs[f"rate of {hand} position"] = trajectory.velocity[..., k, :, :]
            outputs[f"{hand} orientation"] = trajectory.orientation[..., k, :, :]
            outputs[f"rate of {hand} orientation"] = trajectory.angular_velocity[..., k, :, :]
        return outputs

    def state_outputs(self, state):
        outputs = {}
        for k, hand in enumerate(HANDS):
            outputs[f"{hand} position"] = state.pose.position[..., k, :]
            outputs[f"rate of {hand} position"] = state.twist[..., k, :3]
            outputs[f"{hand} orientation"] = state.pose.orientation[..., k, :]
            outputs[f"rate of {hand} orientation"] = state.twist[..., k, 3:]
        return outputs

    def ends(self, seed):
        return poses(seed, 2).vector(), poses(seed + 1).vector()

    def arguments(self, start, goal):
        return {"start": Pose.from_vector(start), "goal": Pose.from_vector(goal)}

    def rate(self, name, outputs):
        rate = outputs[f"rate of {name}"]
        if name.endswith("position"):
            return rate
        pure = torch.nn.functional.pad(rate, (1, 0))
        return quaternion.multiply(pure, outputs[name]) / 2

    @pytest.mark.parametrize("n_steps", [1, 20, 100])
    def test_steps_end_where_the_rollout_does(self, dmp, n_steps):
        """A step is that of two arms, planned and coupled: fewer of them."""
        super().test_steps_end_where_the_rollout_does(dmp, n_steps)

    def distance(self, outputs, demonstration):
        _, position, turn = demonstration
        return max(
            max(
                (outputs[f"{hand} position"] - position[:, k]).abs().max(),
                quaternion.angle(outputs[f"{hand} orientation"], turn[:, k]).max(),
            )
            for k, hand in enumerate(HANDS)
        )


def off_by(state):
    """Of the second hand, seen from the first: distance [m] and angle [rad] off the plan."""
    now, plan = (p[..., 0].inverse() @ p[..., 1] for p in (state.pose, state.planned.pose))
    distance = (now.position - plan.position).norm()
    return distance.item(), quaternion.angle(now.orientation, plan.orientation).item()


def pushed(dmp, push, n_steps=75):
    """Largest error of the relative pose while the first hand is pushed, and the states."""
    states, worst = [dmp.initial_state()], (0.0, 0.0)
    with shapes_unchecked():
        for k in range(n_steps):
            coupling = push if 18 <= k < 37 else None
            states.append(dmp.step(states[-1], 0.04, coupling=coupling))
            worst = tuple(map(max, worst, off_by(states[-1])))
    return worst, states


FIRST_ARM = torch.zeros(2, 6, dtype=torch.float64)
FIRST_ARM[0] = torch.tensor([8.0, -4.0, 6.0, 10.0, 20.0, -10.0])


def test_a_push_on_one_arm_moves_the_other_along():
    apart = DualArmDMP.fit(*carrying(), gain=0)
    coupled = DualArmDMP.fit(*carrying(), gain=12.0)
    with torch.no_grad():
        (metres, radians), alone = pushed(apart, FIRST_ARM)
        (held_metres, held_radians), together = pushed(coupled, FIRST_ARM)
    assert metres > 0.05
    assert radians > 0.1
    assert held_metres < metres / 4
    assert held_radians < radians / 4
    # Uncoupled the second arm is as planned; coupled it is where the first one takes it.
    moved = [
        (run[37].pose.position[1] - run[37].planned.pose.position[1]).norm().item()
        for run in (alone, together)
    ]
    assert moved[0] < 1e-12
    assert moved[1] > 0.01
    # Let go, both are back on the plan in the end.
    assert max(off_by(together[-1])) < 0.01


def test_the_second_arm_alone_follows_if_it_takes_all_of_the_error():
    dmp = DualArmDMP.fit(*carrying(), gain=12.0, share=(0.0, 1.0))
    pushes_second = FIRST_ARM.flip(0)
    with torch.no_grad():
        for push, leader_moves in ((FIRST_ARM, True), (pushes_second, False)):
            _, states = pushed(dmp, push, 30)
            leader, plan = states[-1].pose[..., 0], states[-1].planned.pose[..., 0]
            assert ((leader.position - plan.position).norm() > 1e-6) == leader_moves


def test_a_held_relation_is_that_of_the_start():
    """Planned apart, as the hands' own motions are: held together, as one object is."""
    demonstration = two_hands()
    strayed = []
    with torch.no_grad(), shapes_unchecked():
        for hold in (False, True):
            dmp = DualArmDMP.fit(*demonstration, gain=12.0, hold=hold)
            state = first = dmp.initial_state()
            for _ in range(75):
                state = dmp.step(state, 0.04)
            now, then = (s.pose[..., 0].inverse() @ s.pose[..., 1] for s in (state, first))
            strayed.append((now.position - then.position).norm().item())
    assert strayed[1] < strayed[0] / 5


def test_the_goal_is_the_pose_of_the_object():
    time, position, turn = carrying()
    last = Pose(position[-1], turn[-1])
    shown = poses(3)
    dmp = DualArmDMP.fit(time, position, turn, object_goal=shown, gain=4.0)
    torch.testing.assert_close(dmp.goal.position, shown.position)
    goal = poses(5)
    ends = dmp.rollout(goal=goal, time=[30.0])
    # The object moves from `shown` to `goal`, and so do the hands.
    expected = goal @ shown.inverse() @ last
    torch.testing.assert_close(ends.position[:, 0], expected.position, rtol=0, atol=1e-6)
    assert quaternion.angle(ends.orientation[:, 0], expected.orientation).max() < 1e-6
    with torch.no_grad(), shapes_unchecked():
        state = dmp.step(dmp.initial_state(), 0.1, goal=goal, goal_filter=5.0)
        for _ in range(120):
            state = dmp.step(state, 0.1, goal_filter=5.0)
    torch.testing.assert_close(state.pose.position, expected.position, rtol=0, atol=1e-6)


def test_a_batch_of_pairs_is_a_loop():
    runs = [carrying(seed) for seed in range(2)]
    time, position, turn = (torch.stack(x) for x in zip(*runs, strict=True))
    together = DualArmDMP.fit(time, position, turn)
    dt = torch.tensor([0.01, 0.02], dtype=torch.float64)
    state = together.initial_state(goal=poses(2, 2), duration=torch.tensor([2.0, 3.0]).double())
    for _ in range(8):
        state = together.step(state, dt, coupling=FIRST_ARM)
    for i in range(2):
        alone = DualArmDMP.fit(*runs[i])
        one = alone.initial_state(goal=poses(2, 2)[i], duration=2.0 + i)
        for _ in range(8):
            one = alone.step(one, dt[i], coupling=FIRST_ARM)
        torch.testing.assert_close(state.pose.position[i], one.pose.position)
        torch.testing.assert_close(state.twist[i], one.twist)


def test_gradients_pass_through_coupled_steps():
    dmp = DualArmDMP.fit(*(x[::20] for x in carrying()), n_basis=5)

    def after(goal, push):
        state = dmp.initial_state(goal=Pose.from_vector(goal))
        for _ in range(3):
            state = dmp.step(state, 0.2, coupling=push)
        return state.pose.position, state.twist

    inputs = (poses(4).vector(), FIRST_ARM.clone())
    inputs = [x.requires_grad_() for x in inputs]
    with shapes_unchecked():
        assert torch.autograd.gradcheck(after, inputs, atol=1e-6, rtol=1e-5, fast_mode=True)


def test_what_are_no_two_arms_is_refused():
    time, position, turn = two_hands(50)
    with pytest.raises(ValueError, match=r"position must be \(..., T, 2, 3\)"):
        DualArmDMP.fit(time, position[:, 0], turn)
    with shapes_unchecked(), pytest.raises(ValueError, match=r"must be \(..., T, 2, 4\)"):
        DualArmDMP.fit(time, position, turn[:, :, :3])
