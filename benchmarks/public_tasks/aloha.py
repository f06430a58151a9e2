"""gym-aloha's transfer of a cube from arm to arm, with our own expert.

The right arm takes a cube from the table and hands it to the left arm. Observations are numbers
from the package's own task; the package renders images at each step, this module only on
request. The package decides on success: a finger of the left gripper touches the cube and the
table does not.

The expert reads joints and cube before each action. It guides both hands through a sequence of
poses by minimum-jerk motions. If the cube appears at another place, the motions continue from
the present poses; if the cube is lost, the sequence starts again.
"""

import math
import os
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, UInt8
from public_tasks.protocol import AGENT_POS, ENVIRONMENT_STATE, Expert, Observation

FPS = 50.0
"""Actions per second, from gym-aloha."""
LONGEST = 440
"""Number of actions after which an episode has failed: 1.5 times the expert's number."""
MOVED_AT = 20
"""Number of actions after which the cube is moved: the right hand is above it after 70."""
DONE = 4
"""Reward of gym-aloha for a cube in the left gripper."""
LOW, HIGH = np.array([0.0, 0.4]), np.array([0.2, 0.6])
"""Lowest and highest initial x and y of the cube [m]; gym-aloha defines them inside a function.
"""
DROPPED_FROM = 0.05
"""Initial height of the cube [m]; gym-aloha defines it inside a function."""
TRIES = 1000
"""Largest number of directions tried for a move of the cube to an allowed initial place."""
HEIGHT, WIDTH = 480, 640
"""Size of an image [px]."""

JOINTS = 6
"""Number of joints of an arm, without its gripper."""
FOREARM_ROLL = 3
"""Index of the joint that stays at 0: otherwise forearm and wrist may rotate about the same
axis."""
GRIP = 0.142
"""Distance from the gripper's link to the held object [m]: about 1 cm before the finger tips.
"""
MEETING = np.array([0.0, 0.5, 0.25])
"""Place of the hand-over [m]: in the middle, well above the table."""
CLEARANCE = np.array([0.0, 0.0, 0.09])
"""Offset from the cube to the place above it, for the right hand [m]."""
STANDOFF = np.array([-0.13, 0.0, 0.0])
"""Offset from the hand-over to the waiting place of the left hand [m], clear of the right hand.
"""
SHORT = np.array([-0.006, 0.0, 0.0])
"""Offset from the cube to the grasp of the left hand [m], clear of the right fingers."""
DOWN = math.pi / 2
"""Pitch at which the right hand grasps the cube [rad]. Back at level, it has turned the cube by
a quarter turn, so the left hand finds faces."""
ACROSS = math.pi / 2
"""Roll of the left hand [rad]: its fingers grasp the faces that the right fingers leave free.
"""

NEAR = np.array([0.01, 0.01, 0.01, 0.1, 0.1])
"""Distance from its goal at which a hand has arrived [m and rad]: within its opening."""
PATIENCE = 1.0
"""Longest wait for a hand to arrive [s]; then the next stage begins."""
JUMP = 0.02
"""Displacement of the cube between two actions above which the cube was moved and not carried
[m]."""
AGAIN = 0.6
"""Smallest fraction of the first stage's duration that remains after the cube was moved."""
LOST = 0.03
"""Distance from the hand above which the cube is no longer held [m]."""
SPEED = math.pi
"""Largest joint speed [rad/s], that of the motors of these arms."""
DAMPING = 1e-5
"""Damping of inverse kinematics [m²]: far below the squares of the arms' levers."""
ITERATIONS = 5
"""Number of iterations of inverse kinematics per action: the previous joints are near."""
QUINTIC = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 0.5], [-10, -6, -1.5], [15, 8, 1.5], [-6, -3, -0.5]]
)
"""Minimum-jerk polynomial that rests at 0 after a unit of time: coefficients by powers of time,
for an initial position, velocity and acceleration."""


@dataclass(frozen=True, kw_only=True)
class _Stage:
    """Poses of both hands at the end of a stage, with the openings of both grippers."""

    seconds: float
    right: Literal["above cube", "cube", "meeting"]
    right_open: float = 0.0
    """Opening of the right gripper, 0 to 1. Open, the hand moves to the cube's present place;
    closed, to its place at the time of closing."""
    left: Literal["waiting", "cube"] = "waiting"
    left_open: float = 1.0


STAGES = (
    _Stage(seconds=1.4, right="above cube", right_open=1.0),
    _Stage(seconds=0.8, right="cube", right_open=1.0),
    _Stage(seconds=0.6, right="cube"),
    _Stage(seconds=0.6, right="above cube"),
    _Stage(seconds=1.4, right="meeting"),
    _Stage(seconds=0.8, right="meeting", left="cube"),
    _Stage(seconds=0.6, right="meeting", left="cube", left_open=0.0),
)
HELD = 3
"""First stage in which the right hand holds the cube."""


class AlohaTransfer:
    """gym_aloha/AlohaTransferCube-v0 with numbers as observations.

    Observations are, for the left arm and then for the right arm, six joints [rad] and the
    opening of the gripper, 0 to 1; for the cube, its position [m] and orientation (quaternion,
    scalar first). An action holds the commanded joints and gripper openings.
    """

    fps: float = FPS
    n_actions: int = 2 * (JOINTS + 1)
    longest: int = LONGEST
    moved_at: int | None = MOVED_AT
    moved: float = 0.05
    """Distance by which `move_object` moves the cube [m]: larger than the tolerance of an open
    gripper."""

    def __init__(self) -> None:
        os.environ.setdefault("MUJOCO_GL", "egl")
        from dm_control import mujoco  # pyright: ignore[reportMissingImports]
        from dm_control.rl import control  # pyright: ignore[reportMissingImports]
        from gym_aloha import constants  # pyright: ignore[reportMissingImports]
        from gym_aloha.tasks import sim  # pyright: ignore[reportMissingImports]

        class Task(sim.TransferCubeTask):
            """The package's task without images."""

            def get_observation(self, physics: Any) -> Observation:
                return {
                    AGENT_POS: self.get_qpos(physics).astype(np.float32),
                    ENVIRONMENT_STATE: self.get_env_state(physics).astype(np.float32),
                }

        path = constants.ASSETS_DIR / "bimanual_viperx_transfer_cube.xml"
        self._physics: Any = mujoco.Physics.from_xml_path(str(path))
        self._env: Any = control.Environment(
            self._physics, Task(), math.inf, control_timestep=constants.DT
        )
        self._cube_pose: list[Any] = sim.BOX_POSE
        self._unstable: Any = control.PhysicsError
        self._seen: Observation | None = None
        self.expert: Expert = _Expert(self._physics.model.ptr)

    def begin(self, seed: int) -> Observation:
        """Set the arms to their initial joints and the cube to a random place between `LOW` and
        `HIGH`.
        """
        where = np.random.default_rng(seed).uniform(LOW, HIGH)
        self._cube_pose[0] = np.array([*where, DROPPED_FROM, 1.0, 0.0, 0.0, 0.0])
        self._seen = None
        return self._env.reset().observation

    def step(self, action: Float[np.ndarray, "14"]) -> tuple[Observation, bool]:
        """Observation after an action, and True if the left gripper has the cube.

        If an action makes the simulation unstable, the episode is lost, and nothing moves any
        more.
        """
        if self._seen is not None:
            return self._seen, False
        before = self._env.task.get_observation(self._physics)
        try:
            after = self._env.step(action.astype(float))
        except self._unstable:
            self._seen = before
            return before, False
        return after.observation, after.reward == DONE

    def move_object(self, rng: np.random.Generator) -> Observation:
        """Move the cube in a random direction to an allowed initial place.

        Raises:
            RuntimeError: There is no such place.
        """
        where = self._physics.data.qpos[-7:-5]
        for angle in rng.uniform(0, 2 * math.pi, TRIES):
            aside = where + self.moved * np.array([math.cos(angle), math.sin(angle)])
            if (aside >= LOW).all() and (aside <= HIGH).all():
                where[:] = aside
                self._physics.forward()
                return self._env.task.get_observation(self._physics)
        raise RuntimeError(f"no episode begins with the cube {self.moved} m from {where}")

    def render(self) -> UInt8[np.ndarray, "H W 3"]:
        """Image of both arms from the side of the table."""
        return self._physics.render(height=HEIGHT, width=WIDTH, camera_id="angle")


class _Arm:
    """Kinematics of one arm, in its own `MjData`.

    The pose of a hand is its grasp point x, y, z [m], its pitch and its roll [rad]. Its
    heading, seen from above, is that of the arm.
    """

    def __init__(self, model: Any, side: str):
        import mujoco  # pyright: ignore[reportMissingImports]

        self._mj: Any = mujoco
        self._model, self._data = model, self._mj.MjData(model)
        self._link = model.body(f"vx300s_{side}/gripper_link").id
        first = model.joint(f"vx300s_{side}/waist").qposadr[0]
        self._own = slice(first, first + JOINTS)
        self._low, self._high = model.jnt_range[self._own].T
        self.base = model.body(f"vx300s_{side}").pos[:2].copy()
        self.heading = 0.0 if side == "left" else math.pi

    def hand(self, joints: Float[np.ndarray, "6"]) -> Float[np.ndarray, "5"]:
        """Pose of the hand at these joints [rad]."""
        place, axes = self._link_at(joints)
        axes = _axes(-self.heading - joints[0], 0, 0) @ axes
        down, roll = math.atan2(-axes[2, 0], axes[0, 0]), math.atan2(-axes[1, 2], axes[1, 1])
        return np.array([*place, down, roll])

    def joints(
        self, hand: Float[np.ndarray, "5"], near: Float[np.ndarray, "6"]
    ) -> Float[np.ndarray, "6"]:
        """Joints [rad] near the given ones at which the hand has the pose, by damped least
        squares.
        """
        joints = near.copy()
        moved, turned = np.zeros((2, 3, self._model.nv))
        for _ in range(ITERATIONS):
            place, axes = self._link_at(joints)
            wanted = _axes(self.heading + joints[0], hand[3], hand[4])
            turn = 0.5 * np.cross(axes, wanted, axis=0).sum(axis=1)
            self._mj.mj_jac(self._model, self._data, moved, turned, place, self._link)
            jac = np.vstack([moved, turned])[:, self._own]
            jac[3:, 0] = 0  # The wanted pose rotates with the waist.
            jac[:, FOREARM_ROLL] = 0
            error = np.concatenate([hand[:3] - place, turn])
            joints += jac.T @ np.linalg.solve(jac @ jac.T + DAMPING * np.eye(6), error)
            joints = joints.clip(self._low, self._high)
        return joints.clip(near - SPEED / FPS, near + SPEED / FPS)

    def _link_at(
        self, joints: Float[np.ndarray, "6"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Grasp point [m], and the axes of the gripper in columns; x points forwards."""
        self._data.qpos[self._own] = joints
        self._mj.mj_kinematics(self._model, self._data)
        self._mj.mj_comPos(self._model, self._data)
        axes = self._data.xmat[self._link].reshape(3, 3)
        return self._data.xpos[self._link] + GRIP * axes[:, 0], axes


class _Expert:
    """Takes the cube with the right hand and gives it to the left: `begin`, then `act`."""

    def __init__(self, model: Any):
        self._arms = _Arm(model, "left"), _Arm(model, "right")
        self.begin()

    def begin(self) -> None:
        """Begin an episode."""
        self._stage = -1

    def act(self, seen: Observation) -> Float[np.ndarray, "14"]:
        """Action for an observation; called once for each action."""
        arms = seen[AGENT_POS].astype(float).reshape(2, JOINTS + 1)
        cube = seen[ENVIRONMENT_STATE].astype(float)
        pairs = zip(self._arms, arms[:, :JOINTS], strict=True)
        hands = np.stack([arm.hand(joints) for arm, joints in pairs])
        if self._stage < 0:
            place = np.column_stack([hands, arms[:, JOINTS]])
            self._motion = np.stack([place, np.zeros((2, 6)), np.zeros((2, 6))])
            self._sent, self._cube = arms[:, :JOINTS], cube
            self._enter(0)
        self._choose_stage(hands, cube)
        self._cube = cube
        self._motion = _go_on(self._motion, self._goal(cube), self._remaining)
        self._remaining -= 1 / FPS
        pairs = zip(self._arms, self._motion[0, :, :5], self._sent, strict=True)
        self._sent = np.stack([arm.joints(hand, sent) for arm, hand, sent in pairs])
        return np.column_stack([self._sent, self._motion[0, :, 5]]).ravel().astype(np.float32)

    def _enter(self, stage: int) -> None:
        self._stage, self._remaining = stage, STAGES[stage].seconds

    def _choose_stage(
        self, hands: Float[np.ndarray, "2 5"], cube: Float[np.ndarray, "7"]
    ) -> None:
        """Choose the next, the first or the present stage, for these hands and this cube."""
        holds = self._stage >= HELD
        if holds and np.linalg.norm(hands[1, :3] - cube[:3]) > LOST:
            self._enter(0)
        elif not holds and np.linalg.norm(cube[:3] - self._cube[:3]) > JUMP:
            left = self._remaining if self._stage == 0 else 0.0
            self._enter(0)
            self._remaining = max(left, AGAIN * self._remaining)
        elif self._remaining <= 0 and self._stage + 1 < len(STAGES):
            near = (abs(hands - self._motion[0, :, :5]) < NEAR).all()
            if near or self._remaining < -PATIENCE:
                self._enter(self._stage + 1)

    def _goal(self, cube: Float[np.ndarray, "7"]) -> Float[np.ndarray, "2 6"]:
        """Poses of the hands and openings at the end of this stage, for this cube."""
        stage = STAGES[self._stage]
        if stage.right_open:
            self._down = [*cube[:3], DOWN, self._roll(cube)]
        right = np.array([*MEETING, 0, 0] if stage.right == "meeting" else self._down)
        if stage.right == "above cube":
            right[:3] += CLEARANCE
        left = cube[:3] + SHORT if stage.left == "cube" else MEETING + STANDOFF
        return np.array(
            [[*left, 0, ACROSS, stage.left_open], [*right, stage.right_open]], dtype=float
        )

    def _roll(self, cube: Float[np.ndarray, "7"]) -> float:
        """Roll of the right hand that aligns its fingers with faces of the cube [rad]."""
        w, x, y, z = cube[3:]
        yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        away = cube[:2] - self._arms[1].base
        off = math.atan2(away[1], away[0]) - self._arms[1].heading - yaw
        quarter = math.pi / 2
        return off - quarter * round(off / quarter)


def _axes(heading: float, down: float, roll: float) -> Float[np.ndarray, "3 3"]:
    """Axes, in columns, of a gripper with this heading, pitch and roll [rad]."""
    z, y, x = np.eye(3), np.eye(3), np.eye(3)
    for axes, rows, angle in ((z, [0, 1], heading), (y, [2, 0], down), (x, [1, 2], roll)):
        c, s = math.cos(angle), math.sin(angle)
        axes[np.ix_(rows, rows)] = [[c, -s], [s, c]]
    return z @ y @ x


def _go_on(
    motion: Float[np.ndarray, "3 2 6"], goal: Float[np.ndarray, "2 6"], seconds: float
) -> Float[np.ndarray, "3 2 6"]:
    """Position, velocity and acceleration one action later, on a motion that rests at the goal
    in time.
    """
    still = np.stack([goal, np.zeros_like(goal), np.zeros_like(goal)])
    if seconds <= 1 / FPS:
        return still
    units = seconds ** np.arange(3)[:, None, None]
    time, k = 1 / FPS / seconds, np.arange(6)
    powers = [
        time**k,
        k * time ** np.maximum(k - 1, 0),
        k * (k - 1) * time ** np.maximum(k - 2, 0),
    ]
    return still + np.tensordot(powers @ QUINTIC, (motion - still) * units, 1) / units
