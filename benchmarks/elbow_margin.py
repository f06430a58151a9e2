"""Displacement of the elbow that a pull can reach, and the fraction of pulls that reach it.

python benchmarks/elbow_margin.py --placing outputs/demo/placing --aiming outputs/demo/aiming
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float

from hrc_learn import cli
from hrc_learn.experiments.collaboration_experiment import CollaborationExperiment
from hrc_learn.experiments.run_measures import ELBOW, pull_effects
from hrc_learn.geometry.numerics import null_projection
from hrc_learn.kinematics import SINGULAR_BELOW, SerialChain
from hrc_learn.teleoperation import ScriptedForce

type Clearance = Callable[[Float[torch.Tensor, "*batch joints"]], Float[torch.Tensor, "*batch"]]
"""Distance [m] between an arm at given joint positions [rad] and its surroundings."""

# Step of a self-motion at the elbow [m], step at the joints [rad], and largest number of steps.
_STEP, _STEP_JOINTS, _MAX_STEPS = 0.005, 0.05, 300
# Elbow velocity per force below which the elbow counts as blocked [m/s/N]: a few per cent of
# that of a free elbow.
_STILL = 5e-4
# Distances at which the margin of a pull ends: distance of a joint from its limit [rad], and of
# the arm from its surroundings [m].
_NEAR_LIMIT, _NEAR = 0.1, 0.03
FAR = 0.15
"""Displacement of the elbow by a pull that counts as followed [m]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    placing: Path
    """Folder of the placing skill."""
    aiming: Path
    """Folder of the visual-servoing skill."""
    jobs: int = 10
    """Jobs with pulls at random moments."""
    seed: int = 3000
    """First seed."""
    json: Path | None = None
    """File for the measured values."""


def main(args: Args) -> None:
    """Count the pulls with a margin of 150 mm, and the pulls among these that moved the elbow
    that far.
    """
    experiment = CollaborationExperiment(
        placing=args.placing, aiming=args.aiming, pulls="random"
    )
    wide = followed = 0
    for seed in range(args.seed, args.seed + args.jobs):
        run = experiment.run(seed)
        log, chain = run.cell.log, run.cell.chain
        for pull in run.pulls:
            step = int((log["time"] < pull.start).sum())
            effects = pull_effects(log, [pull], chain)
            if not effects:
                continue
            q = torch.from_numpy(log["joint_position"][step])
            margin = elbow_margin(q, pull, chain, run.workplace.arm_clearance)
            wide += margin >= FAR
            followed += margin >= FAR and effects[0].elbow >= FAR
    print(f"{followed} of {wide} pulls with room for 150 mm moved the elbow that far")
    if args.json is not None:
        cli.write_json(args.json, {"pulls_with_room": wide, "followed": followed})


def elbow_margin(
    joint_position: Float[torch.Tensor, " joints"],
    pull: ScriptedForce,
    chain: SerialChain,
    clearance: Clearance | None = None,
) -> float:
    """Displacement of the elbow that a pull can reach with the end effector at rest [m].

    Follows the self-motion of the arm in the direction of the pull, until a joint is near its
    limit, the arm is near its surroundings or near a singularity, or the elbow stands still.

    Args:
        joint_position: Joint positions where the pull begins [rad].
        pull: Pull with its direction.
        chain: Kinematics of the arm.
        clearance: Distance between the arm and its surroundings [m]; None: free space.
    """
    q, limits = joint_position, chain.limits
    pose, first = chain.forward(q), chain.joint_origins(q)[ELBOW]
    farthest, time = 0.0, (pull.start + pull.end) / 2
    for _ in range(_MAX_STEPS):
        elbow = chain.joint_origins(q)[ELBOW]
        farthest = max(farthest, float((elbow - first).norm()))
        J, J_elbow = chain.jacobian(q), chain.joint_jacobian(q, pull.joint)[:3]
        force = torch.from_numpy(pull.force(time, elbow.numpy()))
        self_motion = null_projection(J, J_elbow.mT @ force)
        speed = float((J_elbow @ self_motion).norm())
        if (
            speed < _STILL * float(force.norm())
            or torch.minimum(q - limits.lower, limits.upper - q).min() < _NEAR_LIMIT
            or float(torch.linalg.svdvals(J)[-1]) < SINGULAR_BELOW
            or (clearance is not None and float(clearance(q)) < _NEAR)
        ):
            break
        q = q + self_motion * min(_STEP / speed, _STEP_JOINTS / float(self_motion.norm()))
        # Newton step back to the pose, which the step along the tangent has left.
        q = q + torch.linalg.pinv(chain.jacobian(q)) @ chain.forward(q).twist_to(pose)
    return farthest


if __name__ == "__main__":
    cli.run(main, Args)
