"""The report that tells how a run of the collaboration went."""

from collections.abc import Mapping, Sequence

from ..viz import RunRecording
from ..viz.report import Measurement, Picture, Report, Section, software_versions


def collaboration_report(
    run: RunRecording,
    table: Sequence[Measurement],
    configuration: Mapping[str, object],
    command: str,
) -> Report:
    """Figures, table and how to do it again.

    Args:
        run: What happened.
        table: What was measured.
        configuration: Of the run.
        command: That repeats it.
    """
    from ..viz import figures

    return Report(
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
                    Picture(
                        "image",
                        figures.image_figure(run),
                        "The marker's path in the image, and its error.",
                    ),
                    Picture(
                        "image_jacobian",
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
                figures=(
                    Picture("person", figures.person_figure(run), "Effort, elbow and hand."),
                ),
            ),
            Section(
                heading="Carrying and placing",
                text=(
                    "Demonstrations, the plan made from the learned primitive, and what the "
                    "arm did."
                ),
                figures=(
                    Picture("paths", figures.paths_figure(run), "Paths of the hand."),
                    Picture(
                        "joints",
                        figures.joints_figure(run),
                        "Joint positions and their limits.",
                    ),
                ),
            ),
        ),
        configuration=configuration,
        versions=software_versions(),
        command=command,
    )
