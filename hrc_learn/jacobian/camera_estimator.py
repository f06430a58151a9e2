"""Online estimate of a camera that may have been moved, and of the residual image Jacobian.

The state holds a window of key frames, which are images far enough apart to show the motion of
the tool. The unknowns are the camera c (thirteen numbers, see `perspective`) and the weights W
of the network that represents the residual (see `network`). In key frame i, with the tool at
pose r_i, the marker's pixel is

    x_i = pixel(c, r_i) + W Phi_i + noise,    Phi_i = sum of dr (x) theta since the first frame

Here dr is the motion of the tool between two key frames, theta are the activations of the
neurons, and (x) is the Kronecker product. W enters linearly and has a Gaussian prior with
covariance P, so it is integrated out: errors of frames i and j have the covariance Phi_i^T P
Phi_j. The camera follows from Gauss-Newton steps of generalised least squares. The search
starts from several hypotheses, which differ in the rotation about the optical axis. Given the
camera, W has a closed form. Camera and W together are the maximum a posteriori estimate.

The prior of optics and marker is their posterior from the demonstrations. The prior of the
camera's position and orientation is wide. If several images in a row show the marker far from
its predicted pixel, the camera was moved: the window is emptied and the search begins again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_positive, everywhere, is_number
from hrc_learn.jacobian.estimators import ImageJacobianEstimator, Measurement, evaluate
from hrc_learn.jacobian.fitting import component_scale, weight_covariance
from hrc_learn.jacobian.network import RBFImageJacobian
from hrc_learn.jacobian.perspective import (
    ROTATION,
    SHIFT,
    SIZE,
    camera_jacobian,
    eye_by_step,
    eye_of,
    marker_pixels,
    moved,
    stepped,
)
from hrc_learn.pytree import chosen, pytree

# Components of c whose prior is the posterior of the demonstrations: optics and marker.
_KNOWN = [0, 1, 2, 3, 10, 11, 12]
# Largest rotation [rad] and translation [m] of a Gauss-Newton step: beyond these the
# linearisation does not hold.
_LONGEST_TURN, _LONGEST_MOVE = 0.4, 0.15
# A frame counts less if its error exceeds this multiple of the median error of the window.
_OUTLIER = 3.0
# Variance of frames of the window that hold no image [px^2].
_UNKNOWN = 1e6


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """Window, noise and prior of the estimate."""

    frames: int = 56
    """Number of key frames in the window."""
    min_step: float = 0.006
    """Least motion between key frames [m]; `rotation_scale` converts rotations."""
    max_step: float = 0.1
    """Largest motion between key frames over which the residual Jacobian is integrated [m]."""
    rotation_scale: float = 0.15
    """Length by which rotations are converted to motions, a typical lever arm [m/rad]."""
    pixel_noise: float = 0.25
    """Standard deviation of a pixel coordinate [px]: 0.1 px from the detector in blurred
    images, the rest from the noise of the encoders."""
    hypotheses: int = 8
    """Number of rotations about the optical axis from which the search starts."""
    tilt: float = 0.15
    """Prior standard deviation of a tilt of the camera since the demonstrations [rad]; the
    rotation about its optical axis is unrestricted."""
    place: float = 0.1
    """Prior standard deviation of a shift of the camera along each axis [m]."""
    marker: float = 1e-3
    """Standard deviation of a marker shift on the tool since the demonstrations [m]."""
    residual: float = 8.0
    """Prior standard deviation of the mean of the residual image Jacobian [px/m]: half a
    percent of an ordinary image Jacobian. Encoder zeros that are off by 2 mrad cause as
    much."""
    bump: float = 4.0
    """Error above which the camera may have been moved [px], plus five standard deviations."""
    surprises: int = 3
    """Number of consecutive images with such errors after which the camera counts as moved."""

    __post_init__ = check_positive


@pytree
class CameraState:
    """Hypotheses of the camera, weights of the residual, and the window of key frames."""

    weight: Float[Tensor, "*batch entries K"]
    """Weights W, given the most probable camera [px/m, px/rad]."""
    cameras: Float[Tensor, "*batch hypotheses 13"]
    """Hypotheses of the camera."""
    cost: Float[Tensor, "*batch hypotheses"]
    """Negative log posterior of each hypothesis, up to a constant."""
    covariance: Float[Tensor, "*batch 13 13"]
    """Covariance of a step (`perspective.stepped`) from the most probable camera."""
    position: Float[Tensor, "*batch frames 3"]
    """Positions of the tool in the window [m], the newest last."""
    orientation: Float[Tensor, "*batch frames 4"]
    """Orientations of the tool (w, x, y, z)."""
    pixel: Float[Tensor, "*batch frames 2"]
    """Pixels of the marker [px]."""
    path: Float[Tensor, "*batch frames P"]
    """Regressors of the residual, summed along the path up to each frame [m]."""
    known: Bool[Tensor, "*batch frames"]
    """True for frames of the window that hold an image."""
    surprises: Float[Tensor, "*batch"]
    """Number of consecutive images with the marker far from its predicted pixel."""
    moves: Float[Tensor, "*batch"]
    """Number of camera motions detected so far."""

    @property
    def best(self) -> Float[Tensor, "*batch 13"]:
        """Most probable camera."""
        index = self.cost.argmin(-1, keepdim=True)[..., None]
        return self.cameras.gather(-2, index.expand(*index.shape[:-1], SIZE)).squeeze(-2)

    @property
    def probability(self) -> Float[Tensor, "*batch hypotheses"]:
        """Posterior probability of each hypothesis."""
        return torch.softmax(-self.cost, dim=-1)

    def spread(self) -> CameraSpread:
        """Uncertainty of the camera, as samples: steps of one standard deviation from the most
        probable camera, and all hypotheses.
        """
        best = self.best
        covariance = self.covariance / 2 + self.covariance.mT / 2
        values, vectors = torch.linalg.eigh(covariance)
        steps = (vectors * values.clamp_min(0).sqrt().unsqueeze(-2)).mT
        around = stepped(best.unsqueeze(-2).expand(steps.shape), steps)
        samples = torch.cat([best.unsqueeze(-2), around, self.cameras], dim=-2)
        weights = torch.cat([torch.ones_like(values), self.probability], dim=-1)
        return CameraSpread(samples=samples, weights=weights)


@pytree
class CameraSpread:
    """Sample cameras that represent the uncertainty of an estimate.

    Let a function have the value y_0 for the first camera and y_k for sample k. The variance of
    the function is the sum of weight_k (y_k - y_0)^2 over the other samples. The variance
    combines the linearised variance about the most probable camera with the spread of the
    hypotheses.
    """

    samples: Float[Tensor, "*batch samples 13"]
    """The most probable camera, then the other sample cameras."""
    weights: Float[Tensor, "*batch others"]
    """Weight of each sample after the first."""


class CameraEstimator(ImageJacobianEstimator):
    """Maximum a posteriori estimate of camera and residual from a window of key frames."""

    def __init__(self, network: RBFImageJacobian, config: CameraConfig | None = None):
        """Prepare the prior.

        Args:
            network: Network with the camera of the demonstrations, in float64.
            config: Window, noise and prior.

        Raises:
            ValueError: The network has no camera.
        """
        super().__init__(network)
        self.config = config = config or CameraConfig()
        if network.camera is None or network.camera_covariance is None:
            text = "the image Jacobian has no camera: fit it again with `hrc fit"
            raise ValueError(f"{text} image-jacobian`, or choose another estimator.")
        camera, K = network.camera, len(network.centers)
        known = network.camera_covariance[_KNOWN][:, _KNOWN]
        widened = [0.0] * 4 + [config.marker**2] * 3
        precision, index = camera.new_zeros(SIZE, SIZE), torch.tensor(_KNOWN)
        precision[index[:, None], index] = torch.linalg.inv(
            known + camera.new_tensor(widened).diag()
        )
        bias, scale = config.residual, component_scale(camera, config.rotation_scale)
        one = weight_covariance(network.centers, bias, bias / 2)
        self.reference = nn.Buffer(camera, persistent=False)
        """Camera of the demonstrations, (13,)."""
        self.precision = nn.Buffer(precision, persistent=False)
        """Prior precision of optics and marker, zero for other components of c, (13, 13)."""
        self.residual = nn.Buffer(torch.block_diag(*[one] * 6), persistent=False)
        """Prior covariance of the weights of one image row, (P, P)."""
        self.scale = nn.Buffer(scale, persistent=False)
        """Metres per unit of each component of a twist, (6,)."""
        rolls = camera.new_zeros(config.hypotheses, 6)
        rolls[:, 2] = -torch.arange(config.hypotheses) * (2 * math.pi / config.hypotheses)
        self.rolls = nn.Buffer(rolls, persistent=False)
        """Initial rotations of the hypotheses about the optical axis, as twists, (hypotheses,
        6)."""
        self.size = 6 * K

    def initial_state(self, *batch: int) -> CameraState:
        """State with the demonstrations' camera, rotated for each hypothesis, and no frames."""
        config, like = self.config, self.reference
        frames = (*batch, config.frames)
        upright = like.new_tensor([1.0, 0, 0, 0])
        cameras = moved(like.expand(*batch, 1, SIZE), self.rolls)
        return CameraState(
            weight=self.initial_weight(*batch),
            cameras=cameras,
            cost=self._roll_cost(cameras),
            covariance=self._prior_covariance(*batch),
            position=like.new_zeros(*frames, 3),
            orientation=upright.expand(*frames, 4).clone(),
            pixel=like.new_zeros(*frames, 2),
            path=like.new_zeros(*frames, self.size),
            known=torch.zeros(frames, dtype=torch.bool, device=like.device),
            surprises=like.new_zeros(batch),
            moves=like.new_zeros(batch),
        )

    def jacobian(
        self, state: CameraState, r: Pose | Float[Tensor, "*batch 6"]
    ) -> Float[Tensor, "*batch rows 6"]:
        """Estimated image Jacobian J_s_hat at a pose: the camera's, plus the residual."""
        pose = Pose.from_vector(r) if isinstance(r, Tensor) else r
        first = camera_jacobian(state.best, pose[..., None]).squeeze(-3)
        return first + evaluate(state.weight, self.network.basis(pose))

    def update(self, state: CameraState, measurement: Measurement) -> CameraState:
        """State after an image; unchanged without a visible marker."""
        seen = measurement.valid & is_number(measurement.feature).all(-1)
        if everywhere(~seen):
            return state
        state = self._watched(state, measurement, seen)
        state, kept = self._with_key_frame(state, measurement, seen)
        return chosen(seen & kept, self._searched(state), state)

    def _roll_cost(self, cameras: Float[Tensor, "*batch hypotheses 13"]) -> Tensor:
        """Small cost of rotations since the demonstrations.

        It selects the hypothesis without a rotation until the tool has moved.
        """
        turn = quaternion.exp(cameras[..., ROTATION])
        return 0.05 * quaternion.angle(turn, quaternion.exp(self.reference[ROTATION]))

    def _prior_covariance(self, *batch: int) -> Float[Tensor, "*batch 13 13"]:
        """Covariance of a step from the demonstrations' camera before any frame."""
        _, slope = self._prior_error(self.reference)
        gram = slope.mT @ slope + self.precision
        gram = gram + torch.eye(SIZE).to(gram) * 1e-2
        return torch.linalg.inv(gram).expand(*batch, SIZE, SIZE).clone()

    def _prior_error(
        self, cameras: Float[Tensor, "*batch 13"]
    ) -> tuple[Float[Tensor, "*batch 5"], Float[Tensor, "*batch 5 13"]]:
        """Tilt and translation divided by their prior standard deviations, and the derivatives
        of both with respect to a step.
        """
        config = self.config
        home = quaternion.to_matrix(quaternion.exp(self.reference[ROTATION]))
        R = quaternion.to_matrix(quaternion.exp(cameras[..., ROTATION]))
        zero = torch.zeros_like(R[..., 0])
        # Optical axis in the frame of the demonstrations' camera, whose optical axis is
        # (0, 0, 1).
        tilt = (R[..., 2, :] @ home.mT)[..., :2] / config.tilt
        by_turn = torch.stack([R[..., 1, :], -R[..., 0, :], zero], dim=-1)
        by_turn = (home @ by_turn)[..., :2, :] / config.tilt
        away = (eye_of(cameras) - eye_of(self.reference)) / config.place
        tilted = torch.cat([by_turn, torch.zeros_like(by_turn)], dim=-1)
        slope = torch.cat([tilted, eye_by_step(cameras) / config.place], dim=-2)
        slope = torch.nn.functional.pad(slope, (ROTATION.start, SIZE - SHIFT.stop))
        return torch.cat([tilt, away], dim=-1), slope

    def _watched(
        self, state: CameraState, now: Measurement, seen: Bool[Tensor, "*batch"]
    ) -> CameraState:
        """State in which the window is empty for elements of the batch with a moved camera."""
        config = self.config
        expected, slope = marker_pixels(state.best, now.pose[..., None])
        error = now.feature - expected.squeeze(-2)
        slope = slope.squeeze(-3)
        spread = slope @ state.covariance @ slope.mT
        deviation = spread.diagonal(dim1=-2, dim2=-1).amax(-1).clamp_min(0).sqrt()
        settled = state.known.sum(-1) >= config.surprises
        limit = config.bump + 5 * (deviation + config.pixel_noise)
        far = seen & settled & (error.norm(dim=-1) > limit)
        surprises = torch.where(far, state.surprises + 1, torch.where(seen, 0, state.surprises))
        bumped = surprises >= config.surprises
        fresh = replace(
            state,
            weight=self.initial_weight(*bumped.shape),
            cameras=moved(state.best.unsqueeze(-2), self.rolls),
            known=torch.zeros_like(state.known),
            surprises=torch.zeros_like(surprises),
            moves=state.moves + 1,
        )
        return chosen(bumped, fresh, replace(state, surprises=surprises))

    def _with_key_frame(
        self, state: CameraState, now: Measurement, seen: Bool[Tensor, "*batch"]
    ) -> tuple[CameraState, Bool[Tensor, "*batch"]]:
        """Add the image to the window if the tool has moved since the last key frame.

        Returns:
            The state, and False if recent images indicate a moved camera. Nothing is learned
            from such images.
        """
        config = self.config
        last = Pose(state.position[..., -1, :], state.orientation[..., -1, :])
        twist = last.twist_to(now.pose)
        distance = (twist * self.scale).norm(dim=-1)
        first = ~state.known[..., -1]
        calm = state.surprises == 0
        add = seen & calm & (first | (distance >= config.min_step))
        theta = (self.network.basis(last) + self.network.basis(now.pose)) / 2
        follow = ~first & (distance <= config.max_step)
        phi = ((twist * self.scale)[..., :, None] * theta[..., None, :]).flatten(-2)
        path = state.path[..., -1, :] + torch.where(follow[..., None], phi, 0.0)
        feature = torch.where(seen[..., None], now.feature, 0.0)

        def pushed(window: Tensor, newest: Tensor) -> Tensor:
            return torch.cat([window[..., 1:, :], newest.unsqueeze(-2)], dim=-2)

        longer = replace(
            state,
            position=pushed(state.position, now.pose.position),
            orientation=pushed(state.orientation, now.pose.orientation),
            pixel=pushed(state.pixel, feature),
            path=pushed(state.path, path),
            known=torch.cat([state.known[..., 1:], torch.ones_like(first)[..., None]], dim=-1),
        )
        return chosen(add, longer, state), calm

    def _searched(self, state: CameraState) -> CameraState:
        """State after one Gauss-Newton step and the fit of the residual to the best camera."""
        known = state.known
        newest = known.to(state.path).cumsum(-1)
        start = ((newest == 1) & known).to(state.path)
        # Regressors accumulated since the first frame of the window.
        path = state.path - (start[..., None] * state.path).sum(-2, keepdim=True)
        path = torch.where(known[..., None], path, 0.0)
        covaried = path @ self.residual
        kernel = covaried @ path.mT
        one = Pose(state.position.unsqueeze(-3), state.orientation.unsqueeze(-3))
        mean = self._flat_weight(self.initial_weight()) @ path.mT
        pixel = state.pixel - mean.mT
        inverse = self._information(state, pixel, kernel)
        grams, towards, cost = self._normal_equations(state.cameras, one, pixel, known, inverse)
        cameras = stepped(state.cameras, _shortened(torch.linalg.solve(grams, towards)))
        index = cost.argmin(-1)[..., None, None, None]
        gram = grams.gather(-3, index.expand(*index.shape[:-2], SIZE, SIZE)).squeeze(-3)
        learned = replace(state, cameras=cameras, cost=cost)
        best = learned.best
        poses = Pose(state.position, state.orientation)
        error = torch.where(known[..., None], pixel - marker_pixels(best, poses)[0], 0.0)
        whitened = inverse @ error
        change = (covaried.mT @ whitened).mT.unflatten(-1, (6, -1))
        weight = self.initial_weight() + (change * self.scale[:, None]).flatten(-3, -2)
        # Errors larger than assumed increase the covariance in proportion.
        count = (2 * known.sum(-1) - SIZE + len(_KNOWN)).clamp_min(1)
        misfit = ((error * whitened).sum((-2, -1)) / count).clamp_min(1.0)
        covariance = torch.linalg.inv(gram) * misfit[..., None, None]
        return replace(learned, weight=weight, covariance=covariance)

    def _flat_weight(self, weight: Tensor) -> Float[Tensor, "*batch 2 P"]:
        """Weights that multiply regressors with rotation scaled to metres."""
        return (weight.unflatten(-2, (2, 6)) / self.scale[:, None]).flatten(-2)

    def _information(
        self,
        state: CameraState,
        pixel: Float[Tensor, "*batch frames 2"],
        kernel: Float[Tensor, "*batch frames frames"],
    ) -> Float[Tensor, "*batch frames frames"]:
        """Inverse covariance of the frames' errors.

        Frames that are outliers for the best camera count less.
        """
        seen, _ = marker_pixels(state.best, Pose(state.position, state.orientation))
        size = torch.where(state.known, (pixel - seen).norm(dim=-1), 0.0)
        # The median over known frames: unknown frames have size zero and are sorted first.
        count = state.known.sum(-1, keepdim=True)
        place = size.shape[-1] - 1 - count // 2
        median = size.sort(-1).values.gather(-1, place.clamp(0, size.shape[-1] - 1))
        most = (_OUTLIER * median).clamp_min(_OUTLIER * self.config.pixel_noise)
        inverse_weight = (size / most).clamp_min(1.0).square()
        noise = torch.where(state.known, self.config.pixel_noise**2 * inverse_weight, _UNKNOWN)
        return torch.linalg.inv(kernel + torch.diag_embed(noise))

    def _normal_equations(
        self,
        cameras: Float[Tensor, "*batch hypotheses 13"],
        poses: Pose,
        pixel: Float[Tensor, "*batch frames 2"],
        known: Bool[Tensor, "*batch frames"],
        inverse: Float[Tensor, "*batch frames frames"],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Matrix and right-hand side of a Gauss-Newton step, and cost, of each hypothesis."""
        seen, slope = marker_pixels(cameras, poses)
        use = known[..., None, :, None]
        error = torch.where(use, pixel.unsqueeze(-3) - seen, 0.0)
        # Separate row u of all frames from row v: the same information matrix applies to both.
        slope = torch.where(use[..., None], slope, 0.0).transpose(-3, -2)
        error = error.mT
        information = inverse[..., None, None, :, :]
        weighted = information @ slope
        gram = (slope.mT @ weighted).sum(-3)
        towards = (weighted.mT @ error.unsqueeze(-1)).sum(-3).squeeze(-1)
        cost = (error * (information @ error.unsqueeze(-1)).squeeze(-1)).sum((-2, -1))
        prior, by_step = self._prior_error(cameras)
        gram = gram + by_step.mT @ by_step + self.precision
        away = cameras - self.reference
        pull = away @ self.precision
        towards = towards - (by_step.mT @ prior.unsqueeze(-1)).squeeze(-1) - pull
        cost = cost + prior.square().sum(-1) + (away * pull).sum(-1)
        # Limit steps along directions that hardly change the cost, such as the roll before any
        # motion.
        gram = gram + 1e-2 * torch.eye(SIZE).to(gram)
        return gram, towards, cost / 2 + self._roll_cost(cameras)


def _shortened(step: Float[Tensor, "*batch 13"]) -> Float[Tensor, "*batch 13"]:
    """A step, shortened to at most `_LONGEST_TURN` and `_LONGEST_MOVE`."""
    turn, move = step[..., ROTATION].norm(dim=-1), step[..., SHIFT].norm(dim=-1)
    factor = torch.maximum(turn / _LONGEST_TURN, move / _LONGEST_MOVE).clamp_min(1.0)
    return step / factor[..., None]
