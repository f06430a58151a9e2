"""Cameras, lenses and ArUco features, in numpy; OpenCV is imported where it is used."""

from hrc_learn.vision.camera_model import CameraModel as CameraModel
from hrc_learn.vision.imaging import ImageNoise as ImageNoise
from hrc_learn.vision.imaging import Lens as Lens
from hrc_learn.vision.imaging import SyntheticCamera as SyntheticCamera
from hrc_learn.vision.markers import Marker as Marker
from hrc_learn.vision.markers import MarkerDetector as MarkerDetector
from hrc_learn.vision.markers import angle as angle
from hrc_learn.vision.markers import centre as centre
from hrc_learn.vision.markers import marker_texture as marker_texture
