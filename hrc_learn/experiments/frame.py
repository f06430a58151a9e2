"""The frame of every experiment: run once, repeat with other seeds, evaluate, report.

An experiment is a frozen dataclass of its settings with the methods of `Experiment`; what a
program does with it is here.
"""

import shlex
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

from hrc_learn.experiments.film import film
from hrc_learn.experiments.imperfection_curve import curve_section
from hrc_learn.experiments.metric_table import Evaluation, Metric, Summary, evaluate
from hrc_learn.experiments.monte_carlo import Run as TrialRun
from hrc_learn.experiments.monte_carlo import Trial, repeat
from hrc_learn.experiments.run_recording import (
    LiveView,
    LiveViewConfig,
    live_view,
    no_live_view,
)
from hrc_learn.log import LoggedSteps, RunRecording
from hrc_learn.sim import Imperfections, PhysicsError
from hrc_learn.skills.failures import TaskFailedError
from hrc_learn.store import new_folder, write_json
from hrc_learn.viz.report import (
    FILM,
    PAGE,
    Measurement,
    Picture,
    Report,
    Section,
    show_command,
    show_measurements,
    software_versions,
    write_report,
)
from hrc_learn.viz.run_dashboard import record_run


@dataclass(frozen=True, kw_only=True)
class Observer:
    """Who looks on while an experiment runs; by default nobody."""

    view: LiveView = no_live_view
    """A dashboard of the run while it goes on."""
    tell: Callable[[str], None] = lambda text: None
    """Shows a line about what happens next."""


UNOBSERVED = Observer()

RUN = "run"
"""Name of the recording of the run itself, among those that an experiment makes."""
TRIALS = "trials"
"""Name of the study whose statistics are the experiment's own."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """A Monte Carlo study beside the run that is shown in detail."""

    title: str
    """Heading of its section in the report."""
    trial: TrialRun
    """Runs one trial with a seed. A frozen dataclass, so that other processes can have it and
    the file of the trials can hold its settings."""
    metrics: Sequence[Metric[Sequence[Trial]]] = ()
    """Rows of the table that its trials add."""
    text: str = ""
    """How the trials differ."""
    pictures: Callable[[Sequence[Trial]], Sequence[Picture]] = lambda trials: ()
    """Figures of the trials."""
    size: float | None = None
    """Of the imperfections, in multiples of the nominal ones: studies that have one are drawn
    against it."""
    shown: Mapping[str, str] = field(default_factory=dict)
    """Values to be drawn against it: labels by their keys."""

    def at_sizes(self, sizes: Sequence[float]) -> dict[str, "Study"]:
        """The same, repeated with each size of the imperfections.

        Args:
            sizes: In multiples of the nominal ones; none for this study alone.

        Returns:
            This study under the name `TRIALS`, those with sizes that differ from its own as
            `imperfections_2` and so on.
        """
        studies: dict[str, Study] = {TRIALS: self}
        for size in sizes:
            repeated = isinstance(self.trial, RepeatedRun)
            settings: Any = self.trial.experiment if repeated else self.trial
            imperfections = Imperfections.nominal().scaled(size)
            if imperfections == settings.imperfections:
                studies[TRIALS] = replace(self, size=size)
                continue
            changed = replace(settings, imperfections=imperfections)
            studies[f"imperfections_{size:g}"] = replace(
                self,
                title=f"{self.title}, imperfections {size:g} times nominal",
                trial=RepeatedRun(changed) if repeated else changed,
                metrics=(),
                pictures=lambda trials: (),
                size=size,
            )
        return studies

    def section(self, trials: Sequence[Trial]) -> Section:
        """The study in the report: success rate, failures, statistics, figures."""
        summary = Summary.of(trials)
        lines = [
            self.text,
            f"{summary.rate}.",
            *(f"Seed {seed}: {reason}." for seed, reason in summary.failed.items()),
        ]
        return Section(
            heading=self.title,
            text="\n\n".join(filter(None, lines)),
            figures=self.pictures(trials),
        )


@runtime_checkable
class Experiment[Run](Protocol):
    """What an experiment supplies; `Run` is what one run leaves to be evaluated and drawn."""

    title: ClassVar[str]
    """Heading of the report."""
    summary: ClassVar[str]
    """What is done, in plain text; blank lines part paragraphs."""

    def run(self, seed: int, observer: Observer = UNOBSERVED) -> Run:
        """Draw a scenario from the seed and carry it out once."""
        ...

    def failure(self, run: Run) -> str:
        """Why the task gave up; empty if it did not. Missed metrics are found by the frame."""
        ...

    def metrics(self) -> Sequence[Metric[Run]]:
        """What is measured of a run, in the order of the report's table."""
        ...

    def recordings(self, run: Run) -> Mapping[str, RunRecording]:
        """Recordings to look at, by the name of the file."""
        ...

    def log(self, run: Run) -> LoggedSteps:
        """All columns of the control loop."""
        ...

    def sections(self, run: Run, recordings: Mapping[str, RunRecording]) -> Sequence[Section]:
        """Text and figures of the report, from the run and its recordings."""
        ...

    def studies(self) -> Mapping[str, Study]:
        """Monte Carlo studies by the names of their files, the one named `TRIALS` first."""
        ...


@dataclass(frozen=True)
class RepeatedRun:
    """An experiment as one trial of many: its metrics are the values of the trial."""

    experiment: Experiment[Any]

    def __call__(self, seed: int) -> Mapping[str, Any]:
        """Run once and measure."""
        run = self.experiment.run(seed)
        evaluation = evaluate(self.experiment.metrics(), run)
        failure = failure_of(self.experiment.failure(run), evaluation)
        return {**evaluation.values, "failure": failure}


def failure_of(given_up: str, evaluation: Evaluation) -> str:
    """Why a run was no success: the task gave up, or an essential bound was missed."""
    return "; ".join(filter(None, (given_up, *evaluation.faults)))


@dataclass(frozen=True, kw_only=True)
class Results:
    """What a run and the studies beside it came to."""

    table: tuple[Measurement, ...]
    values: dict[str, float | int]
    """Of run and studies, as written to JSON."""
    failure: str
    """Why the run was no success; empty if it was."""

    @classmethod
    def of[Run](
        cls,
        experiment: Experiment[Run],
        run: Run,
        seed: int,
        trials: Mapping[str, Sequence[Trial]],
    ) -> "Results":
        """Evaluate.

        Statistics of the study `TRIALS` have no prefix; without it they are those of the run
        itself, so that the same keys are there in any case.
        """
        total = evaluate(experiment.metrics(), run)
        failure = failure_of(experiment.failure(run), total)
        single = Trial(seed=seed, values=total.values, failure=failure)
        values = Summary.of(trials.get(TRIALS) or [single]).figures()
        for name, study in experiment.studies().items():
            if known := trials.get(name):
                total += evaluate(study.metrics, known)
                if name != TRIALS:
                    summary = Summary.of(known).figures()
                    values |= {f"{name}_{key}": value for key, value in summary.items()}
        return cls(
            table=total.table,
            # Totals over all trials take the place of the counts of the single run.
            values=total.values | values,
            failure=failure,
        )

    @property
    def ok(self) -> bool:
        """Whether the run succeeded and every bound of the table is kept."""
        return not self.failure and all(m.ok is not False for m in self.table)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How an experiment is run and where its results go: options that all programs share."""

    out: Path
    """Folder for recordings, report and measured values."""
    seed: int = 0
    """Seed of the run; the first one of the trials."""
    trials: int = 0
    """Repeat with so many seeds besides, and sum up. A stopped repetition goes on with the
    same command."""
    processes: int = 1
    """Of the trials, at once."""
    serve: bool = False
    """Serve the dashboard of the run in the browser while it goes on."""
    serving: LiveViewConfig = field(default_factory=LiveViewConfig)
    """Where, with --serve."""
    film: bool = True
    """Make a film of the run, in the folder and in the report."""
    verbose: bool = False
    """Show all that was measured, not just the first of it."""
    overwrite: bool = False
    """Replace an older run in that folder."""
    json: Path | None = None
    """File for the measured values."""

    @classmethod
    def of(cls, args: object) -> "RunOptions":
        """Those of a command line that has options of the same names."""
        return cls(**{option.name: getattr(args, option.name) for option in fields(cls)})


def conduct[Run](
    experiment: Experiment[Run],
    options: RunOptions,
    *,
    counts: Mapping[str, int] | None = None,
    configuration: Mapping[str, object] | None = None,
    command: str = "",
) -> int:
    """Run an experiment and its studies, write and show the results.

    Args:
        experiment: What to run.
        options: How, and where results go.
        counts: Number of trials of studies other than `TRIALS`, by name.
        configuration: For the report; the options and the experiment's settings if None.
        command: That repeats all this; the command line of this process if empty.

    Returns:
        Exit status: 0, or 1 if the run failed or a bound was missed. A run whose physics failed
        leaves no folder, as nothing measured of it would hold.

    Raises:
        ValueError: If a number of trials is negative.
    """
    try:
        return _conduct(experiment, options, counts, configuration, command)
    except PhysicsError as error:
        print(f"failed: {error}", file=sys.stderr)
        return 1


def _conduct[Run](
    experiment: Experiment[Run],
    options: RunOptions,
    counts: Mapping[str, int] | None,
    configuration: Mapping[str, object] | None,
    command: str,
) -> int:
    from rich.console import Console

    studies = experiment.studies()
    by_size = [name for name, study in studies.items() if study.size is not None]
    counts = dict.fromkeys([TRIALS, *by_size], options.trials) | dict(counts or {})
    if negative := [name for name, count in counts.items() if count < 0]:
        raise ValueError(f"--{negative[0]} must not be negative, but is {counts[negative[0]]}.")
    if configuration is None:
        configuration = asdict(options) | asdict(experiment)  # pyright: ignore[reportArgumentType]
    console, view = Console(), no_live_view
    if options.serve:
        view = live_view(
            experiment.title, options.serving, lambda at: console.print(f"Dashboard at {at}")
        )
    # Beside the folder, which is there only when all is done: a stopped run goes on.
    files = {
        name: options.out.with_name(f"{options.out.name}.{name}.jsonl")
        for name in studies
        if counts.get(name)
    }
    with new_folder(options.out, configuration, options.overwrite) as folder:
        with console.status(f"{experiment.title}: running"):
            run = experiment.run(options.seed, Observer(view=view, tell=console.print))
        trials = {
            name: _repeat(studies[name], counts[name], file, options)
            for name, file in files.items()
        }
        results = Results.of(experiment, run, options.seed, trials)
        with console.status("Writing recordings"):
            recordings = experiment.recordings(run)
            for name, recording in recordings.items():
                record_run(folder / f"{name}.rrd", recording)
            experiment.log(run).save(folder / "log.npz")
        shown = None
        if options.film and (recording := recordings.get(RUN)) is not None:
            with console.status("Making the film"):
                shown = film(recording)
        with console.status("Writing the report"):
            report = Report(
                title=experiment.title,
                summary=experiment.summary,
                table=results.table,
                film=shown,
                sections=(
                    *experiment.sections(run, recordings),
                    *(studies[name].section(known) for name, known in trials.items()),
                    *_curve(studies, trials),
                ),
                configuration=configuration,
                versions=software_versions(),
                command=command or shlex.join(["python", *sys.argv]),
            )
            write_report(folder, report)
            write_json(folder / "measured.json", results.values)
            for name, file in files.items():
                shutil.copy(file, folder / f"{name}.jsonl")
    for file in files.values():
        file.unlink()
    if options.json is not None:
        write_json(options.json, results.values)
    show_measurements(results.table, options.verbose)
    for name, known in trials.items():
        console.print(Summary.of(known).table(studies[name].title))
    if results.failure:
        print(f"failed: {results.failure}", file=sys.stderr)
    # On lines of their own and unbroken, to be pasted whatever the width of the terminal.
    print(f"Report: {shlex.quote(str(options.out / PAGE))}")
    if shown is not None:
        print(f"Film: {shlex.quote(str(options.out / FILM))}")
    print(f"Dashboard: {show_command(options.out)}")
    return 0 if results.ok else 1


def _curve(
    studies: Mapping[str, Study], trials: Mapping[str, Sequence[Trial]]
) -> Sequence[Section]:
    """The section about the sizes of imperfections, of two or more."""
    sized = {
        size: known
        for name, known in trials.items()
        if (size := studies[name].size) is not None
    }
    return [curve_section(sized, studies[TRIALS].shown)] if len(sized) > 1 else []


def _repeat(study: Study, count: int, file: Path, options: RunOptions) -> list[Trial]:
    return repeat(
        study.trial,
        range(options.seed, options.seed + count),
        file,
        made_by=asdict(study.trial),  # pyright: ignore[reportArgumentType]
        processes=options.processes,
        failures=(TaskFailedError, PhysicsError),
        title=study.title,
    )
