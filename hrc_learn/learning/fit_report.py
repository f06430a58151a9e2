"""What a fit came to, as a page."""

from collections.abc import Mapping, Sequence

from hrc_learn.viz.figures import fit_joints_figure, residual_figure, seen_figure
from hrc_learn.viz.recordings import FitRecording
from hrc_learn.viz.report import Measurement, Picture, Report, Section, software_versions


def fit_report(
    fit: FitRecording,
    table: Sequence[Measurement],
    configuration: Mapping[str, object],
    command: str,
) -> Report:
    """Measured values, what the cameras saw of the demonstrations, and how they were followed.

    Args:
        fit: Demonstrations beside their reproductions.
        table: What was measured.
        configuration: Of the fit.
        command: The command line that fits again.
    """
    sections = []
    if fit.images:
        caption = "What the first camera saw of the first demonstrations, a row each."
        sections.append(
            Section(
                heading="Demonstrations",
                figures=[Picture("demonstrations", seen_figure(fit.images), caption)],
            )
        )
    moved = "joints" if fit.unit == "rad" else "position"
    caption = "The first four demonstrations, each with what its primitive makes of it."
    figures = [Picture(moved, fit_joints_figure(fit), caption)]
    if fit.residual:
        caption = "How many basis functions were tried, and which number was taken."
        figures.append(Picture("n_basis", residual_figure(fit), caption))
    sections.append(Section(heading="Reproductions", figures=figures))
    basis = "" if fit.n_basis is None else f" of {fit.n_basis} basis functions"
    return Report(
        title=fit.title,
        summary=f"A movement primitive{basis} for each demonstration, and one for all of them.",
        table=table,
        sections=sections,
        configuration=configuration,
        versions=software_versions(),
        command=command,
    )
