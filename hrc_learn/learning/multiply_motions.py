"""Make many new motions of an arm from a few demonstrations, for scenes with moved objects.

Each demonstration is cut into segments where the gripper begins to move. A segment becomes a
pose primitive in one of three kinds of frames: an object's frame, a frame at the object with
the base's orientation, or the base frame. The frame is chosen in which the segment's final
poses agree best over the demonstrations. In a new scene, the primitives of all demonstrations
are averaged with random weights, and move with their frames. A segment begins with the final
pose and velocity of the previous segment. While the demonstrations still differ, a minimum-jerk
curve leads from this pose to the segment's own path.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hrc_learn.demos import Demonstration
from hrc_learn.dmp import PoseDMP
from hrc_learn.dmp.probabilistic_dmp import with_common_reference
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.kinematics import Arm
from hrc_learn.kinematics.inverse import follow_poses

BASE, POSITION_ONLY = "base", " position"
"""Name of the base frame, and suffix of the frame at an object's position with the orientation
of the base frame."""
# Smallest number of frames of a segment: fewer do not determine a primitive.
_SHORTEST = 6
# `_CONSTANT`: a gripper signal counts as constant if its range is at most this fraction of its
# largest value. `_MOVING`: the gripper moves while the change from frame to frame exceeds this
# fraction of the range.
_CONSTANT, _MOVING = 0.05, 0.02
# `_LEVER`: lever that converts angles to lengths [m/rad]. `_TREMOR`: difference between
# demonstrations that the tremor of a hand explains, and that is ignored [m].
_LEVER, _TREMOR = 0.1, 1e-3
# `_PER_FUNCTION`: frames per basis function. `_FEWEST`, `_MOST`: smallest and largest number of
# basis functions.
_PER_FUNCTION, _FEWEST, _MOST = 3, 8, 50
# `_COMPARED`: number of times at which demonstrations are compared. `_USUALLY_FREE`: result of
# `_free_fraction` if the demonstrations do not differ.
_COMPARED, _USUALLY_FREE = 50, 0.6
# Iterations of inverse kinematics from the initial posture to the first pose of a path.
_FIRST = 12
# `_REACHED`: largest error of inverse kinematics, 1 mm or 1 mrad. `_TURNED`: largest rotation
# from the wanted orientation [rad] for an arm of fewer than six joints.
_REACHED, _TURNED = 1e-3, 0.3
# `_USABLE`: largest speed of a motion, relative to the fastest speed within the arm's limits.
# `_SLOWER`: largest number of times that a motion beyond the limits is slowed down.
_USABLE, _SLOWER = 0.975, 5
# Largest factor by which one attempt slows a motion down.
_JUMP = 3.0
# `_ENDING`: see `MotionSource.ending`. `_AT_REST`: fraction of the largest speed that counts
# as rest.
_ENDING, _AT_REST = 0.25, 0.05
# Stride of the frames that are checked for collisions.
_CHECKED = 3


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """Segments of demonstrations; users may correct them in a file."""

    frames: tuple[str, ...]
    """Frame of each segment: "base", an object, or "OBJECT position" for the frame at the
    object's position with the orientation of the base frame."""
    cuts: dict[int, tuple[int, ...]]
    """Cuts by episode: first frame of each segment, then the last frame of the last segment."""

    def rows(self, demos: Sequence[Demonstration]) -> list[tuple[str, ...]]:
        """Table of the segments, with a header: frame of each segment, times by episode [s]."""
        header = ("segment", "frame", *(f"episode {demo.episode}" for demo in demos))
        rows: list[tuple[str, ...]] = [header]
        for k, frame in enumerate(self.frames):
            spans = [demo.time[list(self.cuts[demo.episode][k : k + 2])] for demo in demos]
            rows.append((str(k), frame, *(f"{a:.2f} .. {b:.2f} s" for a, b in spans)))
        return rows

    def check(self, demos: Sequence[Demonstration], objects: Mapping[str, Pose]) -> None:
        """Check that the segments fit the demonstrations.

        Raises:
            ValueError: The list of frames is empty, a frame or an episode is unknown, or cuts
                are too close or beyond the end of an episode.
        """
        for frame in self.frames or [""]:  # an empty list of frames fails, too
            if frame != BASE and frame.removesuffix(POSITION_ONLY) not in objects:
                known = ", ".join([BASE, *objects])
                raise ValueError(f"segments: no frame {frame!r}; there are {known}")
        for demo in demos:
            cuts, n = self.cuts.get(demo.episode, ()), len(self.frames) + 1
            spaced = len(cuts) == n and min(np.diff(cuts)) >= _SHORTEST
            if not spaced or cuts[0] < 0 or cuts[-1] >= len(demo):
                raise ValueError(
                    f"segments: episode {demo.episode} needs {n} cuts of 0 to {len(demo) - 1}, "
                    f"{_SHORTEST} frames or more apart, but has {list(cuts)}"
                )


def find_segments(
    demos: Sequence[Demonstration],
    objects: Mapping[str, Pose],
    tool: Sequence[Pose],
    departures: Sequence[Sequence[int]] = (),
) -> Segmentation:
    """Cut demonstrations where the gripper begins to open or close; choose coordinate frames.

    If an object begins to move after the gripper switches, the switch was a grasp. The arm may
    still approach the object while the gripper closes, so the demonstration is cut where the
    object begins to move.

    Args:
        demos: Demonstrations of one task.
        objects: Poses of each object at the start of each demonstration, (n).
        tool: Poses of the tool along each demonstration.
        departures: Numbers of the frames at which objects begin to move, by demonstration.

    Raises:
        ValueError: A demonstration is too short, or the demonstrations differ in the number of
            gripper switches.
    """
    openings = [demo.gripper for demo in demos if demo.gripper is not None] or [np.zeros(1)]
    low, high = min(x.min() for x in openings), max(x.max() for x in openings)
    cuts: dict[int, tuple[int, ...]] = {}
    for demo, begun in zip(demos, departures or [()] * len(demos), strict=True):
        last, kept = len(demo) - 1, [0]
        if last < _SHORTEST:
            raise ValueError(
                f"episode {demo.episode} has {len(demo)} frames, but a segment needs "
                f"{_SHORTEST + 1} or more: leave it out (multiply.demonstrations)"
            )
        switches = [] if demo.gripper is None else _switches(demo.gripper, low, high)
        ends = [end - _SHORTEST for end in (*switches[1:], last)]
        for k, end in enumerate(ends[: len(switches)]):
            switches[k] = min(
                (at for at in begun if switches[k] < at <= end), default=switches[k]
            )
        for cut in (*switches, last):
            if cut - kept[-1] >= _SHORTEST:
                kept.append(cut)
        kept[-1] = last
        cuts[demo.episode] = tuple(kept)
    counts = {episode: len(each) - 2 for episode, each in cuts.items()}
    if len(set(counts.values())) > 1:
        listed = ", ".join(f"episode {episode}: {n}" for episode, n in counts.items())
        raise ValueError(
            f"the demonstrations differ in the number of switches of the gripper ({listed}): "
            "leave episodes out, or correct the cuts in a file of segments"
        )
    frames = []
    for k in range(1, min(map(len, cuts.values()))):
        ends = [pose[cuts[demo.episode][k]] for demo, pose in zip(demos, tool, strict=True)]
        frames.append(_best_frame(Pose.stack(ends), objects))
    return Segmentation(frames=tuple(frames), cuts=cuts)


def _switches(values: Float[np.ndarray, " frames"], low: float, high: float) -> list[int]:
    """Frames at which the gripper begins to change between closed and open.

    Args:
        values: Opening of the gripper in one demonstration.
        low: Smallest opening in all demonstrations.
        high: Largest opening in all demonstrations.
    """
    if high - low <= _CONSTANT * max(abs(low), abs(high)):
        return []
    level = (values - low) / (high - low)
    moving = np.abs(np.diff(level, prepend=level[0])) > _MOVING
    begun = []
    for k in np.flatnonzero(np.diff(level > 0.5)).tolist():
        while k > 0 and moving[k]:
            k -= 1
        begun.append(k)
    return begun


def _best_frame(ends: Pose, objects: Mapping[str, Pose]) -> str:
    """Name of the frame in which a segment's final poses agree over the demonstrations.

    A frame counts as good if the spread of the poses in it is at most 1.5 times the least
    spread, plus the tremor. Of all good frames, the nearest is chosen.
    """
    names = [*objects, *(f"{name}{POSITION_ONLY}" for name in objects), BASE]
    spread: dict[str, float] = {}
    distance: dict[str, float] = {}
    for name in names:
        local = frame_of(objects, name, ends).inverse() @ ends
        middle = Pose(local.position.mean(0), quaternion.mean(local.orientation))
        apart = middle.twist_to(local).square().mean(0)
        spread[name] = float((apart[:3].sum() + _LEVER**2 * apart[3:].sum()).sqrt())
        distance[name] = math.inf if name == BASE else float(local.position.norm(dim=-1).mean())
    good = [name for name in names if spread[name] <= 1.5 * min(spread.values()) + _TREMOR]
    # If two frames are equally near, an object's own frame precedes its position-only frame.
    return min(good, key=lambda name: round(distance[name], 6))


def frame_of(objects: Mapping[str, Pose], name: str, like: Pose) -> Pose:
    """Poses of the frame `name` in the base frame.

    For the base frame itself, these are as many identity poses as `like` has poses.
    """
    still = torch.zeros_like(like.orientation)
    still[..., 0] = 1.0
    if name == BASE:
        return Pose(torch.zeros_like(like.position), still)
    pose = objects[name.removesuffix(POSITION_ONLY)]
    return Pose(pose.position, still) if name.endswith(POSITION_ONLY) else pose


@dataclass(frozen=True, kw_only=True, eq=False)
class Draws:
    """Random choices of B new motions."""

    scene: Mapping[str, Pose]
    """Pose of each object, (B)."""
    weights: Float[Tensor, "B n"]
    """Weights of the demonstrations in each motion, which add up to one."""
    speed: Float[Tensor, "B"]
    """Speed relative to the demonstrations."""
    start: Float[Tensor, "B 3"]
    """Displacement of the tool's initial position [m]."""

    def __getitem__(self, index: Tensor) -> Draws:
        """Choices for the motions with these indices."""
        scene = {name: pose[index] for name, pose in self.scene.items()}
        rest = {name: getattr(self, name)[index] for name in ("weights", "speed", "start")}
        return Draws(scene=scene, **rest)


@dataclass(frozen=True, kw_only=True, eq=False)
class NewMotion:
    """One motion of an arm."""

    joints: Float[Tensor, "T joints"]
    """Joint positions [rad]."""
    phase: Float[Tensor, "T"]
    """For each frame of the motion, the corresponding fractional frame of the main
    demonstration."""
    source: int
    """Index of the main demonstration, the one with the largest weight."""
    reason: str
    """Reason why the motion is impossible; empty if it is possible."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Poses:
    """B motions of the tool, padded with their last sample."""

    pose: Pose
    """Poses in the base frame, (B, T)."""
    body: Float[Tensor, "B T joints"] | None
    """Joint positions of the demonstrated posture [rad]; None if another arm was
    demonstrated."""
    phase: Float[Tensor, "B T"]
    """Fractional frame of the main demonstration (see `NewMotion`)."""
    length: Int[Tensor, "B"]
    """Number of samples of each motion, without the padding."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Segment:
    """The same segment of all demonstrations, given in the segment's frame."""

    frame: str
    dmp: PoseDMP
    """Primitives (n). If the same arm was demonstrated, its joint positions are the body
    coordinates of the primitives (see `PoseDMP`)."""
    first: Float[Tensor, "n"]
    last: Float[Tensor, "n"]

    def span(self, main: Int[Tensor, "B"]) -> Float[Tensor, "2 B 1"]:
        """First frame of the segment and number of frames after it, by main demonstration."""
        return torch.stack([self.first, self.last - self.first])[:, main, None]

    def mixed(self, weights: Float[Tensor, "B n"], speed: Float[Tensor, "B"]) -> PoseDMP:
        """Primitives with weighted means of the coordinates and durations."""
        motion = self.dmp.motion
        x = torch.einsum("bn,ndm->bdm", weights, motion.coordinates().detach())
        mixed = motion.with_coordinates(
            x,
            (weights @ motion.duration) / speed,
            amplitude=weights @ motion.amplitude,
            timestamps=torch.linspace(0, 1, 2).to(motion.timestamps),
        )
        return self.dmp.with_motion(mixed, self.dmp.reference[:1].expand(len(x), 4))


def _turned(frame: Pose, twist: Float[Tensor, "B 6"]) -> Float[Tensor, "B 6"]:
    """Rotate a twist from the axes of a frame to the axes of the frame's parent."""
    parts = twist.unflatten(-1, (2, 3))
    return quaternion.rotate(frame.orientation[:, None], parts).flatten(-2)


def _stopped(s: Float[Tensor, "B T"], part: float) -> Float[Tensor, "B T"]:
    """Progress of a motion of unit duration that comes to rest in its last part.

    Because of the stop, this part takes twice as long. Within the part, while u goes from 0 to
    1, the progress is 2 u - 2 u^3 + u^4, whose acceleration is zero at both ends.
    """
    u = ((s - 1 + part) / (2 * part)).clamp(0, 1)
    return torch.where(u > 0, 1 - part + part * (2 * u - 2 * u**3 + u**4), s)


@torch.no_grad()
def _free_fraction(dmp: PoseDMP) -> float:
    """Fraction of a segment after which the demonstrations agree in its frame.

    Before this point, the demonstrations come from different positions, so a new motion may
    come from yet another position.
    """
    s = torch.linspace(0, 1, _COMPARED, dtype=torch.float64)
    position = dmp.rollout(s * dmp.duration[:, None]).position
    spread = (position - position.mean(0)).square().sum(-1).mean(0).sqrt()
    apart = spread > torch.maximum(spread[-1], 0.05 * spread[0]) + _TREMOR
    if not bool(apart.any()):
        return _USUALLY_FREE
    return min(max(float(s[apart.nonzero().max()]), 0.2), 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionSource:
    """Demonstrations as object-centred primitives, from which new motions are made."""

    robot: Arm
    fps: float
    start: Pose
    """First pose of the tool in each demonstration, (n)."""
    near: Float[Tensor, "n joints"]
    """Joint positions near the first pose [rad]."""
    segments: tuple[_Segment, ...] = field(repr=False)
    obstacles: Float[Tensor, "boxes 6"]
    """Boxes to avoid: centre and half edges [m]."""
    ending: float = 0.0
    """Last fraction of the last segment in which a motion comes to rest; 0: the demonstrations
    already end at rest."""

    @classmethod
    def fit(
        cls,
        demos: Sequence[Demonstration],
        tool: Sequence[Pose],
        objects: Mapping[str, Pose],
        segmentation: Segmentation,
        robot: Arm,
        near: Sequence[Float[Tensor, "frames joints"]] | Float[Tensor, "postures joints"],
        obstacles: Float[Tensor, "boxes 6"] | None = None,
    ) -> MotionSource:
        """Fit the primitives.

        Args:
            demos: Demonstrations of one task.
            tool: Poses of the tool along each demonstration.
            objects: Poses of each object at the start of each demonstration, (n).
            segmentation: Segments and their frames.
            robot: Arm of the new motions.
            near: Joint positions along each demonstration [rad] if `robot` was demonstrated:
                the new motions keep the demonstrated posture. Otherwise, candidate postures at
                the first pose [rad]. The arm starts with the posture from which it reaches most
                frames of the first demonstration, preferably without a collision.
            obstacles: Boxes to avoid: centre and half edges [m].

        Raises:
            ValueError: The segmentation does not fit the demonstrations.
        """
        segmentation.check(demos, objects)
        segments = []
        fixed = isinstance(near, Tensor)
        for k, frame in enumerate(segmentation.frames):
            spans = [segmentation.cuts[demo.episode][k : k + 2] for demo in demos]
            parts = [slice(first, last + 1) for first, last in spans]
            local = []
            for i, (whole, part) in enumerate(zip(tool, parts, strict=True)):
                scene = {name: pose[i] for name, pose in objects.items()}
                local.append(frame_of(scene, frame, whole[0]).inverse() @ whole[part])
            times = [torch.from_numpy(d.time[p]) for d, p in zip(demos, parts, strict=True)]
            body = None if fixed else [q[p] for q, p in zip(near, parts, strict=True)]
            shown = times, [p.position for p in local], [p.orientation for p in local]
            count = min(last - first for first, last in spans) // _PER_FUNCTION
            options: Any = {"n_basis": min(max(count, _FEWEST), _MOST), "smooth": True}
            dmp = PoseDMP.fit(*shown, **options)
            dmp = PoseDMP.fit(*shown, body=body, approach=_free_fraction(dmp), **options)
            first, last = torch.tensor(spans, dtype=torch.float64).unbind(-1)
            segments.append(
                _Segment(frame=frame, dmp=with_common_reference(dmp), first=first, last=last)
            )
        # A recording that was cut off ends while the tool moves.
        speeds = [pose.position.diff(dim=0).norm(dim=-1) for pose in tool]
        cut_off = any(bool(v[-2:].min() > _AT_REST * v.max()) for v in speeds)
        obstacles = torch.zeros(0, 6).double() if obstacles is None else obstacles
        if fixed:
            q, error = _followed(robot, tool[0][:, None], near)
            hits = _collisions(robot, obstacles, q.transpose(0, 1))
            faults = [*zip((error > _REACHED).sum(0).tolist(), map(bool, hits), strict=True)]
            posture = near[faults.index(min(faults))].expand(len(demos), -1)
        else:
            posture = torch.stack([q[0] for q in near])
        return cls(
            robot=robot,
            fps=float(demos[0].fps),
            start=Pose.stack([pose[0] for pose in tool]),
            near=posture,
            segments=tuple(segments),
            obstacles=obstacles,
            ending=_ENDING if cut_off else 0.0,
        )

    @torch.no_grad()
    def motions(self, draws: Draws) -> list[NewMotion]:
        """Motions in new scenes, slowed down to the limits of the arm, and checked."""
        made: dict[int, NewMotion] = {}
        left = torch.arange(len(draws.speed))
        for turn in range(_SLOWER + 1):
            part = draws[left]
            poses = self.poses(part)
            q, missed = self._joint_paths(part, poses)
            factor, limit = self.robot.limits.excess(q, 1 / self.fps)
            factor = (factor / _USABLE).clamp(max=_JUMP)
            # If a motion does not reach its poses, its joints may jump at any speed. Such a
            # motion is slowed down and retried only once.
            again = (factor > 1) & (turn < _SLOWER) & ((missed == 0) | (turn == 0))
            where = _collisions(self.robot, self.obstacles, q[~again])
            for k in (~again).nonzero()[:, 0].tolist():
                hit, reason = where.pop(0), ""
                if missed[k] > 0:
                    reason = "not reached within the ranges of the joints"
                elif factor[k] > 1:
                    kind, joint = divmod(int(limit[k]), self.robot.joints)
                    kind = ("velocity", "acceleration", "jerk")[kind]
                    reason = f"beyond the limit of {kind} of {self.robot.joint_names[joint]}"
                n = int(poses.length[k])
                made[int(left[k])] = NewMotion(
                    joints=q[k, :n],
                    phase=poses.phase[k, :n],
                    source=int(part.weights[k].argmax()),
                    reason=reason or hit,
                )
            left = left[again]
            draws = replace(draws, speed=draws.speed.clone())
            draws.speed[left] /= 1.02 * factor[again]
            if not len(left):
                break
        return [made[k] for k in sorted(made)]

    def poses(self, draws: Draws) -> _Poses:
        """Poses of the tool in new scenes, differentiable with respect to the scene."""
        main = draws.weights.argmax(-1)
        start = Pose(
            draws.weights @ self.start.position + draws.start, self.start[main].orientation
        )
        mixed = [segment.mixed(draws.weights, draws.speed) for segment in self.segments]
        total = torch.stack([dmp.duration for dmp in mixed]).sum(0)
        total = total + self.ending * mixed[-1].duration
        length = (total * self.fps - 1e-9).ceil().long() + 1
        ticks = torch.arange(int(length.max()), dtype=torch.float64) / self.fps
        begin, twist = torch.zeros_like(total), torch.zeros(len(total), 6).double()
        ends: dict[str, Any] = {}
        columns: list[Tensor] = []
        for segment, dmp in zip(self.segments, mixed, strict=True):
            frame, tau = frame_of(draws.scene, segment.frame, start), dmp.duration[:, None]
            velocity = _turned(frame.inverse(), twist)
            ends |= {"start": frame.inverse() @ start, "start_velocity": velocity}
            clock = (ticks - begin[:, None]).clamp(min=0)
            if dmp is mixed[-1] and self.ending:
                clock = tau * _stopped(clock / tau, self.ending)
            clock = torch.minimum(clock, tau)
            path, last = dmp.rollout(clock, **ends), dmp.rollout(tau, **ends)
            poses, (first, span) = frame[:, None] @ path.pose, segment.span(main)
            new = [poses.position, poses.orientation, path.body, first + span * clock / tau]
            begun = ticks >= begin[:, None]
            if columns:
                new = [
                    torch.where(begun if x.ndim == 2 else begun[..., None], x, old)
                    for x, old in zip(new, columns, strict=True)
                ]
            columns, begin = new, begin + dmp.duration
            start, twist = frame @ last.pose[:, 0], _turned(frame, last.twist[:, 0])
            ends = {"start_body": last.body[:, 0]}
        position, orientation, body, phase = columns
        poses = Pose(position, orientation)
        carried = body if body.shape[-1] else None
        return _Poses(pose=poses, body=carried, phase=phase, length=length)

    def _joint_paths(
        self, draws: Draws, poses: _Poses
    ) -> tuple[Float[Tensor, "B T joints"], Float[Tensor, "B"]]:
        """Joint positions along the poses [rad], and the largest error of each motion.

        The joints stay near the demonstrated posture. An error of at most `_REACHED` is
        returned as 0.
        """
        order = torch.arange(-_FIRST, poses.phase.shape[1]).clamp(min=0)
        path, wish, start = poses.pose[:, order], None, self.near[draws.weights.argmax(-1)]
        if poses.body is not None:
            wish, start = poses.body[:, order].transpose(0, 1), poses.body[:, 0]
        path = Pose(path.position.transpose(0, 1), path.orientation.transpose(0, 1))
        q, error = (
            x[_FIRST:].transpose(0, 1) for x in _followed(self.robot, path, start, wish)
        )
        inside = torch.arange(q.shape[1]) < poses.length[:, None]
        last = q[torch.arange(len(q)), poses.length - 1]
        worst = torch.where(inside, error, 0.0).amax(-1)
        q = torch.where(inside[..., None], q, last[:, None])
        return q, torch.where(worst > _REACHED, worst, 0.0)


def _followed(
    robot: Arm, path: Pose, start: Float[Tensor, "*rows joints"], wish: Tensor | None = None
) -> tuple[Float[Tensor, "T *rows joints"], Float[Tensor, "T *rows"]]:
    """Joint positions along poses [rad], and errors [m or rad], as `follow_poses` returns them.

    For an arm of fewer than six joints, the error is that of the position alone as long as the
    error of the orientation is below `_TURNED`.
    """
    q, error = follow_poses(robot, path, start, wish)
    if robot.joints < 6:
        left = robot.forward(q).twist_to(path).unflatten(-1, (2, 3)).norm(dim=-1)
        error = torch.where(left[..., 1] < _TURNED, left[..., 0], left[..., 1])
    return q, error


def _collisions(
    robot: Arm, obstacles: Float[Tensor, "boxes 6"], q: Float[Tensor, "B T joints"]
) -> list[str]:
    """Collision of each motion with the arm itself or with a box, in words; empty if none."""
    q, (centre, half) = q[:, ::_CHECKED], obstacles.split(3, dim=-1)
    frames = robot.link_frames(q)
    hit = (robot.whole.self_distance(q, frames) < 0).any(-1)
    reasons = ["collides with the arm itself" if each else "" for each in hit.tolist()]
    if len(centre) and len(q):
        near = robot.body.box_distance(q, centre, half, frames).amin(-1) < 0
        for k in near.nonzero()[:, 0].tolist():
            reasons[k] = reasons[k] or "collides with an obstacle"
    return reasons
