"""Which defects of datasets does `hrc check` find? A copy of sound sets for each tells.

The defects stand in tests/value_defects.py and tests/file_defects.py, the sets made here in
tests/clean_sets.py; real ones are given by their path. Every copy is checked by a process of
its own, with a time limit. A defect counts as found where something is said that is not said
of the sound set, naming the episode or the file where the defect has one. Copies that hold
nothing a defect could concern (no video, no gripper) are left out.

    python tools/score_checker.py path/to/dataset --json score.json
"""

import argparse
import json
import sys
import tempfile
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from checker_score import KINDS, Checker, Outcome, outcomes  # noqa: E402
from clean_sets import SETS, write_set  # noqa: E402


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", nargs="*", type=Path, help="sound sets besides our own")
    parser.add_argument("--kinds", default="", help="only kinds whose names hold this")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds a check may take")
    parser.add_argument("--json", type=Path, help="receives every outcome")
    return parser.parse_args()


def line(name: str, results: list[Outcome]) -> str:
    """A row of the table: what was found of how many."""
    severe = [r for r in results if r.severe]
    mild = [r for r in results if not r.severe]
    return (
        f"| {name} | {sum(r.found for r in severe)} of {len(severe)} "
        f"| {sum(r.error for r in severe)} | {sum(r.found for r in mild)} of {len(mild)} "
        f"| {sum(bool(r.crash) for r in results)} | {max(r.seconds for r in results):.1f} s "
        f"| {max(r.megabytes for r in results):.0f} MB |"
    )


def main() -> int:
    args = arguments()
    kinds = [name for name in KINDS if args.kinds in name]
    check, every, clean = Checker(args.limit), [], {}
    by_set: dict[str, list[Outcome]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as temporary:
        work = Path(temporary)
        sets = {
            name: write_set(work / f"set{i}", **SETS[name]) for i, name in enumerate(SETS)
        } | {path.name: path for path in args.dataset}
        for name, root in sets.items():
            found = check(root)[0]
            clean[name] = {
                level: sum(known == level for known, _ in found)
                for level in ("error", "warning")
            }
            for outcome in outcomes(root, name, kinds, work, check):
                by_set[name].append(outcome)
                every.append(outcome)
                if outcome.crash or not outcome.found:
                    print(f"{name}: {outcome.kind}: {outcome.crash or 'not found'}", flush=True)
            if args.json is not None:
                content = {"clean": clean, "outcomes": [asdict(o) for o in every]}
                text = json.dumps(content, indent=1) + "\n"
                args.json.write_text(text, encoding="utf-8")
    print("| | severe | as errors | others | crashes | longest | most memory |")
    print("|---|---|---|---|---|---|---|")
    for name, results in by_set.items():
        print(line(name, results))
    print(line(f"all, {len({o.kind for o in every})} kinds", every))
    for name, counts in clean.items():
        print(f"sound: {name}: {counts['error']} errors, {counts['warning']} warnings")
    return int(any(o.crash for o in every) or any(c["error"] for c in clean.values()))


if __name__ == "__main__":
    raise SystemExit(main())
