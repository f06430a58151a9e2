"""Real arms, grippers and cameras; a driver is imported when its device is opened."""

from hrc_learn.hardware.driver_process import ArmFaultError as ArmFaultError
from hrc_learn.hardware.driver_process import ArmProcess as ArmProcess
from hrc_learn.hardware.driver_process import DriverError as DriverError
from hrc_learn.hardware.driver_process import ending_at_rest as ending_at_rest
from hrc_learn.hardware.franka_arm import FrankaArm as FrankaArm
from hrc_learn.hardware.franka_settings import CollisionConfig as CollisionConfig
from hrc_learn.hardware.franka_settings import FrankaConfig as FrankaConfig
from hrc_learn.hardware.franka_settings import FrankyConfig as FrankyConfig
from hrc_learn.hardware.franka_settings import Load as Load
from hrc_learn.hardware.franka_settings import RealtimeError as RealtimeError
from hrc_learn.hardware.franky_arm import FrankyArm as FrankyArm
from hrc_learn.hardware.gripper import GripperError as GripperError
from hrc_learn.hardware.lerobot_arm import LeRobotArm as LeRobotArm
from hrc_learn.hardware.lerobot_arm import LeRobotConfig as LeRobotConfig
from hrc_learn.hardware.opencv_cameras import CameraError as CameraError
from hrc_learn.hardware.opencv_cameras import CaptureCamera as CaptureCamera
from hrc_learn.hardware.opencv_cameras import measure_delay as measure_delay
from hrc_learn.hardware.ros2_arm import Ros2Arm as Ros2Arm
from hrc_learn.hardware.ros2_arm import Ros2Config as Ros2Config
