"""Every kind of primitive, held to the same contract."""

import pytest
import torch
from demo_motions import arm_motion, turning_motion
from dmp_contract import DMPContract
from unchecked import shapes_unchecked

from hrc_learn.dmp import JointDMP, OrientationDMP, PoseDMP, SplineBasis
from hrc_learn.dmp import ude_formulation as ude
from hrc_learn.geometry import Pose, quaternion


def random_tensor(seed, *shape):
    rng = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(*shape, generator=rng, dtype=torch.float64) - 1


def random_orientations(seed):
    return quaternion.exp(random_tensor(seed, 2, 3)).unbind()


def quaternion_rate(orientation, angular_velocity):
    """q' = (0, omega) * q / 2."""
    pure = torch.nn.functional.pad(angular_velocity, (1, 0))
    return quaternion.multiply(pure, orientation) / 2


class TestJoint(DMPContract):
    def demonstrate(self, seed, n_samples=300):
        return arm_motion(n_samples, n_joints=3, seed=seed, moving_start=True)

    def fit(self, *demonstration, **kwargs):
        return JointDMP.fit(*demonstration, **kwargs)

    def outputs(self, trajectory):
        return {
            "position": trajectory.position,
            "rate of position": trajectory.velocity,
        }

    state_outputs = outputs

    def ends(self, seed):
        return random_tensor(seed, 2, 3).unbind()

    def distance(self, outputs, demonstration):
        return (outputs["position"] - demonstration[1]).abs().max()


class TestOrientation(DMPContract):
    def demonstrate(self, seed, n_samples=300):
        return turning_motion(n_samples, seed=seed)

    def fit(self, *demonstration, **kwargs):
        return OrientationDMP.fit(*demonstration, **kwargs)

    def outputs(self, trajectory):
        return {
            "orientation": trajectory.orientation,
            "rate of orientation": trajectory.angular_velocity,
        }

    state_outputs = outputs

    def ends(self, seed):
        return random_orientations(seed)

    def rate(self, name, outputs):
        return quaternion_rate(outputs[name], outputs[f"rate of {name}"])

    def distance(self, outputs, demonstration):
        return quaternion.angle(outputs["orientation"], demonstration[1]).max()


class TestPose(DMPContract):
    """Pose with two body coordinates; start and goal as (position, rotation vector, body)."""

    reproduction = 3e-5

    def demonstrate(self, seed, n_samples=300):
        time, position = arm_motion(n_samples, n_joints=5, seed=seed, moving_start=True)
        return time, position[:, :3], turning_motion(n_samples, seed=seed)[1], position[:, 3:]

    def fit(self, time, position, orientation, body, **kwargs):
        return PoseDMP.fit(time, position, orientation, body=body, **kwargs)

    def outputs(self, trajectory):
        return {
            "position": trajectory.position,
            "rate of position": trajectory.velocity,
            "orientation": trajectory.orientation,
            "rate of orientation": trajectory.angular_velocity,
            "body": trajectory.body,
            "rate of body": trajectory.body_velocity,
        }

    def state_outputs(self, state):
        return {
            "position": state.pose.position,
            "orientation": state.pose.orientation,
            "rate of position": state.twist[..., :3],
            "rate of orientation": state.twist[..., 3:],
            "body": state.body,
        }

    def ends(self, seed):
        return random_tensor(seed, 2, 8).unbind()

    def arguments(self, start, goal):
        return {
            "start": Pose(start[:3], quaternion.exp(start[3:6])),
            "goal": Pose(goal[:3], quaternion.exp(goal[3:6])),
            "start_body": start[6:],
            "goal_body": goal[6:],
        }

    def rate(self, name, outputs):
        rate = outputs[f"rate of {name}"]
        return quaternion_rate(outputs[name], rate) if name == "orientation" else rate

    def distance(self, outputs, demonstration):
        _, position, orientation, body = demonstration
        return max(
            (outputs["position"] - position).abs().max(),
            quaternion.angle(outputs["orientation"], orientation).max(),
            (outputs["body"] - body).abs().max(),
        )


class TestJointTurningWithItsWay(TestJoint):
    def fit(self, *demonstration, **kwargs):
        return JointDMP.fit(*demonstration, scaling="rotation", **kwargs)


class TestPoseTurningWithItsWay(TestPose):
    def fit(self, time, position, orientation, body, **kwargs):
        return PoseDMP.fit(time, position, orientation, body=body, scaling="rotation", **kwargs)


class TestJointOnItsApproach(TestJoint):
    def fit(self, *demonstration, **kwargs):
        return JointDMP.fit(*demonstration, approach=0.8, **kwargs)


class TestJointOnSplines(TestJoint):
    """Their forcing fades over the last two spacings, and this motion ends in full swing."""

    reproduction = 4e-4

    def fit(self, *demonstration, n_basis=50, **kwargs):
        return JointDMP.fit(*demonstration, basis=SplineBasis(count=n_basis), **kwargs)


class TestOrientationOfUde(TestOrientation):
    """Integrated: what is exact elsewhere holds to the error of the method here.

    What does not depend on the formulation is tested with the other one.
    """

    reproduction = 1e-4
    test_a_batch_is_a_loop = None
    test_masked_samples_do_not_matter = None
    test_rates_are_derivatives = None
    test_motion_settles_at_the_goal_from_anywhere = None
    test_slowing_down_stays_on_the_path = None
    test_times_and_durations_of_their_own_are_a_loop = None
    test_maps_and_derives_in_any_way = None
    test_files_of_another_kind_are_refused = None
    test_numpy_demonstrations_are_taken = None
    test_float32_in_float32_out = None

    def test_reversed_goes_the_same_way_back(self, dmp):
        with pytest.raises(ValueError, match="not linear"):
            dmp.reversed()

    @pytest.fixture(autouse=True)
    def coarse(self, monkeypatch):
        monkeypatch.setattr(ude, "MAXIMUM_STEP", 1 / 80)
        # Its many short steps take four times as long with their shapes checked, which the
        # tests of the formulation do.
        with shapes_unchecked():
            yield

    def fit(self, *demonstration, **kwargs):
        return OrientationDMP.fit(*demonstration, formulation="ude", **kwargs)

    def test_gradients_are_exact(self, monkeypatch):
        # Coarse: the derivative of what is computed is exact at any step length.
        monkeypatch.setattr(ude, "MAXIMUM_STEP", 0.1)
        super().test_gradients_are_exact()

    @pytest.mark.parametrize("n_steps", [150])
    def test_steps_end_where_the_rollout_does(self, dmp, n_steps):
        arguments = self.arguments(*self.ends(4))
        state = dmp.initial_state(**arguments, duration=2.0)
        with torch.no_grad(), shapes_unchecked():
            for _ in range(n_steps):
                state = dmp.step(state, 1.7 / n_steps)
            there = self.outputs(dmp.rollout(time=[1.7], **arguments, duration=2.0))
        for name, value in self.state_outputs(state).items():
            torch.testing.assert_close(value, there[name][0], rtol=0, atol=1e-5, msg=name)
