"""The report that tells how a run of the collaboration went."""

from collections.abc import Mapping, Sequence

from hrc_learn.experiments.collaboration.experiment import SimulatedJob
from hrc_learn.experiments.monte_carlo import Summary, Trial
from hrc_learn.viz import RunRecording
from hrc_learn.viz.report import Measurement, Picture, Report, Section, software_versions


def collaboration_report(
    run: RunRecording,
    job: SimulatedJob,
    table: Sequence[Measurement],
    configuration: Mapping[str, object],
    command: str,
    trials: Sequence[Trial] = (),
) -> Report:
    """Figures, table and how to do it again.

    Args:
        run: What happened.
        job: The run it was recorded from.
        table: What was measured.
        configuration: Of the run.
        command: That repeats it.
        trials: The same job with other seeds.
    """
    objects = {pick.item.name: pick.span for pick in job.picks}
    sections = [
        _overview(run, job, objects),
        _grasping(run, objects),
        _person(run),
        _placing(run, objects),
    ]
    if trials:
        sections.append(_trials(trials))
    return Report(
        title=run.title,
        summary=(
            "An arm grasps objects with a camera that nobody calibrated, while a person pulls "
            "its elbow aside to reach under it. It then carries each to a cabinet along a "
            "motion learned from demonstrations of hand and body shape at once, and puts it on "
            "a shelf. Simulated in MuJoCo; success is read from contacts there."
        ),
        table=table,
        sections=sections,
        configuration=configuration,
        versions=software_versions(),
        command=command,
    )


def _overview(
    run: RunRecording, job: SimulatedJob, objects: Mapping[str, tuple[float, float]]
) -> Section:
    from hrc_learn.experiments.collaboration import figures

    notes = [
        f"{note.time:.1f} s, {pick.item.name}: {note.mishap}: {note.what}."
        for pick in job.picks
        for note in pick.recoveries
    ]
    return Section(
        heading="The job",
        text=(
            "A state machine: look, aim, give the person time, grasp, carry home, transfer, "
            "release, retreat. " + (" ".join(notes) if notes else "Nothing went wrong.")
        ),
        figures=(
            Picture("timeline", figures.timeline_figure(run, objects), "Phases over time."),
        ),
    )


def _grasping(run: RunRecording, objects: Mapping[str, tuple[float, float]]) -> Section:
    from hrc_learn.experiments.collaboration import figures as collaboration_figures
    from hrc_learn.viz import figures

    return Section(
        heading="Grasping with an uncalibrated camera",
        text=(
            "The hand's marker is brought to where demonstrations had it above the object. The "
            "image Jacobian was learned from them, and adapts online, also to a camera that "
            "was moved."
        ),
        figures=(
            Picture(
                "marker",
                collaboration_figures.marker_figure(run, objects),
                "The marker's paths, over the camera's first image, and its distance from the "
                "target.",
            ),
            Picture(
                "image_jacobian",
                figures.image_jacobian_figure(run),
                "Image Jacobian: the controller's estimate, and the simulator's truth.",
            ),
        ),
    )


def _person(run: RunRecording) -> Section:
    from hrc_learn.experiments.collaboration import figures as collaboration_figures
    from hrc_learn.viz import figures

    return Section(
        heading="The person",
        text=(
            "The pull acts in the null space of the hand's task: the elbow yields, the hand "
            "stays."
        ),
        figures=(
            Picture(
                "hand",
                collaboration_figures.hand_figure(run),
                "Translation and orientation of the hand, and the person's effort.",
            ),
            Picture("person", figures.person_figure(run), "Effort, elbow and hand, enlarged."),
        ),
    )


def _placing(run: RunRecording, objects: Mapping[str, tuple[float, float]]) -> Section:
    from hrc_learn.experiments.collaboration import figures as collaboration_figures
    from hrc_learn.viz import figures

    return Section(
        heading="Carrying and placing",
        text="The demonstration, and what the arm did with every object.",
        figures=(
            Picture(
                "trajectories",
                collaboration_figures.trajectories_figure(run, objects),
                "Paths of the hand.",
            ),
            Picture("joints", figures.joints_figure(run), "Joint positions and their limits."),
        ),
    )


def _trials(trials: Sequence[Trial]) -> Section:
    """The repetition in words."""
    summary = Summary.of(trials)
    low, high = summary.interval
    lines = [
        f"{summary.successes} of {summary.trials} seeds succeeded "
        f"({100 * low:.1f} to {100 * high:.1f} % with 95 % confidence).",
        *(f"Seed {seed}: {reason}." for seed, reason in summary.failed.items()),
        *(
            f"{name.replace('_', ' ')}: median {spread.median:.3g}, "
            f"95 % below {spread.p95:.3g}."
            for name, spread in summary.spread.items()
        ),
    ]
    return Section(heading="Other seeds", text="\n\n".join(lines))
