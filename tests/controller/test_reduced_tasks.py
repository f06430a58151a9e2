"""Goals that lead less than a pose of the tool, of arms with as few joints as five."""

import numpy as np
import pytest
import sampling
import torch
from closed_loop import Imperfections, VirtualCamera, simulate_closed_loop
from pinhole_camera import PinholeCamera
from servoing import CENTRE, DOUBLE, DOWN, grasping, near_starts, network, observe
from unchecked import shapes_unchecked

from hrc_learn.controller import AdaptiveController, ControllerConfig, Goals
from hrc_learn.controller.resolved_rate import task_descent
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.jacobian import FixedEstimator, KalmanEstimator, RBFImageJacobian, paper_grid
from hrc_learn.kinematics import Arm, arm, panda, solve_inverse, task_basis, task_rank

pytestmark = pytest.mark.simulation

TASKS = ("position+axis", "position")

# Of the kind of the SO-101: base, three hinges in a plane, and a roll about the tool's axis.
_LINKS = (("0 0 0.1", "0 0 1"), ("0 0 0.05", "0 1 0"), ("0 0 0.3", "0 1 0"))
_LINKS += (("0 0 0.3", "0 1 0"), ("0 0 0.05", "0 0 1"))


@pytest.fixture(scope="module")
def five(tmp_path_factory) -> Arm:
    """An arm of five joints, the last of which turns about the axis of its tool."""
    joints = "".join(
        f'<link name="l{k + 1}"/><joint name="j{k}" type="revolute">'
        f'<parent link="l{k}"/><child link="l{k + 1}"/><origin xyz="{xyz}"/>'
        f'<axis xyz="{axis}"/><limit lower="-2.9" upper="2.9" velocity="2" effort="9"/></joint>'
        for k, (xyz, axis) in enumerate(_LINKS)
    )
    path = tmp_path_factory.mktemp("five") / "five.urdf"
    path.write_text(f'<robot name="five"><link name="l0"/>{joints}</robot>')
    tool = torch.eye(4, dtype=DOUBLE)
    tool[2, 3] = 0.12
    return arm(path, tool=tool, ready=[0.3, 0.5, 1.2, 1.0, 0.2])


def numeric_basis(R: np.ndarray, task: str) -> np.ndarray:
    basis = np.zeros((3 if task == "position" else 5, 6))
    basis[:3, :3] = np.eye(3)
    if task != "position":
        basis[3:, 3:] = R[:, :2].T
    return basis


@pytest.mark.parametrize(
    ("task", "of_seven", "of_five"),
    [("pose", 6, 5), ("position+axis", 5, 4), ("position", 3, 3)],
)
def test_how_many_dimensions_an_arm_leads(five, task, of_seven, of_five):
    """The roll about its axis moves neither the tool's position nor its axis."""
    assert task_rank(panda, task) == of_seven
    assert task_rank(five.chain, task) == of_five


@pytest.mark.parametrize("task", TASKS)
def test_the_law_is_that_of_the_rows_that_the_task_leads(task):
    """u = -J_t^+ (J J_t^+)^T s + N_t w, put together in NumPy, with no limit in the way."""
    rng = sampling.generator(1)
    controller, _ = grasping(rng=rng, config=ControllerConfig.paper())
    goals = controller.goals
    goals = Goals.at(CENTRE, DOWN, goals.vision.target, task=task)
    q = near_starts(rng=rng, spread=0.2)
    d = 0.3 * torch.randn(7, generator=rng, dtype=DOUBLE)
    feature = torch.tensor([640.0, 500.0], dtype=DOUBLE)
    observation = observe(q, feature=feature, nullspace_input=d, goals=goals)
    command, _ = controller.step(controller.initial_state(q), observation)

    pose, J = panda.forward(q), panda.jacobian(q).numpy()
    J_t = numeric_basis(quaternion.to_matrix(pose.orientation).numpy(), task) @ J
    inverse = np.linalg.pinv(J_t)
    xi_q = controller.joint_region.gradient(q)
    wish = (d - xi_q).numpy() / 3
    s = command.s.numpy()
    task_part = -inverse @ (J @ inverse).T @ s
    null = wish - inverse @ J_t @ wish
    np.testing.assert_allclose(command.null_velocity.numpy(), null, atol=1e-10)
    u, v = task_part + null, command.joint_velocity.numpy()
    np.testing.assert_allclose(v / np.linalg.norm(v), u / np.linalg.norm(u), atol=1e-9)
    turning = goals.orientation.gradient(pose.orientation) if goals.orientation else 0 * d[:3]
    torch.testing.assert_close(command.xi_r[3:], turning)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("joints", [5, 7])
def test_the_potential_falls_whatever_the_gradient(five, task, joints):
    """Along the led motion by the square of what is led, uncontrolled turns included."""
    chain = panda if joints == 7 else five.chain
    rng = sampling.generator(2)
    q = sampling.within(chain.limits.lower, chain.limits.upper, 500, rng=rng)
    pose, J = chain.forward_and_jacobian(q)
    s = torch.randn(500, 6, generator=rng, dtype=DOUBLE)
    basis = task_basis(J, pose.orientation, task, task_rank(chain, task))
    J_t = basis @ J
    regular = torch.linalg.svdvals(J_t)[:, -1] > 0.06
    assert regular.sum() > 100
    y = (basis @ task_descent(J, basis, s)[..., None])[regular]
    tool = J[regular] @ torch.linalg.pinv(J_t[regular]) @ -y
    rate = (s[regular] * tool[..., 0]).sum(-1)
    torch.testing.assert_close(rate, -y.square().sum((-2, -1)), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("task", TASKS)
def test_a_person_moves_what_is_not_led_and_nothing_else(task):
    """Held in place by its goals, the tool is pushed about its axis, or about its centre."""
    rng = sampling.generator(4)
    start = solve_inverse(panda, Pose(CENTRE, DOWN)).position
    goals = Goals.at(CENTRE, DOWN, task=task, half_size=(0.002,) * 3)
    controller = AdaptiveController(
        panda, FixedEstimator(network(torch.ones(2, 6, dtype=DOUBLE))), goals
    )
    push = torch.randn(7, generator=rng, dtype=DOUBLE)
    with torch.inference_mode(), shapes_unchecked():
        state, q = controller.initial_state(start), start
        for _ in range(100):
            seen = torch.tensor(False)
            observation = observe(q, feature_visible=seen, nullspace_input=3 * push, dt=0.008)
            command, state = controller.step(state, observation)
            q = q + 0.008 * command.joint_velocity
    before, after = panda.forward(start), panda.forward(q)
    twist = before.twist_to(after)
    assert twist[:3].norm() < 2e-3
    assert twist[3:].norm() > 0.1
    a, b = (quaternion.to_matrix(p.orientation)[:, 2] for p in (before, after))
    tilted = float(torch.linalg.cross(a, b).norm())
    assert tilted < 4e-3 if task == "position+axis" else tilted > 0.05


@pytest.mark.long
@pytest.mark.parametrize("task", [*TASKS, "nearest pose"])
def test_an_arm_of_five_joints_servoes(five, task):
    """From around its ready posture to a target that a camera shows, tilted and turned."""
    chain = five.with_hand() if task == "nearest pose" else five.chain
    rng = sampling.generator(5)
    count = 8
    above = Pose(
        torch.tensor([0.35, 0.1, 0.15], dtype=DOUBLE),
        torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=DOUBLE),
    )
    one = torch.ones(count, dtype=DOUBLE)
    camera = PinholeCamera.above(
        above.position.expand(count, 3),
        height=1.0 * one,
        roll=torch.linspace(-1.5, 1.5, count, dtype=DOUBLE),
        tilt=0.2 * one,
        bearing=0.5 * one,
        marker=torch.tensor([0.03, 0.0, -0.05], dtype=DOUBLE),
    )
    shift = 0.03 * (2 * torch.rand(count, 3, generator=rng, dtype=DOUBLE) - 1)
    # Its own last joint decides about the turn of the tool: that of the posture.
    led = "nearest pose" if task == "nearest pose" else "position+axis"
    posture = solve_inverse(chain, above, task=led)
    assert posture.found
    wanted = chain.forward(posture.position)
    target, seen = camera.project(
        Pose(above.position + shift, wanted.orientation.expand(count, 4))
    )
    assert seen.all()
    goals = Goals.at(above.position, above.orientation, target, task=task)
    goals = goals.approached_by(posture.position)
    J = camera.image_jacobian(above)[count // 2]
    controller = AdaptiveController(chain, KalmanEstimator(network(J)), goals)
    free = {"position": 2, "position+axis": 1, "nearest pose": 0}
    assert controller.null_space_dimension() == free[task]
    start = chain.ready + 0.2 * torch.randn(count, 5, generator=rng, dtype=DOUBLE)
    eye = VirtualCamera(
        camera=camera, imperfections=Imperfections(frame_steps=2, noise=0.5), generator=rng
    )
    with torch.inference_mode(), shapes_unchecked():
        q = simulate_closed_loop(controller, eye, start, steps=250, dt=0.02)
    tool = chain.forward(q)
    assert (camera.project(tool)[0] - target).norm(dim=-1).max() < 5
    box = goals.position.half_size
    assert ((tool.position - above.position).abs() < 1.05 * box).all()
    if goals.orientation is not None:
        assert (goals.orientation.value(tool.orientation) < 0.2).all()


def test_a_pose_of_five_joints_is_refused(five):
    estimator = FixedEstimator(network(torch.ones(2, 6, dtype=DOUBLE)))
    goals = Goals.at(CENTRE, DOWN)
    with pytest.raises(ValueError, match=r"has 5: .*null space: 1"):
        AdaptiveController(five.chain, estimator, goals)
    led = Goals.at(CENTRE, DOWN, task="position")
    controller = AdaptiveController(five.chain, estimator, led)
    q = torch.zeros(5, dtype=DOUBLE)
    with pytest.raises(ValueError, match="needs six joints"):
        controller.step(controller.initial_state(q), observe(q, goals=goals))


def test_a_target_of_another_number_of_points_is_refused():
    """Also without a target: the image's middle is one point."""
    four = RBFImageJacobian.from_jacobian(torch.ones(8, 6), paper_grid(), 0.1)
    one = Goals.at(CENTRE, DOWN)
    with pytest.raises(
        ValueError, match="target has 2 coordinates, the estimator's feature 8:"
    ):
        AdaptiveController(panda, FixedEstimator(four), one)
    target = torch.full((8,), 500.0, dtype=DOUBLE)
    goals = Goals.at(CENTRE, DOWN, target).with_vision(False)
    controller = AdaptiveController(panda, FixedEstimator(four), goals)
    state = controller.initial_state(panda.ready)
    feature = torch.full((8,), 9.0, dtype=DOUBLE)
    moved, _ = controller.step(state, observe(panda.ready, feature=feature))
    assert moved.joint_velocity.isfinite().all()
    with pytest.raises(ValueError, match="has 2 coordinates"):
        controller.step(state, observe(panda.ready, feature=feature, goals=one))
