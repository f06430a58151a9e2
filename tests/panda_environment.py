"""A Panda and a block in MuJoCo, as a scene and as an environment of gymnasium."""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from hrc_learn.kinematics import panda
from hrc_learn.sim.arm_model import ArmModelConfig, add_arm

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

FINGERS = ("finger_left", "finger_right")
LIFTED = 0.1
"""Height of the block above which it has been taken [m]."""


def panda_and_block() -> mujoco.MjSpec:
    """A Panda with position actuators beside a block on a table."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio, spec.option.noslip_iterations = 10, 3
    add_arm(spec, ArmModelConfig(robot=panda))
    for actuator in list(spec.actuators):
        if actuator.name.endswith("_velocity"):
            spec.delete(actuator)
        elif actuator.name.endswith("_position"):
            actuator.set_to_position(kp=3000.0, kv=100.0)
    size = (0.3, 0.4, 0.01)
    box = mujoco.mjtGeom.mjGEOM_BOX
    spec.worldbody.add_geom(type=box, size=size, pos=(0.5, 0.0, -0.01))
    body = spec.worldbody.add_body(name="block", pos=(0.45, 0.10, 0.025))
    body.add_freejoint()
    body.add_geom(type=box, size=(0.03, 0.03, 0.05), mass=0.1, friction=(1.5, 0.02, 0.001))
    return spec


class Taking:
    """The block is taken from the table, as in `multiply_samples`."""

    metadata = {"render_fps": 20}  # noqa: RUF012  as in gymnasium

    def __init__(self):
        self.model = panda_and_block().compile()
        self.data = mujoco.MjData(self.model)
        self._q = [int(self.model.joint(name).qposadr[0]) for name in panda.joint_names]
        servos = [f"{name}_position" for name in panda.joint_names]
        self._block = int(self.model.body("block").jntadr[0])
        self._arm = [self.model.actuator(name).id for name in servos]
        self._fingers = [self.model.actuator(name).id for name in FINGERS]

    def reset(self, *, seed, options):
        """Put the block and the joints in their places, with an open gripper."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[self._q] = self.data.ctrl[self._arm] = options["joint_position"]
        self.data.joint(self._block).qpos = options["objects"]["block"]
        self.data.ctrl[self._fingers] = 0.04
        mujoco.mj_forward(self.model, self.data)
        return self._seen(), {}

    def step(self, action):
        """Move joints and gripper for a frame."""
        self.data.ctrl[self._arm] = action["action"]
        self.data.ctrl[self._fingers] = action["action.gripper"] / 2
        mujoco.mj_step(self.model, self.data, round(0.05 / self.model.opt.timestep))
        taken = self.data.body("block").xpos[2] > LIFTED
        return self._seen(), float(taken), False, False, {"is_success": taken}

    def _seen(self):
        opening = sum(float(self.data.joint(name).qpos[0]) for name in FINGERS)
        body = self.data.body("block")
        turn = Rotation.from_quat(body.xquat, scalar_first=True).as_rotvec()
        return {
            "agent_pos": np.array([*self.data.qpos[self._q], opening], np.float32),
            "observation.block": np.array([*body.xpos, *turn]),
            "observation.mood": [0.5],
        }
