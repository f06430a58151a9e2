"""`hrc fit image-jacobian`, and `hrc evaluate` of its models."""

import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from hrc_learn import distributed
from hrc_learn.cli._run import refuse_repeats, with_settings, write_values
from hrc_learn.cli.arguments import Evaluate, FitImageJacobian, refuse_given
from hrc_learn.demos import (
    DemonstrationSet,
    DemonstrationSource,
    Detector,
    Extraction,
    attach_features,
    extract_features,
    load_demos,
    open_demos,
)
from hrc_learn.jacobian import (
    EvidenceConfig,
    ImageJacobianFitConfig,
    RBFCenters,
    RBFImageJacobian,
)
from hrc_learn.learning.fit_dashboards import record_learning
from hrc_learn.learning.markerless_fitting import MarkerlessFit, find_landmarks
from hrc_learn.learning.visual_servo_fitting import fit_visual_servo
from hrc_learn.skills.visual_skill import VisualServoSkill
from hrc_learn.store import new_folder, read_toml, write_json
from hrc_learn.vision import MarkerDetector, centre
from hrc_learn.viz.report import Measurement, Row, measured, show_command, show_measurements

_ROWS: tuple[Row, ...] = tuple(
    (name, text, factor, unit, bound[0] if bound else None, resolution)
    for name, (text, factor, unit, resolution, *bound) in read_toml(
        Path(__file__).with_name("image_jacobian_rows.toml")
    ).items()
)


@dataclass(frozen=True, kw_only=True)
class _JacobianSettings:
    """Settings of the fit of an image Jacobian."""

    learning: EvidenceConfig = field(default_factory=EvidenceConfig)
    fit: ImageJacobianFitConfig = field(default_factory=ImageJacobianFitConfig.of_residual)


def fit_image_jacobian(args: FitImageJacobian) -> None:
    """Fit the image Jacobian and the target in the image.

    Raises:
        ValueError: An episode is named twice.
    """
    settings = with_settings(args.config, _JacobianSettings())
    learning = settings.learning
    refuse_repeats(args.episodes)
    with distributed.processes() as rank:
        console = Console(quiet=rank != 0)
        demos, searched, unmarked = _demonstrations(args, console, rank)
        for note in demos.notes:
            console.print(f"note: {note}")
        if args.learn and len(demos) < learning.hold_out:
            console.print(
                f"note: {len(demos)} demonstrations are too few to learn the neurons, which "
                f"stay as they are (--config learning.hold_out={learning.hold_out})"
            )
        # The paper's grid, or neurons around the demonstrations.
        neurons = RBFCenters.paper() if args.neurons == "grid" else None
        with console.status(f"Fitting {len(demos)} demonstrations") as status:
            skill = fit_visual_servo(
                demos,
                neurons,
                settings.fit,
                learning if args.learn else None,
                lambda number, state: status.update(
                    f"Learning, round {number}: held-out error {state.held_out_error:.3f} px"
                ),
                None if unmarked is None else unmarked.landmarks,
            )
        if rank == 0:
            _write(args, skill, demos, searched, unmarked)


type _Searched = tuple[
    DemonstrationSource | DemonstrationSet, Mapping[str, float | int], MarkerlessFit | None
]
"""Demonstrations, measured values of the search in their video, and the result of a markerless
search."""


def _demonstrations(args: FitImageJacobian, console: Console, rank: int) -> _Searched:
    """Demonstrations with pixels from the dataset, from the search for a marker, or from the
    markerless search.
    """
    demos = open_demos(args.dataset, episodes=args.episodes or None)
    if args.markerless:
        refuse_given(args, ["marker"], "is not used by --markerless")
        with console.status(f"Searching the video of {len(demos)} demonstrations"):
            unmarked = find_landmarks(demos, args.camera)
        return unmarked.demos, unmarked.figures(), unmarked
    if args.marker is None:
        refuse_given(args, ["camera"], "needs --marker or --markerless")
        return demos, {}, None
    if rank != 0:
        # Waits until the first process has searched.
        distributed.sum_over_processes(torch.zeros(()))
    found = _find_marker(args, args.marker, console)
    if rank == 0:
        distributed.sum_over_processes(torch.zeros(()))
    return (
        attach_features(demos.load(), found.name),
        {
            "episodes_searched": found.episodes,
            "episodes_known_before": found.known,
            "episodes_left_out": len(found.left_out),
            "frames_searched": found.frames,
            "frames_without_image": found.without_image,
            "frames_with_marker": found.seen,
        },
        None,
    )


def _find_marker(args: FitImageJacobian, marker: int, console: Console) -> Extraction:
    """Search every new image for the marker; the pixels are kept next to the dataset."""
    if not 0 <= marker < 50:
        raise ValueError(f"--marker must be from 0 to 49, got {marker}")
    found = extract_features(
        args.dataset,
        f"marker_{marker}",
        lambda: _detector(marker),
        camera=args.camera,
        progress=lambda episodes: track(episodes, "Searching episodes", console=console),
    )
    console.print(
        f"{found.name}: {found.episodes} episodes searched, {found.known} known before; marker "
        f"in {found.seen} of {found.frames} frames, {found.without_image} without an image"
    )
    for reason in found.left_out.values():
        console.print(f"left out: {reason}")
    return found


def _detector(marker: int) -> Detector:
    """Detector of one marker's centre [px]."""
    markers = MarkerDetector([marker])

    def detect(image: np.ndarray) -> np.ndarray | None:
        corners = markers.detect(image).get(marker)
        return None if corners is None else centre(corners)

    return detect


def _write(
    args: FitImageJacobian,
    skill: VisualServoSkill,
    demos: DemonstrationSource | DemonstrationSet,
    searched: Mapping[str, float | int],
    unmarked: MarkerlessFit | None,
) -> None:
    metrics = skill.metrics()
    with new_folder(args.folder, asdict(args) | {"out": args.folder}, args.overwrite) as folder:
        skill.save(folder)
        write_json(folder / "metrics.json", metrics)
        title = f"Image Jacobian from {args.dataset.name}"
        record_learning(folder / "fit.rrd", skill, demos, title)
        if unmarked is not None:
            unmarked.save_picture(folder / FOUND)
    shown = metrics | dict(searched)
    rows = measured(_ROWS, shown)
    title, more = f"Image Jacobian from {args.dataset}", len(shown) - len(rows)
    show_measurements(rows, title=title, more=more, elsewhere="metrics.json")
    print(f"Found: {skill.jacobian.camera_fit}.")
    if unmarked is not None:
        print(f"Found in the video: {shlex.quote(str(args.folder / FOUND))}")
    print(f"Model in {shlex.quote(str(args.folder))}")
    print(f"Dashboard: {show_command(args.folder)}")
    write_values(args.json, shown)


FOUND = "found.png"
"""Picture of what was found without markers, in the folder of a model."""
MOST_ERROR = 0.05
"""Largest median error of an image Jacobian relative to the true one."""
_TILT = 0.1
"""Tilt of the end effector in the second grid of poses [rad]; in the first it points down."""


def evaluate_image_jacobian(args: Evaluate, model: Path) -> int:
    """Compare an image Jacobian with the simulator's true one."""
    refuse_given(args, ["out", "overwrite", "most_nrmse"], "is for primitives: leave it out")
    torch.set_num_threads(1)
    figures = _image_jacobian_figures(args, VisualServoSkill.load(model).jacobian)
    rows = [
        Measurement(
            name=name.replace("_", " "),
            value=value,
            target=MOST_ERROR if name == "upright_relative_error_median" else None,
        )
        for name, value in figures.items()
    ]
    show_measurements(rows, title=f"Image Jacobian {model}", elsewhere="--json FILE")
    write_values(args.json, figures)
    return int(any(row.ok is False for row in rows))


def _image_jacobian_figures(args: Evaluate, network: RBFImageJacobian) -> dict[str, float]:
    """Errors on two grids of poses."""
    # Imported here: the evaluation of primitives does not need MuJoCo.
    from hrc_learn.experiments.grasping_experiment import compare_with_truth, held_out_grid
    from hrc_learn.sim import World
    from hrc_learn.sim.workplace import Workplace

    demos = load_demos(args.dataset, episodes=args.episodes or None)
    if demos[0].position is None:
        raise ValueError(f"{args.dataset}: no end-effector positions to place a grid around.")
    shown = torch.cat([torch.from_numpy(demo.position) for demo in demos]).double()
    workplace = Workplace()
    world = World(workplace.scene)
    world.reset(workplace.home_joints().numpy(), {})
    camera, offset = workplace.scene.camera, world.hand_marker_offset()
    figures: dict[str, float] = {}
    for name, tilt in (("upright", 0.0), ("tilted", _TILT)):
        errors = compare_with_truth(network, held_out_grid(shown, tilt=tilt), camera, offset)
        figures |= {f"{name}_{key}": value for key, value in errors.items()}
    return figures
