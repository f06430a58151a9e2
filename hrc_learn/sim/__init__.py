"""The workplace in MuJoCo: arm, furniture, objects, cameras, contacts."""

from .changing_camera import CameraChange as CameraChange
from .changing_camera import ChangingCamera as ChangingCamera
from .contacts import ContactMonitor as ContactMonitor
from .contacts import Touch as Touch
from .covering import Occluder as Occluder
from .covering import Occlusion as Occlusion
from .markers import Plate as Plate
from .motion_log import MotionLog as MotionLog
from .moving_bodies import MovingBodies as MovingBodies
from .panda_model import FINGER_STROKE as FINGER_STROKE
from .panda_model import PandaModelConfig as PandaModelConfig
from .rendering import CameraKind as CameraKind
from .rendering import EGLCamera as EGLCamera
from .rendering import OffscreenRenderer as OffscreenRenderer
from .rendering import RenderingUnavailableError as RenderingUnavailableError
from .rendering import open_camera as open_camera
from .scene import HAND_MARKER as HAND_MARKER
from .scene import NOWHERE as NOWHERE
from .scene import CabinetConfig as CabinetConfig
from .scene import ObjectConfig as ObjectConfig
from .scene import SceneConfig as SceneConfig
from .scene import build_scene as build_scene
from .world import MujocoArm as MujocoArm
from .world import World as World
