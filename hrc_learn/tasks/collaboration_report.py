"""The page that tells how a run of the collaboration went."""

import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ..viz import RunRecording
from ..viz.report import Measurement, Section, write_report

_PACKAGES = ("hrc-learn", "torch", "mujoco", "lerobot", "opencv-python-headless", "rerun-sdk")


def write_collaboration_report(
    path: Path,
    run: RunRecording,
    table: Sequence[Measurement],
    configuration: Mapping[str, object],
    command: str,
) -> None:
    """Write the page with figures, table and how to do it again.

    Args:
        path: HTML file.
        run: What happened.
        table: What was measured.
        configuration: Of the run.
        command: That repeats it.
    """
    from ..viz import figures

    write_report(
        path,
        title=run.title,
        summary=(
            "An arm grasps an object with a camera that nobody calibrated, while a person "
            "pulls its elbow aside to reach under it. It then carries the object to a cabinet "
            "along a motion learned from demonstrations of hand and body shape at once, and "
            "puts it on a shelf. Simulated in MuJoCo; success is read from contacts there."
        ),
        table=table,
        sections=(
            Section(
                heading="Grasping with an uncalibrated camera",
                text=(
                    "The hand's marker is brought to where demonstrations had it above the "
                    "object. The image Jacobian was learned from them, and adapts online."
                ),
                figures=(
                    (
                        figures.image_figure(run),
                        "The marker's path in the image, and its error.",
                    ),
                    (
                        figures.image_jacobian_figure(run),
                        "Image Jacobian: the controller's estimate, and the simulator's truth.",
                    ),
                ),
            ),
            Section(
                heading="The person",
                text=(
                    "The pull acts in the null space of the hand's task: the elbow yields, the "
                    "hand stays."
                ),
                figures=((figures.person_figure(run), "Effort, elbow and hand."),),
            ),
            Section(
                heading="Carrying and placing",
                text=(
                    "Demonstrations, the plan made from the learned primitive, and what the "
                    "arm did."
                ),
                figures=(
                    (figures.paths_figure(run), "Paths of the hand."),
                    (figures.joints_figure(run), "Joint positions and their limits."),
                ),
            ),
        ),
        configuration=configuration,
        versions={"python": platform.python_version(), **_versions()},
        rerun_command=command,
    )


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
