"""The workplace in MuJoCo: arm, furniture, objects, cameras, contacts."""

from hrc_learn.sim.cameras import CameraChange as CameraChange
from hrc_learn.sim.cameras import CameraKind as CameraKind
from hrc_learn.sim.cameras import ChangingCamera as ChangingCamera
from hrc_learn.sim.cameras import EGLCamera as EGLCamera
from hrc_learn.sim.cameras import OcclusionInterval as OcclusionInterval
from hrc_learn.sim.cameras import OffscreenRenderer as OffscreenRenderer
from hrc_learn.sim.cameras import RenderingUnavailableError as RenderingUnavailableError
from hrc_learn.sim.cameras import ScriptedOcclusion as ScriptedOcclusion
from hrc_learn.sim.cameras import open_camera as open_camera
from hrc_learn.sim.moving_bodies import MotionLog as MotionLog
from hrc_learn.sim.moving_bodies import MovingBodies as MovingBodies
from hrc_learn.sim.panda_model import FINGER_STROKE as FINGER_STROKE
from hrc_learn.sim.panda_model import PandaModelConfig as PandaModelConfig
from hrc_learn.sim.panda_model import Plate as Plate
from hrc_learn.sim.scene import HAND_MARKER as HAND_MARKER
from hrc_learn.sim.scene import NOWHERE as NOWHERE
from hrc_learn.sim.scene import CabinetConfig as CabinetConfig
from hrc_learn.sim.scene import ObjectConfig as ObjectConfig
from hrc_learn.sim.scene import SceneConfig as SceneConfig
from hrc_learn.sim.scene import build_scene as build_scene
from hrc_learn.sim.world import ContactMonitor as ContactMonitor
from hrc_learn.sim.world import MujocoArm as MujocoArm
from hrc_learn.sim.world import Touch as Touch
from hrc_learn.sim.world import World as World
