"""`hrc multiply`: many judged demonstrations from a few."""

import itertools
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import Progress

from hrc_learn.cli._run import with_settings, write_values
from hrc_learn.cli.arguments import Multiply
from hrc_learn.demos import open_demos
from hrc_learn.demos.dataset_views import arm_of_dataset
from hrc_learn.demos.issues import aligned
from hrc_learn.experiments.motion_judge import Judge, JudgeConfig, Replay, Trial, judging
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import ArmChoice
from hrc_learn.learning import multiply_motions as motions
from hrc_learn.learning.multiply_dataset import MultipliedColumns, MultipliedWriter, pose_of
from hrc_learn.sim.workplace import Workplace
from hrc_learn.store import read_json, write_json
from hrc_learn.teleoperation.scenarios import SCENARIOS, SHELVES, make_scenario

# Number of motions that are made at once.
_CHUNK = 50
# After `_ENOUGH` attempts, a fraction of successes below `_FEW` ends the run.
_ENOUGH, _FEW = 100, 0.02


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """An object, or another place that motions depend on."""

    columns: str = ""
    """Columns of its pose, such as "observation.state[8:14]": x, y, z [m], optionally with a
    rotation vector [rad] or a quaternion (w, x, y, z). Default: columns named NAME.x and so
    on."""
    pose: tuple[float, ...] = ()
    """Its pose in all demonstrations, if no column holds it."""
    x: tuple[float, float] | None = None
    """Range of its position along x in new scenes [m]. Default: that of the demonstrations."""
    y: tuple[float, float] | None = None
    """Range along y, like `x` [m]."""
    z: tuple[float, float] | None = None
    """Range along z, like `x` [m]."""
    yaw: tuple[float, float] = (0.0, 0.0)
    """Range of its rotation about the vertical, from the demonstrated orientation [rad]."""

    __post_init__ = check_settings


@dataclass(frozen=True, kw_only=True)
class MultiplyConfig:
    """Variation of the motions."""

    seed: int = 0
    """Seed of all random choices."""
    style: float = 0.3
    """Fraction of a random mixture of all demonstrations in each motion; 0: no mixture."""
    speed: tuple[float, float] = (0.9, 1.1)
    """Range of the speed, relative to the demonstrations."""
    start: float = 0.01
    """Largest displacement of the first position along each axis [m]."""
    shift: tuple[float, float, float] | None = None
    """Displacement of scene and start for another arm [m]. Default: the displacement between
    the work cells of the two arms, or none outside a work cell."""
    segments: str = ""
    """JSON file of the segments. `--episodes 0` writes it, so that it can be corrected."""
    demonstrations: tuple[int, ...] = ()
    """Episodes to learn from. Default: all."""

    def __post_init__(self) -> None:
        check_settings(self, not_negative=("seed", "start"))
        if not 0 <= self.style <= 1:
            raise ValueError(f"style must be from 0 to 1, but is {self.style}.")
        if not 0 < self.speed[0] <= self.speed[1]:
            raise ValueError(f"speed must be a range above 0, but is {self.speed}.")


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of `hrc multiply`."""

    multiply: MultiplyConfig = field(default_factory=MultiplyConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    objects: dict[str, ObjectConfig] = field(default_factory=dict)


def multiply(args: Multiply) -> int:
    """Write new demonstrations; exit status 1 if hardly any motion succeeds.

    Raises:
        ValueError: A setting or the dataset cannot be used.
    """
    if args.episodes < 0:
        raise ValueError(f"--episodes must not be negative, but is {args.episodes}.")
    job = Multiplication(args, with_settings(args.config, Settings()))
    print(*aligned(job.segmentation.rows(job.demos[:3])), sep="\n")
    if not job.objects:
        print("no object poses: scenes stay as shown (--config objects.NAME.columns=...)")
    if not args.episodes:
        if file := job.config.segments:
            write_json(Path(file), job.segmentation)
        return 0
    print(f"judged by {job.judged_by}", flush=True)
    try:
        failures = job.run()
    except RuntimeError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    for reason, count in failures.most_common():
        print(f"{count:6d} motions left out: {reason}")
    attempts = args.episodes + failures.total()
    rate = args.episodes / attempts
    print(f"{args.episodes} of {attempts} motions succeeded ({rate:.0%}): {args.folder}")
    values = {"episodes": args.episodes, "attempts": attempts, "success_rate": rate}
    write_values(args.json, values)
    return 0


class Multiplication:
    """One run of `hrc multiply`: dataset, arm, judge, segments and fitted motions."""

    def __init__(self, args: Multiply, settings: Settings):
        if args.judge:
            settings = replace(settings, judge=replace(settings.judge, scene=args.judge))
        self.args, self.settings, self.config = args, settings, settings.multiply
        self.source = open_demos(args.dataset, self.config.demonstrations or None)
        self.demos = [*self.source]
        taught = arm_of_dataset(self.source)
        kind = self.source.folder.robot_type or ""
        cell = kind.startswith("mujoco_")
        self.choice = ArmChoice(args.robot or taught.arm.name)
        self.robot = self.choice.work_arm() if cell else self.choice.arm()
        same = self.robot.name == taught.arm.name
        self.kind = kind if same else f"{'mujoco_' * cell}{self.robot.name}"
        self.judge = _judge(settings.judge, self.demos[0].task if cell else "")
        given = {n: o.columns for n, o in settings.objects.items() if o.columns}
        self.columns = MultipliedColumns(self.source, taught, self.robot, given)
        objects = self.columns.objects | {
            name: pose_of(torch.tensor([o.pose] * len(self.demos), dtype=torch.float64))
            for name, o in settings.objects.items()
            if o.pose
        }
        if unknown := settings.objects.keys() - objects.keys():
            raise ValueError(
                f"the pose of the object {min(unknown)!r} is unknown (known: "
                f"{', '.join(objects) or 'none'}): set objects.{min(unknown)}.columns or .pose."
            )
        shown = [d.joint_position for d in self.demos if d.joint_position is not None]
        joints = [torch.from_numpy(taught.positions(q)) for q in shown]
        tool = [taught.arm.forward(q) for q in joints]
        if Path(self.config.segments).is_file():
            file = Path(self.config.segments)
            self.segmentation = read_json(file, motions.Segmentation, "correct it")
        else:
            begun = self.columns.departures()
            self.segmentation = motions.find_segments(self.demos, objects, tool, begun)
        if not same:
            moved = _between_cells(taught.arm, self)
            tool, objects = [*map(moved, tool)], {n: moved(p) for n, p in objects.items()}
        self.objects, obstacles = objects, None
        if self.judge.scene in SCENARIOS:
            boxes = Workplace.of(self.robot).scene.boxes()
            obstacles = torch.tensor([[*b.centre, *b.half_size] for b in boxes]).double()
        near: Any = joints
        if not same:
            usual = self.robot.inverse(tool[0][0], near=self.robot.ready)
            near = torch.cat([usual[None], self.robot.postures(tool[0][0])])
        self.motions = motions.MotionSource.fit(
            self.demos, tool, objects, self.segmentation, self.robot, near, obstacles
        )

    @property
    def judged_by(self) -> str:
        """Description of the judge."""
        if self.judge.scene:
            return f"physics: {self.judge.scene}"
        return "kinematics alone (reach, limits, collisions of the arm), without physics"

    def run(self) -> Counter[str]:
        """Write the episodes that are missing; returns the number of failures by reason.

        Raises:
            RuntimeError: Hardly any motion succeeds.
        """
        wanted, folder, settings = self.args.episodes, self.args.folder, self.settings
        made_by = {"dataset": str(self.args.dataset), "robot": self.robot.name}
        made_by |= asdict(replace(settings, judge=replace(settings.judge, processes=1)))
        writer = MultipliedWriter(folder, self.kind, self.columns, self.source, made_by)
        widths = [float(demo.gripper.max()) for demo in self.demos if demo.gripper is not None]
        given = self.judge, self.choice, self.source.fps, max(widths, default=1.0)
        physics = judging(*given) if self.judge.scene else nullcontext()
        with writer.claimed(), physics as judge, Progress(transient=True) as progress:
            bar, done = progress.add_task("Multiplying", total=wanted), len(writer.provenance)
            first = 1 + writer.provenance[-1]["attempt"] if done else 0
            failed: dict[int, str] = {}
            attempts = itertools.chain.from_iterable(
                self._attempts(range(at, at + _CHUNK), judge)
                for at in itertools.count(first, _CHUNK)
            )
            while len(writer.provenance) < wanted:
                attempt, made = next(attempts)
                if isinstance(made, str):
                    failed[attempt] = made
                    if attempt >= _ENOUGH and len(writer.provenance) < _FEW * attempt:
                        most = Counter(failed.values()).most_common(3)
                        listed = ", ".join(f"{reason} ({n})" for reason, n in most)
                        raise RuntimeError(f"hardly any motion succeeds: {listed}")
                    continue
                values, task, origin = made
                writer.write(values, task, origin | {"failed": failed})
                failed = {}
                progress.update(bar, completed=len(writer.provenance))
        return Counter(r for each in writer.provenance for r in each["failed"].values())

    def _attempts(
        self, attempts: range, judge: Judge | None
    ) -> Iterator[tuple[int, tuple[Mapping, str, dict[str, Any]] | str]]:
        """Columns, task and origin of each episode, or the reason why a motion failed."""
        draws = self.draw(attempts)
        made = self.motions.motions(draws)
        trials = [self.trial(draws, motion, k) for k, motion in enumerate(made)]
        if self.judge.is_environment:
            trials = [
                replace(t, seed=n, columns=self._values(m, self._planned(m, t)))
                for n, m, t in zip(attempts, made, trials, strict=True)
            ]
        good = [(m, t) for m, t in zip(made, trials, strict=True) if not m.reason]
        replays = judge([t for _, t in good]) if judge else (self._planned(*x) for x in good)
        for k, attempt in enumerate(attempts):
            replay = None if made[k].reason else next(replays)
            if replay is None or replay.failure:
                yield attempt, made[k].reason if replay is None else replay.failure
                continue
            demo = self.demos[made[k].source]
            origin = {
                "attempt": attempt,
                "episode": demo.episode,
                "weights": [round(w, 4) for w in draws.weights[k].tolist()],
                "speed": round(float(draws.speed[k]), 4),
                "scene": {name: at.tolist() for name, at in trials[k].objects.items()},
                "seed": self.config.seed,
                "judged_by": self.judged_by,
            }
            values = replay.columns or self._values(made[k], replay)
            yield attempt, (values, demo.task, origin)

    def draw(self, attempts: range) -> motions.Draws:
        """Random choices; each attempt has a generator of its own."""
        config, n, rows = self.config, len(self.demos), []
        for attempt in attempts:
            rng = np.random.default_rng([config.seed, attempt])
            main = rng.integers(n)
            weights = config.style * rng.dirichlet(np.ones(n))
            weights[main] += 1 - weights.sum()
            scene = {}
            for name, pose in self.objects.items():
                ranges = self.settings.objects.get(name, ObjectConfig())
                low, high = pose.position.amin(0), pose.position.amax(0)
                for axis, given in enumerate((ranges.x, ranges.y, ranges.z)):
                    low[axis], high[axis] = given or (low[axis], high[axis])
                place = low + (high - low) * torch.from_numpy(rng.random(3))
                turn = torch.tensor([0.0, 0.0, rng.uniform(*ranges.yaw)]).double()
                turned = quaternion.multiply(quaternion.exp(turn), pose.orientation[main])
                scene[name] = Pose(place, turned)
            start = config.start * rng.uniform(-1, 1, 3)
            rows.append((scene, weights, rng.uniform(*config.speed), start))
        scenes, weights, speed, start = zip(*rows, strict=True)
        return motions.Draws(
            scene={
                name: Pose.stack([scene[name] for scene in scenes]) for name in self.objects
            },
            weights=torch.from_numpy(np.stack(weights)),
            speed=torch.tensor(speed).double(),
            start=torch.from_numpy(np.stack(start)),
        )

    def trial(self, draws: motions.Draws, made: motions.NewMotion, k: int) -> Trial:
        return Trial(
            joints=made.joints.numpy(),
            gripper=self.columns.gripper(made.source, made.phase.numpy()),
            objects={
                name: torch.cat([pose.position[k], pose.orientation[k]]).numpy()
                for name, pose in draws.scene.items()
            },
        )

    def _values(self, made: motions.NewMotion, x: Replay) -> dict[str, np.ndarray]:
        """Columns of an episode."""
        phase = made.phase.numpy()
        return self.columns.values(made.source, phase, x.joints, x.sent, x.gripper, x.objects)

    def _planned(self, made: motions.NewMotion, trial: Trial) -> Replay:
        """Motion as planned; objects move with the tool where they did in the demonstration."""
        q, objects = trial.joints, self.columns.object_paths(made, trial.objects)
        return Replay(joints=q, sent=q[[*range(1, len(q)), -1]], gripper=None, objects=objects)


def _judge(config: JudgeConfig, task: str) -> JudgeConfig:
    """The judge; by default, that of the work-cell scenario with this task, if there is one."""
    if config.scene:
        return replace(config, scene="" if config.scene == "none" else config.scene)
    for scene, shelf in [("grasping", "middle"), *(("placing", shelf) for shelf in SHELVES)]:
        if task == make_scenario(scene, shelf, ArmChoice().arm()).task:
            return replace(config, scene=scene, shelf=shelf)
    return config


def _between_cells(taught: Any, job: Multiplication) -> Callable[[Pose], Pose]:
    """Function that moves poses from the demonstrated scene to the scene of another arm.

    Between work cells, distances are scaled with the hand, as the objects are.
    """
    size, shift = 1.0, torch.tensor(job.config.shift or (0.0, 0.0, 0.0)).double()
    if job.judge.scene in SCENARIOS and not job.config.shift:
        cells = [Workplace.of(arm) for arm in (taught, job.robot)]
        size = cells[1].robot.hand_size / cells[0].robot.hand_size
        if job.judge.scene == "placing":
            ends = [cell.shelf(job.judge.shelf).position for cell in cells]
        else:
            ends = [cell.hover().position * shift.new_tensor([1, 1, 0]) for cell in cells]
        shift = ends[1] - size * ends[0]
    return lambda pose: Pose(size * pose.position + shift, pose.orientation)
