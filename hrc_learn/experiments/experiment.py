"""Procedure of every experiment: run once, repeat with other seeds, evaluate, report.

An experiment is a frozen dataclass of its settings with the methods of `Experiment`;
`run_experiment` runs it and writes its results.
"""

import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

from hrc_learn.experiments.metric_table import Evaluation, Metric, Summary, evaluate
from hrc_learn.experiments.run_recorder import film, record
from hrc_learn.experiments.simulated_cell import UNOBSERVED, LiveView, Observer
from hrc_learn.experiments.trials import Trial, TrialFile, TrialRun, repeat
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import MotionLog, PhysicsError, World
from hrc_learn.skills.work_cell import TaskFailedError, WorkCell
from hrc_learn.store import new_folder, write_json
from hrc_learn.viz.report import (
    FILM,
    PAGE,
    Film,
    Report,
    Section,
    show_command,
    show_measurements,
    software_versions,
    write_report,
)
from hrc_learn.viz.run_dashboard import record_run

RUN = "run"
"""Key of the run itself among the recordings of an experiment."""
TRIALS = "trials"
"""Name of the file of the trials."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """A Monte Carlo study that accompanies the run shown in detail."""

    title: str
    """Heading of its section in the report."""
    trial: TrialRun
    """Runs one trial with a seed. It is a frozen dataclass, because it is sent to other
    processes, and its settings are saved with the trials."""
    metrics: Sequence[Metric[Sequence[Trial]]] = ()
    """Rows that the trials add to the table."""
    text: str = ""
    """Description of the differences between trials."""

    def section(self, trials: Sequence[Trial]) -> Section:
        """Section of the report: success rate and failures."""
        summary = Summary.of(trials)
        reasons = [f"Seed {seed}: {reason}." for seed, reason in summary.failed.items()]
        lines = filter(None, [self.text, f"{summary.rate}.", *reasons])
        return Section(heading=self.title, text="\n\n".join(lines))


@runtime_checkable
class ExperimentRun(Protocol):
    """Result of one run, such as a `CellRun`."""

    @property
    def failure(self) -> str:
        """Reason why the task was given up, apart from missed bounds; empty if it was not."""
        ...

    @property
    def log(self) -> LoggedSteps:
        """All columns of the control loop."""
        ...


@runtime_checkable
class Experiment[Run: ExperimentRun](Protocol):
    """Methods that an experiment supplies; `Run` is the result of one run."""

    title: ClassVar[str]
    """Heading of the report."""
    summary: ClassVar[str]
    """Description of the experiment, in plain text; blank lines separate paragraphs."""

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> Run:
        """Draw a scenario from the seed and carry it out once."""
        ...

    def metrics(self) -> Sequence[Metric[Run]]:
        """Metrics of a run, in the order of the report's table."""
        ...

    def recordings(self, run: Run) -> Mapping[str, RunRecording]:
        """Recordings to look at, by the name of the file."""
        ...

    def sections(self, run: Run, recordings: Mapping[str, RunRecording]) -> Sequence[Section]:
        """Text and figures of the report, from the run and its recordings."""
        ...

    def study(self) -> Study:
        """Monte Carlo study of the experiment."""
        ...


@dataclass(frozen=True)
class RepeatedRun:
    """A trial that runs an experiment once; its values are the metrics of the run."""

    experiment: Experiment[Any]

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Run once and measure."""
        run = self.experiment.run(seed)
        found = evaluate(self.experiment.metrics(), run, run.failure)
        return {**found.values, "failure": found.failure}


def evaluate_all[Run: ExperimentRun](
    experiment: Experiment[Run], run: Run, seed: int, trials: Sequence[Trial]
) -> Evaluation:
    """Evaluate a run and its trials.

    Without trials the run itself counts as the only trial, so that the keys of the values do
    not depend on the number of trials. Totals over all trials replace the counts of the run.
    """
    total = evaluate(experiment.metrics(), run, run.failure)
    single = Trial(seed=seed, values=total.values, failure=total.failure)
    values = Summary.of(trials or [single]).figures()
    if trials:
        total += evaluate(experiment.study().metrics, trials)
    return replace(total, values=total.values | values)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options common to all experiments: repetition, outputs and live dashboard."""

    out: Path
    """Folder for recordings, report and measured values."""
    seed: int = 0
    """Seed of the run, and of the first trial."""
    trials: int = 0
    """Number of trials for statistics, with consecutive seeds. The same command resumes
    interrupted trials."""
    processes: int = 1
    """Number of parallel trials."""
    serve: bool = False
    """Serve the dashboard in the browser during the run."""
    film: bool = True
    """Make a film of the run, in the folder and in the report."""
    overwrite: bool = False
    """Replace an earlier run in that folder."""
    json: Path | None = None
    """File for the measured values."""

    def __post_init__(self) -> None:
        """Refuse wrong numbers.

        Raises:
            ValueError: If the number of trials, or the seed, is negative.
        """
        for name in ("trials", "seed"):
            if (number := getattr(self, name)) < 0:
                raise ValueError(f"--{name} must not be negative, but is {number}.")
        check_settings(self, positive=["processes"])


def run_experiment[Run: ExperimentRun](
    experiment: Experiment[Run], options: RunOptions, *, command: str = ""
) -> int:
    """Run an experiment and its trials, write and print the results.

    Args:
        experiment: Experiment to run.
        options: Repetition and outputs.
        command: Command that repeats the experiment, for the report.

    Returns:
        Exit status: 0, or 1 if the run failed or a bound was missed. A run whose physics failed
        leaves no folder, as its measurements would be invalid.
    """
    from rich.console import Console

    configuration = asdict(options) | asdict(experiment)  # pyright: ignore[reportArgumentType]
    console, study = Console(), experiment.study()
    observer = Observer(tell=console.print)
    if options.serve:
        view = live_view(experiment.title, lambda at: console.print(f"Dashboard at {at}"))
        observer = replace(observer, view=view)
    # The folder exists only after the run. The file of trials is therefore kept next to it, so
    # that interrupted trials can resume.
    trial_file = options.out.with_name(f"{options.out.name}.{TRIALS}.jsonl")
    made_by: dict[str, Any] = asdict(study.trial)  # pyright: ignore[reportArgumentType]
    if options.trials and trial_file.exists():  # refuse other settings before the run
        TrialFile(trial_file, made_by).release()
    try:
        with new_folder(options.out, configuration, options.overwrite) as folder:
            with console.status(f"{experiment.title}: running"):
                run = experiment.run(options.seed, observer)
            trials = _run_trials(study, trial_file, made_by, options) if options.trials else []
            results = evaluate_all(experiment, run, options.seed, trials)
            with console.status("Writing recordings and report"):
                parts = _write_recordings(folder, experiment, run, options.film)
                report = Report(
                    title=experiment.title,
                    summary=experiment.summary,
                    table=results.table,
                    film=parts[0],
                    sections=[*parts[1], *([study.section(trials)] if trials else [])],
                    configuration=configuration,
                    versions=software_versions(),
                    command=command,
                )
                write_report(folder, report)
                write_json(folder / "measured.json", results.values)
            if trials:
                shutil.copy(trial_file, folder / f"{TRIALS}.jsonl")
    except PhysicsError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1
    if options.json is not None:
        write_json(options.json, results.values)
    show_measurements(results.table)
    if trials:
        trial_file.unlink()
        print(f"{study.title}: {Summary.of(trials)}")
    _print_outputs(options.out, results, report.film is not None)
    return 0 if results.ok else 1


def _write_recordings[Run: ExperimentRun](
    folder: Path, experiment: Experiment[Run], run: Run, make_film: bool
) -> tuple[Film | None, Sequence[Section]]:
    """Write log and recordings; return the film, if requested, and the report's sections."""
    run.log.save(folder / "log.npz")
    recordings = experiment.recordings(run)
    for name, recording in recordings.items():
        record_run(folder / f"{name}.rrd", recording)
    run_film = film(recordings[RUN]) if make_film and RUN in recordings else None
    return run_film, experiment.sections(run, recordings)


def live_view(title: str, on_open: Callable[[str], None]) -> LiveView:
    """Serve the dashboard of a run on a page of its own.

    The loop only writes its log: another thread makes recordings of the run so far and sends
    them. A page that is open when the run ends keeps its content.

    Args:
        title: Title of the dashboard.
        on_open: Called with the address of the page.
    """

    @contextmanager
    def watch(cell: WorkCell, world: World, motion: MotionLog) -> Iterator[None]:
        # Rerun takes a second to import.
        from hrc_learn.teleoperation.dashboard_page import serve_stream
        from hrc_learn.viz.run_dashboard import live_dashboard

        def snapshot() -> RunRecording | None:
            return record(title, cell, world, motion) if len(motion) else None

        with serve_stream() as (stream, address):
            on_open(address)
            with live_dashboard(stream, snapshot):
                yield

    return watch


def _run_trials(study: Study, file: Path, made_by: dict, options: RunOptions) -> list[Trial]:
    return repeat(
        study.trial,
        range(options.seed, options.seed + options.trials),
        file,
        made_by=made_by,
        processes=options.processes,
        failures=(TaskFailedError, PhysicsError),
        title=study.title,
    )


def _print_outputs(out: Path, results: Evaluation, has_film: bool) -> None:
    if results.failure:
        print(f"failed: {results.failure}", file=sys.stderr)
    # Each path is on one unbroken line, so that it can be copied from a terminal of any width.
    print(f"Report: {shlex.quote(str(out / PAGE))}")
    if has_film:
        print(f"Film: {shlex.quote(str(out / FILM))}")
    print(f"Dashboard: {show_command(out)}")
