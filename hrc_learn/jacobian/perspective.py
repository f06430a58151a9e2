"""A camera that sees a marker on the tool, calibrated from the tool's motion alone.

A vector c of thirteen numbers describes camera and marker:

    log f, (u0, v0), k1, rotation vector w and shift t from base to camera, marker m on the tool

Here f is the focal length [px], (u0, v0) the principal point [px], and k1 the radial
coefficient. If the tool is at position p with rotation T, the marker is at the point
exp(w) (p + T m) + t = (x, y, z) in the camera frame. With xi = (x, y) / z, its pixel is
f xi (1 + k1 |xi|^2) + (u0, v0). Camera and marker are fitted together, so they absorb errors of
the tool centre point and of the base.

Most functions of c take any leading batch axes, and poses or points with one further axis of
frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, permutations, product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.distributed import LazyMap
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import matmul
from hrc_learn.jacobian.fitting import ImageDemonstration

FOCAL, CENTER, RADIAL = slice(0, 1), slice(1, 3), slice(3, 4)
ROTATION, SHIFT, MARKER = slice(4, 7), slice(7, 10), slice(10, 13)
"""Components of the vector c."""
SIZE = 13
"""Length of the vector c."""

# Prior standard deviation of the logarithm of the focal length; the prior mean of the focal
# length is the image width. One standard deviation covers fields of view of 34 to 79 degrees.
_FOCAL_SPREAD = 0.5
# Prior standard deviation of the principal point from the image centre, relative to the image
# width: in real cameras with images 2000 px wide, it is off by some tens of pixels.
_CENTER_SPREAD = 0.02
# Prior standard deviation of the radial coefficient: all lenses except fisheyes are within it.
_RADIAL_SPREAD = 0.2
# Prior standard deviations of three quantities. `_ANY_TURN` and `_ANY_PLACE` apply to rotation
# [rad] and shift [m] of the camera, and are so wide that any value is possible.
# `_MARKER_SPREAD` applies to the offset of the marker from the tool centre point [m].
_ANY_TURN, _ANY_PLACE, _MARKER_SPREAD = 10.0, 10.0, 0.2
# Initial focal lengths of the search, relative to the image width.
_FOCAL_STARTS = (0.6, 1.0, 1.7)
# Lower bound of the pixel noise [px]. Without a bound, all frames of exact images would count
# as outliers.
_LEAST_NOISE = 0.02
# Least depth of a point in the projection [m].
_NEAREST = 1e-3
_TINY = 1e-12
# Steps of the fixed-point iteration that removes lens distortion. Each step multiplies the
# error by about 2 |k1| |xi|^2: by 0.3 at the edge of a 79-degree image with k1 = 0.2.
_LENS_STEPS = 20
# Approximate number of frames that are used; they suffice to average out the noise.
_FRAMES = 2000
# Rounds of robust reweighting, and Levenberg-Marquardt steps in each round.
_ROUNDS, _STEPS = 8, 6
# Initial search. `_FEW_FRAMES`: number of frames. `_SEARCHES`: number of rounds. `_FINALISTS`:
# number of best cameras that are then refined.
_FEW_FRAMES, _SEARCHES, _FINALISTS = 100, 5, 3
# Least depth of the marker in any frame, for the initial cameras of the search [m].
_CLEAR = 0.2
# Residual beyond which a frame counts less, in robust standard deviations.
_OUTLIER = 2.5
# Steps of a bundle adjustment; twenty are enough to converge.
_ADJUSTMENTS = 30
# Number of frames in a block. The summed errors of blocks of consecutive frames reveal the
# correlation of the errors.
_BLOCK = 25


def pixels_and_depth(
    camera: Float[Tensor, "*batch 13"], points: Float[Tensor, "*batch frames 3"]
) -> tuple[Float[Tensor, "*batch frames 2"], Float[Tensor, "*batch frames 2 3"]]:
    """Pixels of points in the camera frame [px], and the derivatives of the pixels with respect
    to the points [px/m].
    """
    # Points behind the camera are treated as very near: their pixels are wrong, but finite.
    z = points[..., 2:].clamp_min(_NEAREST)
    xi = points[..., :2] / z
    focal, radial = camera[..., None, FOCAL].exp(), camera[..., None, RADIAL]
    lens = 1 + radial * xi.square().sum(-1, keepdim=True)
    pixel = focal * lens * xi + camera[..., None, CENTER]
    along = xi.unsqueeze(-1)
    eye = torch.eye(2, dtype=points.dtype, device=points.device)
    slope = lens.unsqueeze(-1) * eye + 2 * radial.unsqueeze(-1) * along * along.mT
    pinhole = torch.cat([eye.expand(*xi.shape, 2), -along], dim=-1) / z.unsqueeze(-1)
    return pixel, focal.unsqueeze(-1) * matmul(slope, pinhole)


def marker_points(
    camera: Float[Tensor, "*batch 13"], pose: Pose
) -> Float[Tensor, "*batch frames 3"]:
    """Positions of the marker in the camera frame [m] at poses of the tool."""
    lever = quaternion.rotate(pose.orientation, camera[..., None, MARKER])
    return from_base(camera, pose.position + lever)


def from_base(
    camera: Float[Tensor, "*batch 13"], points: Float[Tensor, "*batch frames 3"]
) -> Float[Tensor, "*batch frames 3"]:
    """Transform points from the base frame to the camera frame [m]."""
    turn = quaternion.exp(camera[..., None, ROTATION])
    return quaternion.rotate(turn, points) + camera[..., None, SHIFT]


def marker_pixels(
    camera: Float[Tensor, "*batch 13"], pose: Pose
) -> tuple[Float[Tensor, "*batch frames 2"], Float[Tensor, "*batch frames 2 13"]]:
    """Pixels of the marker [px], and their derivatives with respect to a step (`stepped`)."""
    points = marker_points(camera, pose)
    pixel, by_point = pixels_and_depth(camera, points)
    offset = pixel - camera[..., None, CENTER]
    xi = points[..., :2] / points[..., 2:].clamp_min(_NEAREST)
    square = xi.square().sum(-1, keepdim=True)
    by_radial = camera[..., None, FOCAL].exp() * square * xi
    eye = torch.eye(2, dtype=pixel.dtype, device=pixel.device).expand(*xi.shape, 2)
    turned = torch.linalg.cross(
        (points - camera[..., None, SHIFT]).unsqueeze(-2).expand(by_point.shape), by_point
    )
    frame = quaternion.multiply(quaternion.exp(camera[..., None, ROTATION]), pose.orientation)
    by_marker = matmul(by_point, quaternion.to_matrix(frame))
    parts = [offset[..., None], eye, by_radial[..., None], turned, by_point, by_marker]
    return pixel, torch.cat(parts, dim=-1)


def camera_jacobian(
    camera: Float[Tensor, "*batch 13"], pose: Pose
) -> Float[Tensor, "*batch frames 2 6"]:
    """Image Jacobian of the marker for the tool's twist in the base frame [px/m, px/rad]."""
    _, by_point = pixels_and_depth(camera, marker_points(camera, pose))
    turn = quaternion.to_matrix(quaternion.exp(camera[..., None, ROTATION]))
    rows = matmul(by_point, turn.expand(*by_point.shape[:-2], 3, 3))
    lever = quaternion.rotate(pose.orientation, camera[..., None, MARKER]).unsqueeze(-2)
    return torch.cat([rows, torch.linalg.cross(lever.expand(rows.shape), rows)], dim=-1)


def stepped(
    camera: Float[Tensor, "*#batch 13"], step: Float[Tensor, "*#batch 13"]
) -> Float[Tensor, "*batch 13"]:
    """Camera after a step: the rotation is composed in the camera frame, the rest is added."""
    turn = quaternion.multiply(
        quaternion.exp(step[..., ROTATION]), quaternion.exp(camera[..., ROTATION])
    )
    added = camera + step
    return torch.cat(
        [added[..., :4], quaternion.log(turn), added[..., SHIFT], added[..., MARKER]], dim=-1
    )


def eye_of(camera: Float[Tensor, "*batch 13"]) -> Float[Tensor, "*batch 3"]:
    """Position of the camera's optical centre in the base frame [m]."""
    back = quaternion.conjugate(quaternion.exp(camera[..., ROTATION]))
    return -quaternion.rotate(back, camera[..., SHIFT])


def eye_by_step(camera: Float[Tensor, "*batch 13"]) -> Float[Tensor, "*batch 3 6"]:
    """Derivative of `eye_of` with respect to rotation and shift of a step (`stepped`)."""
    # A step moves the camera position e = -R^T t to e + R^T (w x t) - R^T dt.
    t = camera[..., SHIFT].unsqueeze(-2)
    axes = torch.eye(3).to(t).expand(*t.shape[:-2], 3, 3)
    turned = torch.linalg.cross(axes, t).mT
    back = quaternion.to_matrix(quaternion.conjugate(quaternion.exp(camera[..., ROTATION])))
    return back @ torch.cat([turned, -axes], dim=-1)


def rays(
    camera: Float[Tensor, "*batch 13"], pixel: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch 3"]:
    """Base-frame directions of pixels, with depth 1 along the optical axis."""
    distorted = (pixel - camera[..., CENTER]) / camera[..., FOCAL].exp()
    xi = distorted
    for _ in range(_LENS_STEPS):
        xi = distorted / (1 + camera[..., RADIAL] * xi.square().sum(-1, keepdim=True))
    ray = torch.cat([xi, torch.ones_like(xi[..., :1])], dim=-1)
    return quaternion.rotate(quaternion.conjugate(quaternion.exp(camera[..., ROTATION])), ray)


def on_plane(
    camera: Float[Tensor, "*batch 13"],
    pixel: Float[Tensor, "*batch 2"],
    height: float | Float[Tensor, ""],
) -> Float[Tensor, "*batch 3"]:
    """Points of a horizontal plane that the camera sees at pixels, in the base frame [m].

    Args:
        camera: Vector c of the camera.
        pixel: Pixels (u, v) [px].
        height: Height of the plane in the base frame [m].
    """
    eye, ray = eye_of(camera), rays(camera, pixel)
    return eye + ((height - eye[..., 2]) / ray[..., 2])[..., None] * ray


def unexplained(
    demonstrations: Sequence[ImageDemonstration], camera: Float[Tensor, "13"]
) -> Sequence[ImageDemonstration]:
    """Demonstrations whose feature is the seen pixel minus the prediction of a camera.

    The demonstrations are read on access.
    """
    return LazyMap(demonstrations, partial(_left_by, camera))


def _left_by(camera: Float[Tensor, "13"], demo: ImageDemonstration) -> ImageDemonstration:
    demo = demo.double()
    return replace(demo, feature=demo.feature - marker_pixels(camera, demo.pose)[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFit:
    """Camera and marker fitted to demonstrations, with the uncertainty of both."""

    camera: Float[Tensor, "13"]
    """Most probable camera."""
    covariance: Float[Tensor, "13 13"]
    """Covariance of a step (see `stepped`) from the most probable camera."""
    noise: float
    """Robust standard deviation of a pixel coordinate [px]."""

    def deviation(self, part: slice) -> float:
        """Largest standard deviation of a step among some components of c, such as `FOCAL`."""
        return float(self.covariance.diagonal()[part].max().clamp_min(0).sqrt())

    @property
    def place_deviation(self) -> float:
        """Largest standard deviation of the camera's position along an axis of the base [m]."""
        by_step, moved = eye_by_step(self.camera), slice(ROTATION.start, SHIFT.stop)
        covariance = by_step @ self.covariance[moved, moved] @ by_step.mT
        return float(covariance.diagonal().max().clamp_min(0).sqrt())

    def __str__(self) -> str:
        """Position, viewing direction, focal length and marker of the camera, as text."""
        x, y, z = eye_of(self.camera).tolist()
        matrix = quaternion.to_matrix(quaternion.exp(self.camera[ROTATION]))
        tilt = float(torch.rad2deg(torch.acos((-matrix[2, 2]).clamp(-1, 1))))
        focal = float(self.camera[FOCAL].exp())
        a, b, c = (1e3 * self.camera[MARKER]).tolist()
        return (
            f"camera at ({x:.3f}, {y:.3f}, {z:.3f}) m in the base frame, within "
            f"{1e3 * self.place_deviation:.1f} mm and "
            f"{np.rad2deg(self.deviation(ROTATION)):.2f} degrees (one standard deviation), its "
            f"view {tilt:.0f} degrees from straight down; focal length {focal:.0f} px, within "
            f"{focal * self.deviation(FOCAL):.0f}; marker at ({a:.0f}, {b:.0f}, {c:.0f}) mm on "
            f"the tool, within {1e3 * self.deviation(MARKER):.1f}"
        )


def fit_camera(
    demonstrations: Sequence[ImageDemonstration], image_size: tuple[int, int]
) -> CameraFit:
    """Fit camera and marker by robust maximum a posteriori estimation.

    A Levenberg-Marquardt search starts from several orientations and focal lengths.
    Errors of neighbouring frames are correlated, so a frame counts less than an independent
    observation.

    Args:
        demonstrations: Demonstrations in which the tool moved, read one by one.
        image_size: Width and height of the image [px].

    Raises:
        ValueError: The marker was seen in fewer than ten frames.
    """
    pose, pixel = _sampled(demonstrations)
    if len(pixel) < 10:
        text = f"the marker is visible in {len(pixel)} frames of the demonstrations, but a"
        raise ValueError(f"{text} camera needs ten or more: record with the marker in view.")
    prior, spread = _prior(image_size)
    width = image_size[0]
    few = slice(None, None, -(-len(pixel) // _FEW_FRAMES))
    cameras = _starts(pose[few], pixel[few], prior, width)
    everywhere = pixel.new_full((len(cameras), len(pixel[few])), (100 / width) ** 2)
    damping = pixel.new_full((len(cameras),), 1e-2)
    for _ in range(_SEARCHES):
        cameras, damping, _ = _searched(
            cameras, damping, pose[few], pixel[few], everywhere, prior, spread
        )
    off = (pixel[few] - marker_pixels(cameras, pose[few])[0]).norm(dim=-1).median(-1).values
    cameras = cameras[off.nan_to_num(torch.inf).argsort()[:_FINALISTS]]
    damping = pixel.new_full((len(cameras),), 1e-3)
    gram, noise = torch.zeros(0), pixel.new_ones(len(cameras))
    for _ in range(_ROUNDS):
        error = pixel - marker_pixels(cameras, pose)[0]
        size = error.norm(dim=-1)
        # For normal errors the median length in the plane is 1.177 standard deviations.
        noise = (size.median(-1).values / 1.177).clamp_min(_LEAST_NOISE)
        weight = (_OUTLIER * noise[:, None] / size.clamp_min(_TINY)).clamp(max=1.0)
        inflation = _inflation(error * weight[..., None], noise)
        cameras, damping, gram = _searched(
            cameras,
            damping,
            pose,
            pixel,
            weight / (noise**2 * inflation)[:, None],
            prior,
            spread,
        )
    error = pixel - marker_pixels(cameras, pose)[0]
    best = int(error.norm(dim=-1).median(-1).values.nan_to_num(torch.inf).argmin())
    return CameraFit(
        camera=cameras[best], covariance=torch.linalg.inv(gram[best]), noise=float(noise[best])
    )


def _prior(image_size: tuple[int, int]) -> tuple[Float[Tensor, "13"], Float[Tensor, "13"]]:
    """Prior mean and standard deviation of c for an image size [px]."""
    width, height = image_size
    spread = [_FOCAL_SPREAD, *[_CENTER_SPREAD * width] * 2, _RADIAL_SPREAD]
    spread += [*[_ANY_TURN] * 3, *[_ANY_PLACE] * 3, *[_MARKER_SPREAD] * 3]
    mean = [float(np.log(width)), width / 2, height / 2, *[0.0] * 10]
    return torch.tensor(mean).double(), torch.tensor(spread).double()


def adjust_bundle(
    cameras: Float[Tensor, "points 13"],
    pose: Pose,
    pixel: Float[Tensor, "points frames 2"],
    image_size: tuple[int, int],
    reach: float,
) -> Float[Tensor, "points 13"]:
    """Fit one camera and many points of a link together (bundle adjustment).

    The Levenberg-Marquardt method minimises the robust cost r^2 e^2 / (r^2 + e^2) of errors e.
    The Schur complement of the points leaves ten equations for the camera (Triggs et al. 2000).

    Args:
        cameras: Copies of one camera, one for each point, with the point as the marker.
        pose: Poses of the link, (frames,).
        pixel: Pixels of the points [px]; NaN where a point is not seen.
        image_size: Width and height of the image [px].
        reach: Error r beyond which a pixel counts less [px].
    """
    known = pixel.isfinite().all(-1)
    prior, spread = _prior(image_size)

    def misfit(candidates: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen, slope = marker_pixels(candidates, pose)
        error = torch.where(known[..., None], pixel - seen, 0.0).nan_to_num()
        return error, slope, error.square().sum(-1)

    def cost_of(candidates: Tensor, square: Tensor) -> Tensor:
        away = (_from_prior(candidates, prior) / spread).square()
        robust = (reach**2 * square / (reach**2 + square)).sum()
        return robust + away[0, : MARKER.start].sum() + away[:, MARKER].sum()

    error, slope, square = misfit(cameras)
    cost, damping = cost_of(cameras, square), 1e-3
    for _ in range(_ADJUSTMENTS):
        weight = known * (reach**2 / (reach**2 + square)).square()
        step = _bundle_step(cameras, weight, slope, error, prior, spread, damping)
        candidates = stepped(cameras, step)
        parts = misfit(candidates)
        new = cost_of(candidates, parts[-1])
        if new < cost:
            cameras, (error, slope, square), cost = candidates, parts, new
            damping = damping / 5
        else:
            damping = damping * 10
    return cameras


def _bundle_step(
    cameras: Float[Tensor, "points 13"],
    weight: Float[Tensor, "points frames"],
    slope: Float[Tensor, "points frames 2 13"],
    error: Float[Tensor, "points frames 2"],
    prior: Float[Tensor, "13"],
    spread: Float[Tensor, "13"],
    damping: float,
) -> Float[Tensor, "points 13"]:
    """Damped Gauss-Newton step of one camera and its points; eliminates the points first."""
    pull = -_from_prior(cameras, prior) / spread.square()
    gram = torch.einsum("pf,pfij,pfik->pjk", weight, slope, slope)
    towards = torch.einsum("pf,pfij,pfi->pj", weight, slope, error)
    n = MARKER.start
    whole = gram[:, :n, :n].sum(0) + spread[:n].square().reciprocal().diag()
    points = gram[:, n:, n:] + spread[n:].square().reciprocal().diag()
    points = points + damping * points.diagonal(dim1=-2, dim2=-1).diag_embed()
    right = (towards + pull)[:, n:, None]
    solved = torch.linalg.solve(points, torch.cat([gram[:, n:, :n], right], dim=-1))
    reduced = torch.einsum("pij,pik->jk", gram[:, n:, :n], solved)
    left = whole + damping * whole.diagonal().diag() - reduced[:, :-1]
    camera = torch.linalg.solve(left, towards[:, :n].sum(0) + pull[0, :n] - reduced[:, -1])
    rest = solved[..., -1] - solved[..., :-1] @ camera
    return torch.cat([camera.expand(len(rest), n), rest], dim=-1)


def _searched(
    cameras: Float[Tensor, "starts 13"],
    damping: Float[Tensor, " starts"],
    pose: Pose,
    pixel: Float[Tensor, "frames 2"],
    weight: Float[Tensor, "starts frames"],
    prior: Float[Tensor, "13"],
    spread: Float[Tensor, "13"],
) -> tuple[Tensor, Tensor, Tensor]:
    """Cameras, dampings and information matrices after Levenberg-Marquardt steps."""

    def cost_of(candidates: Tensor) -> Tensor:
        seen, _ = pixels_and_depth(candidates, marker_points(candidates, pose))
        misfit = (weight * (pixel - seen).square().sum(-1)).sum(-1)
        return misfit + (_from_prior(candidates, prior) / spread).square().sum(-1)

    cost = cost_of(cameras)
    gram = torch.zeros(0)
    for _ in range(_STEPS):
        seen, slope = marker_pixels(cameras, pose)
        weighted = weight[..., None, None] * slope
        gram = (
            torch.einsum("sfij,sfik->sjk", weighted, slope)
            + spread.square().reciprocal().diag()
        )
        towards = torch.einsum("sfij,sfi->sj", weighted, pixel - seen)
        towards = towards - _from_prior(cameras, prior) / spread.square()
        scale = gram.diagonal(dim1=-2, dim2=-1)
        step = torch.linalg.solve(gram + (damping[:, None] * scale).diag_embed(), towards)
        candidates = stepped(cameras, step)
        new = cost_of(candidates)
        better = new < cost
        cameras = torch.where(better[:, None], candidates, cameras)
        cost = torch.where(better, new, cost)
        damping = torch.where(better, damping / 5, damping * 10).clamp(1e-12, 1e6)
    return cameras, damping, gram


def _from_prior(camera: Float[Tensor, "*batch 13"], prior: Float[Tensor, "13"]) -> Tensor:
    """Difference from the prior mean; zero for the rotation, which has no preferred value."""
    away = camera - prior
    return torch.cat([away[..., :4], 0 * away[..., ROTATION], away[..., 7:]], dim=-1)


def _inflation(
    error: Float[Tensor, "starts frames 2"], noise: Float[Tensor, " starts"]
) -> Float[Tensor, " starts"]:
    """Variance of errors summed over blocks of frames, relative to independent errors."""
    whole = error[:, : error.shape[1] // _BLOCK * _BLOCK]
    if not whole.shape[1]:
        return torch.ones_like(noise)
    sums = whole.unflatten(1, (-1, _BLOCK)).sum(2)
    return (sums.square().mean((1, 2)) / (_BLOCK * noise**2)).clamp(1.0, float(_BLOCK))


def _starts(
    pose: Pose, pixel: Float[Tensor, "frames 2"], prior: Float[Tensor, "13"], width: int
) -> Float[Tensor, "starts 13"]:
    """Initial cameras in 24 orientations at three focal lengths.

    Each camera has the shift that best explains a marker at the tool centre point.
    """
    rotations = _cube_rotations().to(pixel)
    turned, marker = quaternion.log(quaternion.from_matrix(rotations)), pixel.new_zeros(24, 3)
    starts = []
    for factor in _FOCAL_STARTS:
        point = pose.position @ rotations.mT
        shift = _shifts(point, (pixel - prior[CENTER]) / (factor * width))
        optics = torch.cat([prior[:1] + float(np.log(factor)), prior[1:4]])
        starts.append(torch.cat([optics.expand(24, 4), turned, shift, marker], dim=-1))
    return torch.cat(starts)


def _shifts(
    point: Float[Tensor, "starts frames 3"], xi: Float[Tensor, "frames 2"]
) -> Float[Tensor, "starts 3"]:
    """Shifts t [m] of initial cameras, by least squares, with all points in front of them.

    A point x, rotated to the camera frame, is seen in the direction xi: the first two
    components of x + t, divided by the third.

    Args:
        point: Points x for each start [m].
        xi: Directions of the pixels, without lens distortion.
    """
    eye = torch.eye(2, dtype=xi.dtype).expand(len(xi), 2, 2)
    rows = torch.cat([eye, -xi[..., None]], dim=-1).reshape(-1, 3)
    right = (xi * point[..., 2:] - point[..., :2]).flatten(1)
    # If the pixels do not determine the depth, a weak prior sets it to one metre. The prior has
    # a millionth of the weight of the pixels.
    depth = 1.0 - point[..., 2].mean(1)
    ridge = 1e-6 * len(xi) * torch.diag(xi.new_tensor([0.0, 0.0, 1.0]))
    towards = right @ rows + ridge.diagonal() * depth[:, None]
    shift = torch.linalg.solve(rows.mT @ rows + ridge, towards.mT).mT
    nearest = _CLEAR - point[..., 2].amin(1)
    return torch.cat([shift[:, :2], shift[:, 2:].maximum(nearest[:, None])], dim=-1)


def _cube_rotations() -> Float[Tensor, "24 3 3"]:
    """Rotations that map a cube to itself: any rotation is within 63 degrees of one of them."""
    signed = [
        torch.eye(3)[list(order)] * torch.tensor(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return torch.stack([matrix for matrix in signed if torch.linalg.det(matrix) > 0])


def motion_jacobian(
    camera: Float[Tensor, "13"], points: Float[Tensor, "frames 3"]
) -> Float[Tensor, "frames 2 6"]:
    """Derivative of pixels with respect to a camera twist in the camera frame [px/rad, px/m].

    This is the interaction matrix of points (Espiau, Chaumette and Rives 1992), times the
    derivative of the lens. The first three columns are for rotation, the others for
    translation.

    Args:
        camera: Vector c of the camera.
        points: Points in the camera frame [m].
    """
    _, by_point = pixels_and_depth(camera, points)
    # If the camera turns by w and moves by v, a point p moves by p x w - v in the camera frame.
    turned = torch.linalg.cross(by_point, points[:, None].expand(by_point.shape))
    return torch.cat([turned, -by_point], dim=-1)


def moved(
    camera: Float[Tensor, "*#batch 13"], twist: Float[Tensor, "*#batch 6"]
) -> Float[Tensor, "*batch 13"]:
    """Camera after a turn about its axes [rad] and a shift along its former axes [m]."""
    back = quaternion.exp(-twist[..., :3])
    turn = quaternion.log(quaternion.multiply(back, quaternion.exp(camera[..., ROTATION])))
    shift = quaternion.rotate(back, camera[..., SHIFT] - twist[..., 3:])
    whole = camera.expand(*turn.shape[:-1], SIZE)
    return torch.cat([whole[..., :4], turn, shift, whole[..., MARKER]], dim=-1)


def _sampled(
    demonstrations: Sequence[ImageDemonstration],
) -> tuple[Pose, Float[Tensor, "frames 2"]]:
    """Poses and pixels of about `_FRAMES` frames with a visible marker, evenly chosen."""
    if not len(demonstrations):
        raise ValueError("there are no demonstrations to fit a camera to: record some")
    every = -(-len(demonstrations) // _FRAMES)
    each = -(-_FRAMES // len(demonstrations))
    positions, orientations, pixels = [], [], []
    for demo in islice(demonstrations, 0, None, every):
        pose, feature = demo.seen()
        some = slice(None, None, max(1, len(feature) // each))
        positions.append(pose.position[some])
        orientations.append(pose.orientation[some])
        pixels.append(feature[some])
    return Pose(torch.cat(positions), torch.cat(orientations)), torch.cat(pixels)
