"""`hrc push`: a dataset to the Hugging Face Hub."""

import sys

from hrc_learn.cli._run import one_line, write_values
from hrc_learn.cli.arguments.dataset import Push
from hrc_learn.demos import push_dataset


def push(args: Push) -> int:
    """Check the dataset, send it, and say where it is."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError

    try:
        pushed = push_dataset(
            args.dataset,
            args.repo,
            private=args.private,
            license=args.license,
            tags=args.tags,
            description=args.description,
            revision=args.branch,
            videos=args.videos,
            unsound=args.unsound,
            dry_run=args.dry_run,
        )
    except HfHubHTTPError as error:
        print(f"error: the Hub refuses: {one_line(error)}{_advice(error)}", file=sys.stderr)
        return 1
    except httpx.TransportError as error:
        print(f"error: the Hub cannot be reached: {one_line(error)}", file=sys.stderr)
        return 1
    if args.dry_run:
        print(pushed.card)
        print(*(f"{size:12d}  {file}" for file, size in pushed.files.items()), sep="\n")
    what = f"{len(pushed.files)} files, {pushed.bytes / 1e6:.1f} MB"
    place = pushed.url or f"{pushed.repo}, nothing sent"
    print(f"{what}, tag {pushed.tag}: {place}")
    if args.license is None and "license:" not in pushed.card:
        print("no licence is given: --license says what others may do with it")
    values = {
        "files": len(pushed.files),
        "bytes": pushed.bytes,
        "errors": len(pushed.report.errors),
        "warnings": len(pushed.report.warnings),
    }
    write_values(args.json, values)
    return 0


def _advice(error: Exception) -> str:
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status in (401, 403):
        return " (`hf auth login` with a token that may write there)"
    return ""
