"""Film of people beside a LeRobot policy: the arm gives way, waits, and goes on.

The policy, a movement primitive of four demonstrations, places an object. Meanwhile a scripted
person pulls the elbow, and a worker brings another object to the table and reaches in. Distance
and speeds are those of the rollout.

hrc record expert --episodes 4 --out outputs/placing_set --config robot.fps=25
hrc fit --dataset outputs/placing_set --as-lerobot-policy --n-basis 40 --out outputs/policy
python tools/docs/policy_film.py --policy outputs/policy
"""

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from film_pictures import IMAGES, camera_at, write_film

from hrc_learn import cli
from hrc_learn.experiments.run_recorder import push_arrows
from hrc_learn.geometry.shapes import Line
from hrc_learn.lerobot.episode_recording import CheckpointPolicy, roll_out
from hrc_learn.lerobot.mujoco_arm import MujocoArmRobot, MujocoArmRobotConfig
from hrc_learn.lerobot.person import PersonConfig
from hrc_learn.log import RunRecording
from hrc_learn.sim import RecordedWorld
from hrc_learn.sim.cameras import OffscreenRenderer
from hrc_learn.sim.recorded_world import MovingBodies, WorkerDistance
from hrc_learn.viz import palette
from hrc_learn.viz.film import Picture, annotated

SIZE = 576, 360
"""Of the pictures [px]."""
EYE, TOWARDS, FOCAL = (1.75, 0.60, 0.95), (0.10, 0.33, 0.36), 1.0
"""View of cabinet, arm and worker [m], and its focal length by the picture's height."""
NEAR = 1.0
"""Largest distance of the worker that is shown [m]."""
FPS = 25.0
"""Actions per second [1/s], as in the demonstrations."""
STILL, SLOW, FASTER, AVERAGED = 0.15, 0.8, 1.2, 8
"""Speeds of the tool relative to that of the policy below which the arm waits, and is slow, and
above which it catches up; number of steps over which speeds are averaged."""
RESTS = 0.01
"""Speed of the tool below which the policy rests itself [m/s]."""
UP = np.array([0.0, 0.0, 0.15])
"""From the forearm of the person to the arrow above it [m]."""
AFTER = 1.0
"""Time after the last motion at which the film ends [s]."""


@dataclass(frozen=True, kw_only=True)
class Args:
    """What to film."""

    policy: Path = Path("outputs/policy")
    """Checkpoint of a policy that places."""
    out: Path = IMAGES / "policy.webp"
    """Receives the film as a moving picture."""
    seed: int = 0
    """Seed of the scene, the worker and the pulls."""


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """A rollout beside people."""

    run: RunRecording
    speed: np.ndarray
    """Speed of the tool relative to that which the policy commands; NaN: the policy rests."""
    done: bool
    """True if the object was placed."""


def main(args: Args) -> None:
    rollout = rolled_out(args)
    if not rollout.done:
        raise ValueError("the object was not placed: choose another --seed")
    film(args.out, rollout)


def rolled_out(args: Args) -> Rollout:
    """Roll the policy out, and record everything that moves."""
    person = PersonConfig(kind="scripted", worker=True)
    robot = MujocoArmRobot(MujocoArmRobotConfig(scenario="placing", fps=FPS, person=person))
    policy, chain = CheckpointPolicy(args.policy, robot), robot.work_arm.chain
    names = [f"{name}.pos" for name in chain.joint_names]
    joints, wanted, pushes, poses, nearest, times = [], [], [], [], [], []
    with robot:
        bodies = distance = None
        for _, action in roll_out(robot, policy, args.seed):
            world = robot.run.world
            if bodies is None or distance is None:
                bodies, distance = MovingBodies(world), WorkerDistance(world)
            times.append(world.time)
            joints.append(world.arm.read().joint_position)
            wanted.append([action[name] for name in names])
            assert robot.complement is not None, "a person pulls"
            pushes.append(robot.complement.nullspace_input)
            poses.append(bodies.poses())
            nearest.append(distance.now(world.held()).points)
        assert bodies is not None
        positions, orientations = zip(*poses, strict=True)
        q, tool = np.array(joints), chain.forward(torch.tensor(joints)).position.numpy()
        asked = chain.forward(torch.tensor(wanted, dtype=torch.float64)).position.numpy()
        run = RunRecording(
            title="A policy beside people",
            time=np.array(times),
            joint_names=chain.joint_names,
            joint_position=q,
            position=tool,
            bodies=bodies.drawn(np.stack(positions), np.stack(orientations)),
            boxes=tuple(robot.run.world.config.boxes()),
            push=push_arrows(chain, q, np.array(pushes)),
            worker_nearest=np.stack(nearest),
        )
        return Rollout(run=run, speed=relative(tool, asked), done=robot.run.succeeded())


def relative(tool: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Speed of the tool relative to that of the commanded positions; NaN where these rest."""
    window = np.ones(AVERAGED) / AVERAGED
    moved, asked = (
        np.convolve(np.linalg.norm(FPS * np.diff(x, axis=0), axis=1), window, "same")
        for x in (tool, wanted)
    )
    speed = np.divide(moved, asked, out=np.full_like(moved, np.nan), where=asked > RESTS)
    return np.append(speed, np.nan)


def film(path: Path, rollout: Rollout) -> None:
    """Write the film of a rollout."""
    run, pairs, pushes = rollout.run, rollout.run.worker_nearest, rollout.run.push
    assert pairs is not None
    assert pushes is not None
    gaps = np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1)
    world, camera = RecordedWorld(run), camera_at(SIZE, EYE, TOWARDS, FOCAL)
    begin, moves = float(run.time[0]), run.time[np.isfinite(rollout.speed)]
    end = float(moves[-1]) + AFTER
    with closing(OffscreenRenderer(world, *SIZE)) as renderer:

        def picture(time: float) -> Picture:
            step = min(int(np.searchsorted(run.time, time)), len(run.time) - 1)
            world.show(step)
            near, speed = bool(gaps[step] < NEAR), rollout.speed[step]
            pulled = bool(np.isfinite(pushes[step]).all())
            lines, labels = [], []
            if near:
                lines.append(_line(*pairs[step], palette.PURPLE, width=0.008))
                labels.append((f"distance to the worker: {gaps[step]:.2f} m", palette.PURPLE))
            if pulled:
                elbow, tip = pushes[step]
                lines.append(_line(elbow, tip, palette.PERSON, width=0.04))
                lines.append(_line(elbow + UP, tip + UP, palette.VERMILION, 0.02, head=True))
                labels.append(("a person pulls the elbow", palette.PERSON))
            if np.isfinite(speed):
                labels.append((f"tool at {speed:.0%} of the policy's speed", palette.SKY))
            shown = renderer.render(camera, lines)
            clock = f"{time - begin:.0f} s"
            return annotated(shown, said(speed), clock, labels)

        waits = np.where(rollout.speed < STILL, gaps, np.inf)
        times = float(run.time[waits.argmin()]), begin, end
        ending = f"placed, {gaps.min():.2f} m or more from the worker"
        write_film(path, picture, times, ("People beside a LeRobot policy", ending))


def _line(start: np.ndarray, end: np.ndarray, colour: str, width: float, **more: bool) -> Line:
    red, green, blue, _ = (channel / 255 for channel in palette.rgba(colour))
    return Line(start=start, end=end, colour=(red, green, blue, 1.0), width=width, **more)


def said(speed: float) -> str:
    """Caption from the tool's speed relative to that of the policy."""
    if not np.isfinite(speed):
        return "The policy rests"
    if speed < STILL:
        return "The arm waits"
    if speed < SLOW:
        return "The arm slows down"
    return (
        "The policy moves the arm" if speed < FASTER else "The arm catches up with the policy"
    )


if __name__ == "__main__":
    cli.run(main, Args)
