"""What a person who pulls at the elbow at any moment of a job does to the motion.

In motions and while the end effector is held, its path is known, and so is how far it was off
it. Visual servoing has no path: there the offset of the hand from the object tells.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.experiments.path_distance import path_distance
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import SINGULAR_BELOW, SerialChain
from hrc_learn.log import LoggedSteps
from hrc_learn.teleoperation import ScriptedForce

type Clearance = Callable[[Float[torch.Tensor, "*batch joints"]], Float[torch.Tensor, "*batch"]]
"""Distance of an arm at given joint positions [rad] from what is around it [m]."""

_STEP, _STEP_JOINTS, _MOST_STEPS = 0.005, 0.05, 300
"""Of a self-motion that is followed [m, rad], and how many at most."""
_STILL = 5e-4
"""Motion of the elbow by a pull, per force, from which on it goes no further [m/s/N]: a few per
cent of that of an elbow that is free."""
_NEAR_LIMIT, _NEAR = 0.1, 0.03
"""Where the room for a pull ends: a joint so near its limit, the arm so near what is around it
[rad, m]."""
_ELBOW = 3
"""Joint at the elbow, from 0."""
_AFTER = 1.0
"""How long a pull counts on after its end [s]: while the arm goes back."""


@dataclass(frozen=True, kw_only=True)
class PullEffect:
    """What one pull did in one phase of the task."""

    phase: str
    pull: ScriptedForce
    elbow: float
    """How far the elbow was moved aside, at most [m]."""
    room: float
    """How far it could be moved where the pull began there (`elbow_room`) [m]."""
    hand: float
    """How far the end effector was off its path, at most [m]; NaN where it had none."""


def pull_effects(
    log: LoggedSteps,
    pulls: Sequence[ScriptedForce],
    chain: SerialChain,
    encoder_offset: Float[np.ndarray, " joints"] | None = None,
    clearance: Clearance | None = None,
) -> list[PullEffect]:
    """Effects of the pulls of a run, one for each phase that a pull reaches into.

    Args:
        log: Of a work cell.
        pulls: In the time of the log [s].
        chain: The arm.
        encoder_offset: What its encoders read too much, constantly [rad]: then distances are
            true ones, also where an arm pushed aside takes other joints for the same pose.
            None: they are what the encoders say.
        clearance: Distance of an arm from what is around it [m]; None: nothing is.
    """
    time, joints = log["time"], torch.from_numpy(log["joint_position"])
    hand = chain.forward(joints).position.numpy()
    if encoder_offset is not None:
        hand = hand + _moved_unseen(chain, log, torch.from_numpy(encoder_offset))
    off_path = path_distance(hand, log["goal_position"], time)
    effects = []
    for phase, begin, end in _phases(log):
        for pull in pulls:
            rows = (time >= max(pull.start, begin)) & (time < min(pull.end + _AFTER, end))
            if not (rows & (time < pull.end)).any():
                continue
            during = torch.from_numpy(rows)
            planned = torch.from_numpy(log["path_joints"])[during]
            seen = off_path[rows][np.isfinite(off_path[rows])]
            effects.append(
                PullEffect(
                    phase=phase,
                    pull=pull,
                    elbow=float(_elbow_moved(chain, joints[during], planned).max()),
                    room=elbow_room(joints[during][0], pull, chain, clearance),
                    hand=float(seen.max()) if len(seen) else math.nan,
                )
            )
    return effects


def elbow_room(
    joint_position: Float[torch.Tensor, " joints"],
    pull: ScriptedForce,
    chain: SerialChain,
    clearance: Clearance | None = None,
) -> float:
    """How far a pull can move the elbow of an arm whose end effector stays [m].

    Along the self-motion of the arm, as far as the pull goes with it: until a joint is near its
    limit, the arm near what is around it, or near a singularity.

    Args:
        joint_position: Where the pull begins [rad].
        pull: Where to.
        chain: The arm.
        clearance: Distance of an arm from what is around it [m]; None: nothing is.
    """
    q, limits = joint_position, chain.limits
    pose, first = chain.forward(q), chain.joint_origins(q)[_ELBOW]
    furthest, time = 0.0, (pull.start + pull.end) / 2
    for _ in range(_MOST_STEPS):
        elbow = chain.joint_origins(q)[_ELBOW]
        furthest = max(furthest, float((elbow - first).norm()))
        J, J_elbow = chain.jacobian(q), chain.joint_jacobian(q, pull.joint)[:3]
        force = torch.from_numpy(pull.force(time, elbow.numpy()))
        along = null_projection(J, J_elbow.mT @ force)
        speed = float((J_elbow @ along).norm())
        near = torch.minimum(q - limits.lower, limits.upper - q).min() < _NEAR_LIMIT
        if (
            speed < _STILL * float(force.norm())
            or near
            or float(torch.linalg.svdvals(J)[-1]) < SINGULAR_BELOW
            or (clearance is not None and float(clearance(q)) < _NEAR)
        ):
            break
        step = along * min(_STEP / speed, _STEP_JOINTS / float(along.norm()))
        q = q + step
        q = q + torch.linalg.pinv(chain.jacobian(q)) @ chain.forward(q).twist_to(pose)
    return furthest


def _moved_unseen(
    chain: SerialChain, log: LoggedSteps, offset: Float[torch.Tensor, " joints"]
) -> Float[np.ndarray, "time 3"]:
    """How far a push moved the end effector without the encoders showing it [m].

    That is by how much their error at the end effector differs from what it would be without
    the push: on the path, or else as it was when no input moved the null space last.
    """
    joints = torch.from_numpy(log["joint_position"])
    path = torch.from_numpy(log["path_joints"])
    pushed = (log["nullspace_input"] != 0).any(axis=1)
    rows = np.arange(len(joints))
    last = np.maximum.accumulate(np.where(pushed, 0, rows))
    undisturbed = torch.where(path.isfinite().all(-1, keepdim=True), path, joints[last])

    def unseen(q: Float[torch.Tensor, "time joints"]) -> Float[torch.Tensor, "time 3"]:
        return chain.forward(q - offset).position - chain.forward(q).position

    return (unseen(joints) - unseen(undisturbed)).numpy()


def _elbow_moved(
    chain: SerialChain,
    joints: Float[torch.Tensor, "time joints"],
    planned: Float[torch.Tensor, "time joints"],
) -> Float[torch.Tensor, " time"]:
    """Distance of the elbow from where it would be without the person [m].

    That is where a path has it, or else where it was when the pull began, moved along with the
    end effector.
    """
    on_path = planned.isfinite().all(-1, keepdim=True)
    elbow, hand = chain.joint_origins(joints)[:, _ELBOW], chain.forward(joints).position
    path = chain.joint_origins(torch.where(on_path, planned, joints))[:, _ELBOW]
    undisturbed = torch.where(on_path, path, elbow[0] + hand - hand[0])
    return (elbow - undisturbed).norm(dim=-1)


def _phases(log: LoggedSteps) -> list[tuple[str, float, float]]:
    """Name, start and end of every phase [s]."""
    starts = [event.time for event in log.events]
    ends = [*starts[1:], math.inf]
    return [(e.text, e.time, end) for e, end in zip(log.events, ends, strict=True)]
