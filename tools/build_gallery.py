"""Make the pictures and films of docs/images by the commands that the gallery shows.

Runs that pictures are taken from are kept in outputs/ and not repeated if they are there.

    python tools/build_gallery.py --list
    python tools/build_gallery.py --only film dmp_pose   # film.webp and dmp_pose.png
    python tools/build_gallery.py                        # all; benchmarks take hours
"""

import argparse
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = Path("docs") / "images"
SHOWN = re.compile(r"!\[([^\]]*)\]\([^)]*images/([\w.]+)\)")
"""Alternative text and file of a picture in a page."""
RUNS = {
    "outputs/demo": "hrc demo",
    "outputs/so101_set": (
        "hrc record expert --robot so101 --episodes 3 --out outputs/so101_set "
        "--config robot.images.kind=egl"
    ),
    "outputs/so101_set.rrd": "hrc show outputs/so101_set --out outputs/so101_set.rrd",
    "outputs/so101_fit": "hrc fit outputs/so101_set --out outputs/so101_fit",
    "outputs/so101_played": (
        "hrc play --model outputs/so101_fit --goal 0.7 0.2 0.3 -0.4 1.6 --robot so101 "
        "--out outputs/so101_played"
    ),
    "outputs/demo_ur5e": "hrc demo --markerless --robot ur5e --out outputs/demo_ur5e",
    "outputs/five": (
        "hrc record expert --scenario grasping --episodes 5 --out outputs/five "
        "--config robot.object_pose=true"
    ),
    "outputs/thousand": "hrc multiply outputs/five --episodes 1000 --out outputs/thousand",
    "outputs/placing_set": (
        "hrc record expert --episodes 4 --out outputs/placing_set --config robot.fps=25"
    ),
    "outputs/policy": (
        "hrc fit --dataset outputs/placing_set --as-lerobot-policy --n-basis 40 "
        "--out outputs/policy"
    ),
    "outputs/fit": "hrc fit outputs/demo/placing_demos --out outputs/fit",
    "outputs/near_worker": (
        "hrc run collaboration --pulls random --worker --out outputs/near_worker"
    ),
    "outputs/placing": "hrc run placing --out outputs/placing",
    "outputs/grasping": "hrc run grasping --out outputs/grasping",
    "outputs/collaboration": (
        "hrc run collaboration --shelf lower middle upper --camera-moved "
        "--out outputs/collaboration"
    ),
}
"""Results that pictures are taken from, and the commands that make them."""


@dataclass(frozen=True, kw_only=True)
class Program:
    """A command that makes pictures."""

    heading: str
    """Heading in the gallery."""
    command: str
    """Command, run in the checkout."""
    pictures: tuple[str, ...]
    """Files in docs/images."""
    needs: tuple[str, ...] = ()
    """Keys of `RUNS`, in the order in which they are made."""
    only: str = ""
    """Option of the command that takes the pictures to make; empty: it makes all of them."""
    prefix: str = ""
    """Beginning of the files' names that the option omits."""
    captions: Mapping[str, str] = field(default_factory=dict)
    """File -> caption, of pictures that no page shows; others have the text of their page."""

    def making(self, names: Sequence[str]) -> str:
        """Command that makes pictures of these names (without suffix)."""
        if not self.only or len(names) == len(self.pictures):
            return self.command
        return " ".join(
            [self.command, self.only, *(n.removeprefix(self.prefix) for n in names)]
        )


def _files(pattern: str, *names: str) -> tuple[str, ...]:
    return tuple(pattern.format(name) for name in names)


PROGRAMS = (
    Program(
        heading="The whole job",
        command="python tools/docs/readme_film.py",
        pictures=("film.webp",),
        needs=("outputs/demo",),
    ),
    Program(
        heading="An SO-101",
        command="python tools/docs/moving_picture.py outputs/so101_played/film.mp4 "
        "docs/images/so101.webp",
        pictures=("so101.webp",),
        needs=("outputs/so101_set", "outputs/so101_fit", "outputs/so101_played"),
        captions={"so101.webp": "A primitive of three demonstrations, sent to a new goal"},
    ),
    Program(
        heading="No marker anywhere",
        command="python tools/docs/markerless_film.py",
        pictures=("markerless.webp",),
        needs=("outputs/demo_ur5e",),
        captions={
            "markerless.webp": "Arm and object are found by the look that demonstrations "
            "showed, with their uncertainty, and the arm servoes to the target"
        },
    ),
    Program(
        heading="Five demonstrations become a thousand",
        command="python tools/docs/multiply_film.py",
        pictures=("multiply.webp",),
        needs=("outputs/five", "outputs/thousand"),
        captions={
            "multiply.webp": "Motions for new places of the object, each of which physics "
            "judges before it is written"
        },
    ),
    Program(
        heading="People beside a LeRobot policy",
        command="python tools/docs/policy_film.py",
        pictures=("policy.webp",),
        needs=("outputs/placing_set", "outputs/policy"),
        captions={
            "policy.webp": "A policy places an object. A person pulls the elbow, a worker "
            "reaches in, and the arm waits and goes on"
        },
    ),
    Program(
        heading="Page and headset",
        command="python tools/docs/teleoperation.py",
        pictures=("page_drag.jpg", "page_region.jpg", "ar.webp"),
    ),
    Program(
        heading="A run in Rerun",
        command="python tools/docs/dashboards.py --run outputs/near_worker/run.rrd",
        pictures=_files("dashboard_{}.jpg", "story", "person", "servoing", "safety"),
        needs=("outputs/demo", "outputs/near_worker"),
        only="--tabs",
        prefix="dashboard_",
    ),
    Program(
        heading="A dataset in Rerun",
        command="python tools/docs/dashboards.py --demonstrations outputs/so101_set.rrd",
        pictures=("demonstrations.jpg",),
        needs=("outputs/so101_set", "outputs/so101_set.rrd"),
    ),
    Program(
        heading="A fit in Rerun",
        command="python tools/docs/dashboards.py --fit outputs/fit/fit.rrd",
        pictures=("fit_dashboard.jpg",),
        needs=("outputs/demo", "outputs/fit"),
    ),
    Program(
        heading="Placing",
        command="python tools/docs/experiments.py --pictures-only --placing outputs/placing",
        pictures=("placing_paths.png",),
        needs=("outputs/demo", "outputs/placing"),
    ),
    Program(
        heading="Null-space posture",
        command="python tools/docs/null_space_posture.py",
        pictures=("null_space_posture.png",),
    ),
    Program(
        heading="Grasping",
        command="python tools/docs/experiments.py --pictures-only --grasping outputs/grasping",
        pictures=_files("grasping_{}.png", "trajectories", "image_jacobian"),
        needs=("outputs/demo", "outputs/grasping"),
    ),
    Program(
        heading="Collaboration",
        command="python tools/docs/experiments.py --pictures-only "
        "--collaboration outputs/collaboration",
        pictures=_files("collaboration_{}.png", "timeline", "marker", "person", "trajectories"),
        needs=("outputs/demo", "outputs/collaboration"),
        captions={"collaboration_person.png": "Effort of the person, elbow, end effector"},
    ),
    Program(
        heading="Movement primitives",
        command="python tools/docs/dmp_gallery.py --out docs/images",
        pictures=_files(
            "dmp_{}.png",
            *("joint", "scalings", "approach", "orientation", "pose", "rhythm", "distribution"),
            *("via_points", "context", "moving_goal", "goal_filter", "stopping", "obstacles"),
            *("force", "bases"),
        ),
        only="--only",
        prefix="dmp_",
    ),
    Program(
        heading="Controllers",
        command="python benchmarks/controller_sweep.py --suite paper "
        "--figure docs/images/controller_sweep.png",
        pictures=("controller_sweep.png",),
    ),
    Program(
        heading="Learning a policy",
        command="python benchmarks/bench_motion_head.py "
        "--picture docs/images/dmp_motion_head.png",
        pictures=("dmp_motion_head.png",),
    ),
    Program(
        heading="Jobs near a worker",
        command="python benchmarks/worker_study.py --placing outputs/demo/placing "
        "--aiming outputs/demo/aiming --runs 250 --cycles 6 --stop-distances 0.1 0.2 0.4 "
        "--figure docs/images/worker_study.png",
        pictures=("worker_study.png",),
        needs=("outputs/demo",),
    ),
    Program(
        heading="What another posture could gain near a worker",
        command="python benchmarks/posture_bound.py --placing outputs/demo/placing "
        "--aiming outputs/demo/aiming --figure docs/images/posture_bound.png",
        pictures=("posture_bound.png",),
        needs=("outputs/demo",),
    ),
)
"""Programs in the order of the gallery."""


def chosen(names: Sequence[str]) -> list[tuple[Program, list[str]]]:
    """Programs and names of their pictures to make; all if no name is given."""
    known = [Path(file).stem for program in PROGRAMS for file in program.pictures]
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"no picture {', '.join(unknown)}; there are {', '.join(known)}")
    found = []
    for program in PROGRAMS:
        stems = [Path(file).stem for file in program.pictures]
        if wanted := [stem for stem in stems if not names or stem in names]:
            found.append((program, wanted))
    return found


def commands(names: Sequence[str], root: Path) -> list[str]:
    """Commands that make pictures, without those of runs that are there."""
    lines: dict[str, None] = {}
    for program, wanted in chosen(names):
        runs = [RUNS[run] for run in program.needs if not (root / run).exists()]
        lines |= dict.fromkeys([*runs, program.making(wanted)])
    return list(lines)


def page(root: Path) -> str:
    """The gallery as Markdown: every picture of a checkout with its commands."""
    texts = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    alternative: dict[str, str] = {}
    for page in filter(Path.is_file, texts):
        for text, file in SHOWN.findall(page.read_text("utf-8")):
            alternative.setdefault(file, " ".join(text.split()))
    lines = ["# Gallery", ""]
    for program in PROGRAMS:
        there = [file for file in program.pictures if (root / IMAGES / file).is_file()]
        if not there:
            continue
        shown = [*(RUNS[run] for run in program.needs), program.command]
        lines += [f"## {program.heading}", "", "```sh", *shown, "```", ""]
        for file in there:
            text = program.captions.get(file) or alternative[file]
            lines += [f"![{text}](images/{file})", "", text, ""]
    return "\n".join(lines)


def run(line: str) -> int:
    """Run a command in the checkout with this interpreter and return its exit status."""
    print(f"$ {line}", flush=True)
    word, *words = shlex.split(line)
    module = ["-m", "hrc_learn.cli"] if word == "hrc" else []
    return subprocess.run([sys.executable, *module, *words], cwd=ROOT, check=False).returncode


def main() -> int:
    parser = argparse.ArgumentParser(description="Make the pictures of docs/images.")
    parser.add_argument("--only", nargs="+", default=(), help="names, such as film dmp_pose")
    parser.add_argument("--list", action="store_true", help="print the commands, run none")
    args = parser.parse_args()
    try:
        lines = commands(args.only, ROOT)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if args.list:
        print(*lines, sep="\n")
        return 0
    # A run that misses a target ends with status 1, but has its pictures.
    failed = [line for line in lines if run(line)]
    for line in failed:
        print(f"failed, or missed a target: {line}")
    return int(bool(failed))


if __name__ == "__main__":
    raise SystemExit(main())
