"""`hrc curate`: which episodes stay, decided in the browser or the terminal."""

import os
import sys
import webbrowser
from itertools import combinations

from rich.console import Console
from rich.progress import track

from hrc_learn.cli._options import resolved
from hrc_learn.cli._run import write_values
from hrc_learn.cli.arguments.dataset import Curate
from hrc_learn.cli.commands.check import columns
from hrc_learn.demos.quality.decisions import (
    Decisions,
    decide,
    decisions_path,
    keep_decisions,
    read_decisions,
    write_curated,
)
from hrc_learn.demos.quality.ranking import Ranking, rank_episodes

_SHOWN = 20
"""Episodes of a ranking that fit on a screen."""


def curate(args: Curate) -> None:
    """Rank the episodes, and have it decided which of them stay.

    Raises:
        FileNotFoundError: There is no dataset.
        ValueError: An episode is decided on twice, or does not exist, or a cut leaves nothing.
    """
    args = resolved(args)
    _refuse_contradictions(args)
    if not args.dataset.is_dir():
        raise FileNotFoundError(f"there is no dataset at {args.dataset}")
    ranking = rank_episodes(
        args.dataset,
        columns(args.mapping),
        args.units,
        progress=lambda episodes: track(episodes, description="Ranking", transient=True),
    )
    decisions = _as_typed(args, ranking)
    if args.browser and not args.write:
        decisions = _in_browser(args, ranking)
    else:
        print(*ranking.lines(None if args.full else _SHOWN), sep="\n")
    values = {
        "episodes": len(ranking.episodes),
        "episodes_in_doubt": sum(q.score > 0 for q in ranking.episodes),
        "episodes_broken": sum(q.broken for q in ranking.episodes),
        "groups": sum(number >= 0 for number in ranking.clusters),
        "episodes_rejected": sum(d.verdict == "reject" for d in decisions.values()),
        "episodes_cut": sum(d.verdict == "cut" for d in decisions.values()),
    }
    if args.write:
        report = write_curated(
            args.dataset,
            args.folder,
            decisions,
            mapping=columns(args.mapping),
            units=args.units,
            progress=lambda episodes: track(episodes, description="Writing", transient=True),
        )
        values["frames"] = report.frames
        print(
            f"{args.folder}: {len(report.changes)} episodes, {report.frames} of "
            f"{report.frames_before} frames"
        )
    elif decisions:
        print(
            f"decisions kept in {decisions_path(args.dataset)}; hrc curate {args.dataset} "
            f"--write makes the cleaned set"
        )
    write_values(args.json, values)


def _refuse_contradictions(args: Curate) -> None:
    options = {"accept": {*args.accept}, "cut": {*args.cut}, "reject": {*args.reject}}
    for (one, first), (other, second) in combinations(options.items(), 2):
        if first & second:
            raise ValueError(
                f"--{one} and --{other} both name episode {min(first & second)}: decide on one"
            )


def _as_typed(args: Curate, ranking: Ranking) -> Decisions:
    """What was decided before, and what is decided on the command line; kept."""
    decisions = read_decisions(args.dataset)
    lengths = {quality.episode: quality.length for quality in ranking.episodes}
    unknown = sorted({*args.reject, *args.accept, *args.cut} - {*lengths})
    if unknown:
        raise ValueError(
            f"there is no episode {unknown[0]}; the dataset has {min(lengths)} to "
            f"{max(lengths)}"
        )
    for episode in args.accept:
        decisions[episode] = decide("accept", lengths[episode])
    for episode, text in args.cut.items():
        try:
            start, stop = (int(part) for part in text.split(":"))
            decisions[episode] = decide("cut", lengths[episode], start, stop)
        except ValueError as error:
            raise ValueError(
                f"--cut {episode} {text}: give the first frame that stays and the one after "
                f"the last, such as 30:410, of {lengths[episode]} ({error})"
            ) from error
    for episode in args.reject:
        decisions[episode] = decide("reject", lengths[episode])
    if args.accept or args.cut or args.reject:
        keep_decisions(args.dataset, decisions)
    return decisions


def _in_browser(args: Curate, ranking: Ranking) -> Decisions:
    """Serve the page until Ctrl-C."""
    # The gate, which the terminal does without.
    from hrc_learn.teleoperation.curation_page import CurationPage

    console = Console()
    mapping = columns(args.mapping)
    page = CurationPage(ranking, args.folder, args.page, mapping=mapping, units=args.units)
    with page:
        console.print(f"Page at [bold]{page.url}[/] (Ctrl-C ends it)", soft_wrap=True)
        if _has_screen():
            webbrowser.open(page.url)
        try:
            page.wait()
        except KeyboardInterrupt:
            print()
        return dict(page.decisions)


def _has_screen() -> bool:
    return not sys.platform.startswith("linux") or any(
        os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")
    )
