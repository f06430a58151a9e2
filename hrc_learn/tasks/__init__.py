"""The pieces put to work: demonstrating, grasping, placing, and the whole collaboration."""

from .eye import Eye as Eye
from .fit_aiming import AimingSkill as AimingSkill
from .fit_aiming import fit_aiming as fit_aiming
from .fit_primitives import FittedPrimitives as FittedPrimitives
from .fit_primitives import fit_primitives as fit_primitives
from .placing import BlockedPathError as BlockedPathError
from .placing import PlacingSkill as PlacingSkill
from .placing import Plan as Plan
from .placing import check_plan as check_plan
from .teach_aiming import OBJECT_FEATURE as OBJECT_FEATURE
from .teach_aiming import OBJECT_FEATURE_NAMES as OBJECT_FEATURE_NAMES
from .teach_aiming import AimingLesson as AimingLesson
from .teach_aiming import teach_aiming as teach_aiming
from .teach_placing import PlacingLesson as PlacingLesson
from .teach_placing import teach_placing as teach_placing
from .visual_target import VisualTarget as VisualTarget
from .workplace import Workplace as Workplace
from .workplace import nearest_configuration as nearest_configuration
