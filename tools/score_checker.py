"""Score `hrc check` on copies of sound datasets, each with one kind of defect.

The defects are defined in tests/value_defects.py and tests/file_defects.py, the synthetic
sets in tests/clean_sets.py; real sets are given by their path. Every copy is checked by its own
process with a time limit. A defect counts as found if there is a message that the sound set
does not give, naming the episode or file of the defect. Defects that do not apply to a set (no
video, no gripper) are left out.

    python tools/score_checker.py path/to/dataset --json score.json

With `--peers FOLDER` other checkers see the same copies; tests/peer_checkers.py tells how to
install them. A checker that cannot open the sound set is left out for it.
"""

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from checker_score import KINDS, Checker, Outcome, outcomes  # noqa: E402
from clean_sets import SETS, write_set  # noqa: E402
from peer_checkers import PEERS, cannot_open  # noqa: E402

OURS = "hrc check"
Scored = tuple[str, str, Outcome]
"""Set, checker and outcome of one broken copy."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", nargs="*", type=Path, help="sound sets besides our own")
    parser.add_argument("--kinds", default="", help="only kinds whose names hold this")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds a check may take")
    parser.add_argument("--sets", default="", help="only own sets whose names hold this")
    parser.add_argument("--peers", type=Path, help="folder with other checkers")
    parser.add_argument("--json", type=Path, help="receives every outcome")
    return parser.parse_args()


def score(
    checker: str, sets: Mapping[str, Path], work: Path, args: argparse.Namespace
) -> tuple[list[Scored], dict[str, Mapping[str, int]]]:
    """Outcomes of a checker for all copies, and its messages on the sound sets."""
    if checker == OURS:
        check = Checker(args.limit)
    else:
        sys.path.insert(0, str(args.peers.resolve()))
        check = Checker(args.limit, *PEERS[checker])
    kinds = [name for name in KINDS if args.kinds in name]
    every: list[Scored] = []
    sound: dict[str, Mapping[str, int]] = {}
    for name, root in sets.items():
        lines, crash, _, _ = check(root)
        if crash or cannot_open(lines):
            print(f"{checker} does not open {name}: {crash or lines[0][1]}"[:300])
            continue
        sound[name] = {
            level: sum(known == level for known, _ in lines) for level in ("error", "warning")
        }
        for outcome in outcomes(root, name, kinds, work, check):
            every.append((name, checker, outcome))
            if checker == OURS and (outcome.crash or not outcome.found):
                print(f"{name}: {outcome.kind}: {outcome.crash or 'not found'}", flush=True)
    return every, sound


def line(name: str, checker: str, results: Sequence[Outcome]) -> str:
    """A row of the table: what was found of how many."""
    severe = [r for r in results if r.severe]
    mild = [r for r in results if not r.severe]
    return (
        f"| {name} | {checker} | {sum(r.found for r in severe)} of {len(severe)} "
        f"| {sum(r.error for r in severe)} | {sum(r.found for r in mild)} of {len(mild)} "
        f"| {sum(r.noticed for r in results)} of {len(results)} "
        f"| {sum(bool(r.crash) for r in results)} "
        f"| {sum(r.seconds for r in results) / len(results):.2f} s "
        f"| {max(r.megabytes for r in results):.0f} MB |"
    )


def compare(every: Sequence[Scored]) -> None:
    """Kinds that a checker noticed and ours did not find, and how many the other way round."""
    found = {(name, outcome.kind): outcome.found for name, who, outcome in every if who == OURS}
    for checker in dict.fromkeys(who for _, who, _ in every if who != OURS):
        theirs = {(name, o.kind): o for name, who, o in every if who == checker}
        alone = [place for place, o in theirs.items() if o.noticed and not found[place]]
        ours = sum(not o.noticed and found[place] for place, o in theirs.items())
        print(f"{checker} alone: {len(alone)}; {OURS} alone: {ours}")
        for name, kind in alone:
            print(f"    {name}: {kind}: {'; '.join(theirs[name, kind].said)[:200]}")


def main() -> int:
    args = arguments()
    # LeRobot would ask the Hub for whatever it cannot open.
    os.environ["HF_HUB_OFFLINE"] = "1"
    every: list[Scored] = []
    sound: dict[str, Mapping[str, Mapping[str, int]]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        os.environ["HF_DATASETS_CACHE"] = str(work / "cache")
        sets = {
            name: write_set(work / f"set{i}", **SETS[name])
            for i, name in enumerate(SETS)
            if args.sets in name
        } | {path.name: path.resolve() for path in args.dataset}
        for checker in (OURS, *(PEERS if args.peers is not None else ())):
            # In a process of its own, so that none holds what another imported.
            with ProcessPoolExecutor(1, get_context("spawn")) as pool:
                found, sound[checker] = pool.submit(score, checker, sets, work, args).result()
            every += found
            if args.json is not None:
                content = [{"checker": who} | asdict(o) for _, who, o in every]
                text = json.dumps({"clean": sound, "outcomes": content}, indent=1)
                args.json.write_text(f"{text}\n", encoding="utf-8")
    head = "| set | checker | severe | as errors | others | noticed | crashes | mean | most |"
    print(head, "|---" * head.count(" |") + "|", sep="\n")
    for place in dict.fromkeys((name, who) for name, who, _ in every):
        print(line(*place, [o for name, who, o in every if (name, who) == place]))
    for who in dict.fromkeys(who for _, who, _ in every):
        results = [o for _, checker, o in every if checker == who]
        print(line(f"all, {len({o.kind for o in results})} kinds", who, results))
    for checker, of_sets in sound.items():
        for name, counts in of_sets.items():
            said = f"{counts['error']} errors, {counts['warning']} warnings"
            print(f"sound: {name}, {checker}: {said}")
    compare(every)
    broken = any(o.crash for _, who, o in every if who == OURS)
    return int(broken or any(counts["error"] for counts in sound[OURS].values()))


if __name__ == "__main__":
    raise SystemExit(main())
