"""The workplace in MuJoCo: arm, furniture, objects, cameras, contacts."""

from hrc_learn.protocols import Touch as Touch
from hrc_learn.sim.arm_model import ArmModelConfig as ArmModelConfig
from hrc_learn.sim.arm_model import whole_arm as whole_arm
from hrc_learn.sim.cameras import CameraChange as CameraChange
from hrc_learn.sim.cameras import CameraKind as CameraKind
from hrc_learn.sim.cameras import ChangingCamera as ChangingCamera
from hrc_learn.sim.cameras import OcclusionInterval as OcclusionInterval
from hrc_learn.sim.cameras import RenderingUnavailableError as RenderingUnavailableError
from hrc_learn.sim.cameras import ScriptedOcclusion as ScriptedOcclusion
from hrc_learn.sim.cameras import open_camera as open_camera
from hrc_learn.sim.imperfections import CommandChannel as CommandChannel
from hrc_learn.sim.imperfections import Imperfections as Imperfections
from hrc_learn.sim.recorded_world import MotionLog as MotionLog
from hrc_learn.sim.recorded_world import MovingBodies as MovingBodies
from hrc_learn.sim.recorded_world import RecordedWorld as RecordedWorld
from hrc_learn.sim.scene import HAND_MARKER as HAND_MARKER
from hrc_learn.sim.scene import ObjectConfig as ObjectConfig
from hrc_learn.sim.scene import SceneConfig as SceneConfig
from hrc_learn.sim.step_checks import PhysicsError as PhysicsError
from hrc_learn.sim.worker import Worker as Worker
from hrc_learn.sim.worker import WorkerConfig as WorkerConfig
from hrc_learn.sim.worker import WorkerSensor as WorkerSensor
from hrc_learn.sim.worker_visit import WorkerVisit as WorkerVisit
from hrc_learn.sim.worker_visit import random_visit as random_visit
from hrc_learn.sim.world import World as World
