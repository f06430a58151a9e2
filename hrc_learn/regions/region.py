"""Regions of task space (box, cones, ellipse in the image) and of joint space.

Labels such as (CaFun) name equations of the paper by Yan et al.; see `docs/concepts/paper.md`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal, final

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.geometry import quaternion
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.pytree import pytree, static


class Region(ABC):
    """A region f(x) <= 0 of some space, and a potential energy P(x) that attracts or repels x.

    The controller moves against the regional feedback xi = dP/dx, which has a closed form.
    Methods are pure and batched: the leading dimensions of `x` and of the region's tensors
    broadcast.
    """

    def __post_init__(self) -> None:
        if not torch.compiler.is_compiling():
            check_settings(self)

    @abstractmethod
    def value(self, x: Float[Tensor, "*batch n"]) -> Tensor:
        """Region function f, a scalar or a value per component of x.

        It is at most zero inside the region; for `JointRegion`, it is at least zero inside.
        """

    @abstractmethod
    def feedback(
        self, x: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both m"]]:
        """Potential P (*both,) and its gradient (*both, m); m = 3 for orientations, else n."""

    @final
    def potential(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both"]:
        """Potential energy P."""
        return self.feedback(x)[0]

    @final
    def gradient(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both m"]:
        """Regional feedback xi = dP/dx."""
        return self.feedback(x)[1]


# Value of f at twice the half size. Where f is larger, the pull of the saturated form grows
# linearly with the distance.
_FAR_OUT = 3.0


@pytree
class PositionRegion(Region):
    """Box with smooth walls; its potential is zero inside.

    f_i = ((r_i - c_i) / h_i)^2 - 1                                      (CaFun)
    P   = sum_i k_c/2 max(0, f_i)^2                                      (CaPeFun)

    with position r, centre c and half size h. k_c has the unit of P. The requested speed
    2 k_c f (r - c)/h^2 grows as the box shrinks. Near a wall, the distance past the wall decays
    at the rate 4 k_c/h^2 [1/s].

    Far from a small box, the pull of P grows with the cube of the distance. The axis with the
    largest offset then dominates, and a cap on the twist leaves almost nothing for rotation.
    `formulation="saturated"` has the same potential up to twice the half size, f = 3. Beyond,
    its pull grows linearly, so the tool moves straight to the box:

    P = sum_i k_c 3 (f_i - 3/2),   f_i > 3
    """

    centre: Float[Tensor, "*#batch 3"]
    """Centre of the box [m]."""
    half_size: Float[Tensor, "*#batch 3"]
    """Half edges of the box, all positive, along the base axes [m]."""
    stiffness: float | tuple[float, float, float] = static(4e-3)
    """k_c, one value for all axes or one for each axis of the box. Table I of the paper has
    4e-4 for x and y; for a half size of 0.12 m, the time constant near a wall is then 9 s."""
    formulation: Literal["paper", "saturated"] = static("paper")

    def value(self, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*both 3"]:
        """Region function f of each pair of walls at the position x [m]."""
        scaled = (x - self.centre) / self.half_size
        return scaled * scaled - 1

    def feedback(
        self, x: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both 3"]]:
        """Potential and its gradient with respect to the position, in the base frame."""
        scaled = (x - self.centre) / self.half_size
        f = (scaled * scaled - 1).clamp(min=0)
        k_c = self.stiffness
        # One value for each axis of the box, or one value for all axes.
        k_c = f.new_tensor(k_c) if isinstance(k_c, tuple) else k_c
        if self.formulation == "saturated":
            near = f.clamp(max=_FAR_OUT)
            pull = k_c * near
            P = (pull * (f - 0.5 * near)).sum(-1)
        else:
            pull = k_c * f
            P = 0.5 * (pull * f).sum(-1)
        return P, 2 * pull * scaled / self.half_size


# Error vectors sin(phi/2) n shorter than this are rounding noise. They occur only at the goal,
# inside the cone, where the gradient is zero.
_SHORTEST_AXIS = 1e-12


@dataclass(frozen=True, kw_only=True)
class _Cone(Region):
    """All orientations whose angle phi to the goal is below a tolerance.

    f = alpha_o phi / 2 - 1
    P = k_o/2 max(0, f)^2
    """

    goal: Float[Tensor, "*#batch 4"]
    """Goal orientation, a unit quaternion (w, x, y, z) of either sign."""
    sharpness: float = static(15.0)
    """alpha_o, two divided by the tolerated angle [1/rad]."""
    stiffness: float = static(0.02)
    """k_o."""

    @property
    def tolerance(self) -> float:
        """Half opening angle of the cone [rad]."""
        return 2 / self.sharpness

    def value(self, x: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*both"]:
        """Region function f at the orientation x (a unit quaternion)."""
        _, sine, cosine = self._half_angle(x)
        return self.sharpness * torch.atan2(sine, cosine).squeeze(-1) - 1

    @abstractmethod
    def _half_angle(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Three tensors: sin(phi/2) n with the axis n of the error, sin(phi/2), cos(phi/2)."""

    def _potential_and_slope(self, sine: Tensor, cosine: Tensor) -> tuple[Tensor, Tensor]:
        """Potential P, and the quotient of dP/dphi and sin(phi/2)."""
        f = (self.sharpness * torch.atan2(sine, cosine) - 1).clamp(min=0)
        P = (0.5 * self.stiffness) * (f * f).squeeze(-1)
        # Divided by the sine, because the vector part of the error is sin(phi/2) n.
        slope = (0.5 * self.stiffness * self.sharpness) * f / sine.clamp(min=_SHORTEST_AXIS)
        return P, slope


@pytree
class OrientationRegion(_Cone):
    """All orientations p within an angle of the goal p_g; P is zero inside.

    f = alpha_o |log(p * p_g^-1)| - 1                                    (OrtRegion)
    P = k_o/2 max(0, f)^2                                                (OrtFun1)

    The norm of the quaternion logarithm is *half* the rotation angle phi, so the cone is
    phi <= 2/alpha_o: 7.6 degrees for alpha_o = 15. The error has the sign of the shortest
    rotation, so p and -p are the same orientation.

    The gradient suits the geometric Jacobian: it is the derivative of P with respect to a small
    rotation of the end effector about the base axes. It equals k_o max(0, f) (alpha_o/2) n with
    the axis n of the error. With `formulation="paper"`, it is alpha_o k_o max(0, f) phi n, as
    printed in the paper (orient_diff_potential). The direction is the same, and the length is
    2 phi times as large.

    With `coordinates="rotation_vector"` the gradient suits the analytic Jacobian: it is the
    derivative of P with respect to the rotation vector of x. It equals J_l^T times the gradient
    above, with the left Jacobian J_l of rotations. With `formulation="paper"`, the gradient is
    twice as large. It then equals the product of the printed derivatives (PartialV2Quat) and
    (JacobianQuatAngAxisDetailed) wherever their divisions by components of quaternions are
    defined.
    """

    formulation: Literal["exact", "paper"] = static("exact")
    coordinates: Literal["rotation", "rotation_vector"] = static("rotation")

    def feedback(
        self, x: Float[Tensor, "*batch 4"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both 3"]]:
        """Potential of shape (*both,) and its gradient (*both, 3) [1/rad]."""
        axis, sine, cosine = self._half_angle(x)
        P, slope = self._potential_and_slope(sine, cosine)
        over_vector = self.coordinates == "rotation_vector"
        if self.formulation == "paper":
            # The printed chain over the rotation vector is twice the derivative.
            slope = slope * (2 if over_vector else 4 * torch.atan2(sine, cosine))
        gradient = slope * axis
        if not over_vector:
            return P, gradient
        r = quaternion.log(x).expand_as(gradient)
        return P, quaternion.drift_free_rate(r, gradient)

    def _half_angle(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        # The error p * p_g^-1 with the sign of the shortest rotation.
        error = quaternion.canonical(quaternion.multiply(x, quaternion.conjugate(self.goal)))
        vector = error[..., 1:]
        sine = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
        return vector, sine, error[..., :1]


@pytree
class AxisRegion(_Cone):
    """All orientations whose z axis is within an angle of the goal's z axis; the rotation
    about z is free.

    f and P are those of `OrientationRegion` for the angle phi between both axes. The gradient
    is the derivative of P with respect to a small rotation of the end effector about the base
    axes. It is perpendicular to both z axes, so it requests no rotation about them. If the
    two z axes are opposite, the gradient lies along the axis of the rotation from goal to x.
    """

    def feedback(
        self, x: Float[Tensor, "*batch 4"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both 3"]]:
        """Potential of shape (*both,) and its gradient (*both, 3) [1/rad]."""
        swing, sine, cosine = self._half_angle(x)
        P, slope = self._potential_and_slope(sine, cosine)
        return P, slope * quaternion.rotate(self.goal, swing)

    def _half_angle(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """sin(phi/2) n in the goal's frame, sin(phi/2) and cos(phi/2).

        The rotation from goal to x is a rotation about z, followed by a rotation by phi about
        n, which is perpendicular to z (swing-twist decomposition).
        """
        error = quaternion.multiply(quaternion.conjugate(self.goal), x)
        w, i, j, k = error.split(1, dim=-1)
        sine = torch.linalg.vector_norm(error[..., 1:3], dim=-1, keepdim=True)
        cosine = torch.linalg.vector_norm(torch.cat([w, k], dim=-1), dim=-1, keepdim=True)
        # After half a turn of the axis, the rotation about z is arbitrary: choose none.
        half_turn = cosine < _SHORTEST_AXIS
        length = torch.where(half_turn, 1.0, cosine)
        c, s = torch.where(half_turn, 1.0, w / length), torch.where(half_turn, 0.0, k / length)
        swing = torch.cat([c * i - s * j, c * j + s * i, torch.zeros_like(i)], dim=-1)
        return swing, sine, cosine


# Normalised distance at which the pull of the saturated form levels off.
_SATURATION = 0.5


@pytree
class VisionRegion(Region):
    """Ellipse about the target in the image; its potential is minimal at the target.

    f = ((u - u_d) / b_1)^2 + ((v - v_d) / b_2)^2 - 1                    (eq_vision_re_func)
    P = k_v/2 (1 - min(0, f)^2)                                          (eq_vision_p)

    The pull, the gradient of P, is zero at the target and at the edge of the ellipse, and
    therefore weak near both. `formulation="saturated"` has the same pull close to the target
    and a nearly constant pull further out, anywhere in the image:

    P = 2 k_v s^2 (sqrt(1 + rho^2/s^2) - 1),   rho^2 = f + 1,   s = 1/2

    A feature of several points, such as the corners of a marker, has an ellipse about each
    point, and its potential is the mean over the points.
    """

    target: Float[Tensor, "*#batch rows"]
    """Desired feature position (u, v) [px]; for several points (u_1, v_1, u_2, v_2, ...)."""
    half_size: Float[Tensor, "*#batch rows"]
    """Half axes b_1, b_2 of the ellipse, positive [px]; the ellipse should be in the image."""
    stiffness: float = static(0.3)
    """k_v."""
    formulation: Literal["paper", "saturated"] = static("paper")

    @classmethod
    def inside_image(
        cls, target: Float[Tensor, "*batch rows"], image_size: tuple[int, int]
    ) -> VisionRegion:
        """Largest ellipse around the target that stays inside the image.

        Args:
            target: Desired feature position (u, v) [px].
            image_size: Width and height of the image [px].

        Raises:
            ValueError: The target is not inside the image.
        """
        # Pixels are numbered from 0 to the size minus one.
        far_edge = target.new_tensor(image_size).repeat(target.shape[-1] // 2) - 1
        half_size = torch.minimum(target, far_edge - target)
        if not bool((half_size > 0).all()):
            text = f"the vision target must lie inside the image of {image_size[0]} x"
            raise ValueError(f"{text} {image_size[1]} px, but is {target.tolist()}")
        return cls(target=target, half_size=half_size)

    def value(self, x: Float[Tensor, "*batch rows"]) -> Float[Tensor, "*both"]:
        """Region function f at the feature position x [px]; the largest of several points."""
        scaled = (x - self.target) / self.half_size
        return (scaled * scaled).unflatten(-1, (-1, 2)).sum(-1).amax(-1) - 1

    def feedback(
        self, x: Float[Tensor, "*batch rows"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both rows"]]:
        """Potential and its gradient with respect to x [1/px]; means over the points."""
        scaled = ((x - self.target) / self.half_size).unflatten(-1, (-1, 2))
        square, k_v = (scaled * scaled).sum(-1, keepdim=True), self.stiffness
        if self.formulation == "saturated":
            root = torch.sqrt(1 + square / _SATURATION**2)
            P, slope = (2 * k_v * _SATURATION**2) * (root - 1), 2 * k_v / root
        else:
            f = (square - 1).clamp(max=0)
            P, slope = (0.5 * k_v) * (1 - f * f), (-2 * k_v) * f
        points = scaled.shape[-2]
        return P.squeeze(-1).mean(-1), (slope * scaled).flatten(-2) / (points * self.half_size)


@pytree
class JointRegion(Region):
    """Range of the joints; repels each joint from the nearer of its limits.

    With the distance delta_i to the nearer limit, negative past the limit:

        f_i = delta_i - margin,   f_ri = delta_i - reference_margin
        P   = sum_i k_q/2 min(0, f_i)^2 + k_r/2 min(0, f_ri)^2           (jointxp)

    With `formulation="paper"`, f_i = delta_i^2 - margin^2, as in Table I of the paper. The push
    then vanishes at the limit and points outwards past the limit, because the square loses the
    sign of delta_i.
    """

    centre: Float[Tensor, "*#batch n"]
    """Middle of the joint range [rad]."""
    half_range: Float[Tensor, "*#batch n"]
    """Half of the joint range [rad]."""
    margin: float = static(0.1)
    """Distance from the limit at which the steep repulsion starts [rad]."""
    reference_margin: float = static(0.3)
    """Distance from the limit at which the weak repulsion (reference region) starts [rad]."""
    stiffness: float = static(10.0)
    """k_q."""
    reference_stiffness: float = static(1.0)
    """k_r."""
    formulation: Literal["one_sided", "paper"] = static("one_sided")

    @classmethod
    def from_limits(
        cls, lower: Float[Tensor, "*batch n"], upper: Float[Tensor, "*batch n"], **options
    ) -> JointRegion:
        """Region between joint limits [rad]; `options` are the remaining fields."""
        return cls(centre=(lower + upper) / 2, half_range=(upper - lower) / 2, **options)

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both n"]:
        """Region function f_i of every joint, at least zero inside [rad] ("paper": [rad^2])."""
        return self._depths(self.half_range - (x - self.centre).abs())[0]

    def feedback(
        self, x: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both m"]]:
        """Potential and its gradient with respect to the joint positions."""
        offset = x - self.centre
        distance = self.half_range - offset.abs()
        f, f_reference = (depth.clamp(max=0) for depth in self._depths(distance))
        pull, pull_reference = self.stiffness * f, self.reference_stiffness * f_reference
        P = 0.5 * (pull * f + pull_reference * f_reference).sum(-1)
        slope = pull + pull_reference  # dP/d delta, at most zero
        if self.formulation == "paper":
            slope = slope * (2 * distance)
        # The distance to the nearer limit decreases away from the centre, on both sides.
        return P, -torch.sign(offset) * slope

    def _depths(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Region functions f and f_r from the distance to the nearer limit [rad]."""
        if self.formulation == "paper":
            square = distance * distance
            return square - self.margin**2, square - self.reference_margin**2
        return distance - self.margin, distance - self.reference_margin


@pytree
class PostureRegion(Region):
    """Ball about a posture; attracts the joints, with a pull that saturates with the distance.

    f = |q - q_g| / tolerance - 1
    P = k s^2 (sqrt(1 + |q - q_g|^2/s^2) - 1)

    Between two admissible postures, a joint-space approach meets neither singularities nor
    joint limits; a straight line of the tool may meet both.
    """

    goal: Float[Tensor, "*#batch n"]
    """Goal posture within the joint limits [rad]."""
    tolerance: float = static(0.5)
    """Radius of the region [rad], inside which task-space feedback may take over."""
    stiffness: float = static(2.0)
    """k, convergence rate close to the goal [1/s]."""
    saturation: float = static(0.75)
    """s, distance at which the pull saturates [rad]; the largest pull is k s [rad/s]."""

    def value(self, x: Float[Tensor, "*batch n"]) -> Float[Tensor, "*both"]:
        """Region function f at the joint position x [rad]."""
        return torch.linalg.vector_norm(x - self.goal, dim=-1) / self.tolerance - 1

    def feedback(
        self, x: Float[Tensor, "*batch n"]
    ) -> tuple[Float[Tensor, "*both"], Float[Tensor, "*both m"]]:
        """Potential and its gradient with respect to the joint positions."""
        offset = x - self.goal
        square = torch.linalg.vecdot(offset, offset).unsqueeze(-1)
        root = torch.sqrt(1 + square / self.saturation**2)
        P = (self.stiffness * self.saturation**2) * (root.squeeze(-1) - 1)
        return P, self.stiffness / root * offset
