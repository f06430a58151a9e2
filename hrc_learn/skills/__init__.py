"""Skills: visual servoing, grasping, placing, pick and place. They know no device drivers."""

from hrc_learn.skills.arm_motion import joint_line as joint_line
from hrc_learn.skills.complementary_motion import ComplementaryMotion as ComplementaryMotion
from hrc_learn.skills.grasping import Grasping as Grasping
from hrc_learn.skills.pick_and_place import PickAndPlace as PickAndPlace
from hrc_learn.skills.placing import PlacingSkill as PlacingSkill
from hrc_learn.skills.placing import Workplace as Workplace
from hrc_learn.skills.visual_skill import VisualServoSkill as VisualServoSkill
from hrc_learn.skills.work_cell import BlockedPathError as BlockedPathError
from hrc_learn.skills.work_cell import MissedGraspError as MissedGraspError
from hrc_learn.skills.work_cell import StoppedByPersonError as StoppedByPersonError
from hrc_learn.skills.work_cell import TaskFailedError as TaskFailedError
from hrc_learn.skills.work_cell import WorkCell as WorkCell
from hrc_learn.skills.work_cell import WorkCellConfig as WorkCellConfig
