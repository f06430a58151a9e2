"""The scripted expert as a LeRobot teleoperator."""

from __future__ import annotations

from hrc_learn.lerobot.robots import MujocoPanda
from hrc_learn.lerobot.teleoperators.config_panda_expert import PandaExpertConfig
from hrc_learn.lerobot.teleoperators.panda_teleoperator import PandaTeleoperator


class PandaExpert(PandaTeleoperator):
    """Shows a `mujoco_panda` its scenario, from each of its beginnings, then keeps still.

    The same demonstrations as `hrc record placing` records, with the release of the
    object, and grasping.
    """

    config_class = PandaExpertConfig
    name = "panda_expert"

    def __init__(self, config: PandaExpertConfig):
        super().__init__(config, config.robot_id)
        self.config = config

    def get_action(self) -> dict[str, float]:
        self._need_connection()
        robot = self._find()
        if not isinstance(robot, MujocoPanda):
            raise ValueError(
                f"panda_expert knows the scenarios of a mujoco_panda only, not of {robot.name}."
            )
        return self._guided_robot(robot, lambda: robot.run.expert).next()[0]
