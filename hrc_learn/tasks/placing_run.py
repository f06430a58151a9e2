"""One thing placed on a shelf in MuJoCo, from a start of one's own, and what came of it.

    transfer -> release -> retreat

The plan is carried out whether or not it is free: what it meets is counted, not foreseen.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from ..geometry import Pose, quaternion
from ..human import ScriptedPuller
from ..kinematics import panda
from ..sim import MotionLog, Touch, World
from .grasping import OPEN
from .placing import PlacingSkill, Plan, PlanningSpace
from .station import Station
from .watching import Watch, unwatched
from .workplace import Workplace

TRANSFER, RELEASE, RETREAT = "transfer", "release", "retreat"

_SETTLE = 0.4  # rest before the hand lets go [s]
_LET_GO = 0.8  # time the fingers take [s]
_CLEAR = 0.08  # way back, until nothing of the thing is between the fingers [m]
_RETREAT_SPEED = 0.08  # at the usual one, the shoulder comes close to its limits [m/s]


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacingRun:
    """What happened."""

    shelf: str
    space: PlanningSpace
    plan: Plan
    station: Station
    motion: MotionLog
    released: Pose
    """True pose of the hand when it let go."""
    touches: tuple[Touch, ...]
    """Of the arm with cabinet, table or itself, and of what it carried with the cabinet."""
    placed: bool
    """Whether the thing stood on its board in the end, and the arm had let go of it."""

    @property
    def transfer(self) -> slice:
        """Steps in which the plan was carried out."""
        return slice(0, len(self.plan.path))

    @property
    def joint_position(self) -> Float[np.ndarray, "steps 7"]:
        """Measured on the way to the shelf [rad]."""
        return self.station.log["joint_position"][self.transfer]

    @property
    def time(self) -> Float[np.ndarray, " steps"]:
        """From the start of the motion [s]."""
        time = self.station.log["time"][self.transfer]
        return time - time[0]

    @property
    def path(self) -> Float[np.ndarray, "steps 3"]:
        """Of the tool centre point on the way to the shelf [m]."""
        return panda.forward(torch.from_numpy(self.joint_position)).position.numpy()


def place(
    skill: PlacingSkill,
    workplace: Workplace,
    shelf: str,
    start: Float[torch.Tensor, "7"],
    *,
    space: PlanningSpace,
    speed: float = 1.5,
    world: World | None = None,
    watch: Watch = unwatched,
) -> PlacingRun:
    """Carry the scene's first object, already in the hand, to a shelf and let go of it.

    Args:
        skill: Learned placing motion.
        workplace: Where.
        shelf: Which.
        start: Joint positions at the start [rad].
        space: Follow the primitive of the joints, as the paper does, or that of the pose.
        speed: How many times faster than demonstrated.
        world: Of that workplace, to be used again; a new one if None.
        watch: Watches from the side, such as `serving` a dashboard.

    Raises:
        ValueError: If there is no such shelf, or the arm cannot reach it.
    """
    goal = workplace.shelf(shelf)
    item = workplace.scene.objects[0]
    world = world or World(workplace.scene)
    world.hold(item.name, start.numpy())
    motion = MotionLog(world)
    station = Station(
        chain=panda,
        arm=world.arm,
        gripper=world.arm,
        human=ScriptedPuller(panda, ()),
        advance=motion.advance,
    )
    with torch.inference_mode(), watch(station, world, motion):
        plan = skill.plan(station.joints, goal, space=space, dt=station.config.dt, speed=speed)
        station.enter(TRANSFER)
        station.play(plan.path)
        station.stay(_SETTLE)
        station.enter(RELEASE)
        released, release_time = _tool(world), world.time
        world.arm.move(OPEN)
        station.stay(_LET_GO)
        station.enter(RETREAT)
        station.move_straight(_back(released), speed=_RETREAT_SPEED)
    return PlacingRun(
        shelf=shelf,
        space=space,
        plan=plan,
        station=station,
        motion=motion,
        released=released,
        touches=_unwanted(world, release_time),
        placed=world.rests_on(item.name, f"board_{shelf}"),
    )


def _tool(world: World) -> Pose:
    """True pose of the tool centre point."""
    matrix = torch.from_numpy(world.arm.tcp_pose())
    return Pose(matrix[:3, 3], quaternion.from_matrix(matrix[:3, :3]))


def _back(released: Pose) -> Pose:
    """Clear of the thing: the hand drawn straight back along its own axis."""
    offset = released.position.new_tensor([0.0, 0.0, -_CLEAR])
    return Pose(released.apply(offset), released.orientation)


def _unwanted(world: World, release_time: float) -> tuple[Touch, ...]:
    """Every touch but that of the thing with its board once it was let go."""
    arm = (world.cabinet_contacts, world.table_contacts, world.self_contacts)
    carried = [t for t in world.object_contacts.touches if t.start < release_time]
    return tuple([touch for monitor in arm for touch in monitor.touches] + carried)
