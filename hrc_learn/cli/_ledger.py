"""Which steps of a job need not be done again, as what they made is there and unchanged."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from hrc_learn.store import write_text
from hrc_learn.viz.report import software_versions


class Ledger:
    """Remembers what each folder was made of and what it held then.

    A step is done again when its options, the contents of the folders that it reads, the code
    of this package or the versions of the libraries are others, or when its result was changed
    by somebody else.
    """

    def __init__(self, path: Path):
        """Open a ledger.

        Args:
            path: File that keeps it; one that cannot be read counts as empty, so that all is
                done again.
        """
        self._path = path
        try:
            entries = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            entries = {}
        self._entries: dict[str, str] = entries if isinstance(entries, dict) else {}
        code = contents(Path(__file__).parents[1], "*.py")
        self._software = [*software_versions().items(), code]

    def holds(self, folder: Path, options: Mapping[str, object], *reads: Path) -> bool:
        """Whether a folder is there as a step with these options would make it.

        Args:
            folder: Result of the step.
            options: Of the step; paths and the like count by their text.
            reads: Folders that it reads.
        """
        return folder.is_dir() and self._entries.get(folder.name) == self._entry(
            folder, options, reads
        )

    def enter(self, folder: Path, options: Mapping[str, object], *reads: Path) -> None:
        """Note that a step has just made a folder; arguments as in `holds`."""
        self._entries[folder.name] = self._entry(folder, options, reads)
        write_text(self._path, json.dumps(self._entries, indent=2) + "\n")

    def _entry(
        self, folder: Path, options: Mapping[str, object], reads: tuple[Path, ...]
    ) -> str:
        made_of = [
            self._software,
            options,
            *(contents(path) for path in reads),
            contents(folder),
        ]
        text = json.dumps(made_of, default=str, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def contents(folder: Path, pattern: str = "*") -> str:
    """Digest of the names and bytes of all files in a folder that match a pattern."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob(pattern) if path.is_file()):
        digest.update(
            f"{path.relative_to(folder).as_posix()}\0{path.stat().st_size}\0".encode()
        )
        digest.update(path.read_bytes())
    return digest.hexdigest()
