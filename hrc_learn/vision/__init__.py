"""Cameras, lenses and ArUco features, in numpy; OpenCV is imported where it is used."""

from .camera_model import CameraModel as CameraModel
from .detector import MarkerDetector as MarkerDetector
from .detector import centre as centre
from .imaging import ImageNoise as ImageNoise
from .imaging import Lens as Lens
from .markers import Marker as Marker
from .markers import marker_texture as marker_texture
from .synthetic_camera import Cover as Cover
from .synthetic_camera import SyntheticCamera as SyntheticCamera
