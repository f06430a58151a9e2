"""Record of finished steps of a job, so that steps whose results are up to date are skipped."""

import hashlib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from hrc_learn.store import json_text, read_json, write_json
from hrc_learn.viz.report import software_versions


class Ledger:
    """Digests of the inputs and the contents of each result folder.

    A step is repeated when its options, the folders that it reads, the code of this package,
    the versions of the libraries or the contents of its result have changed.
    """

    def __init__(self, path: Path):
        """Open a ledger.

        Args:
            path: JSON file. One that cannot be read counts as empty, so that every step is
                repeated.
        """
        self._path = path
        self._entries: dict[str, str] = {}
        with suppress(OSError, ValueError):
            self._entries = read_json(path)
        code = contents(Path(__file__).parents[1], "*.py")
        self._software = [*software_versions().items(), code]

    def holds(self, folder: Path, options: Mapping[str, object], *reads: Path) -> bool:
        """True if a result folder is up to date.

        Args:
            folder: Result of the step.
            options: Options of the step, compared by their text.
            reads: Folders that the step reads.
        """
        return folder.is_dir() and self._entries.get(folder.name) == self._entry(
            folder, options, reads
        )

    def enter(self, folder: Path, options: Mapping[str, object], *reads: Path) -> None:
        """Record that a step has just made a folder, with arguments as in `holds`."""
        self._entries[folder.name] = self._entry(folder, options, reads)
        write_json(self._path, self._entries)

    def _entry(
        self, folder: Path, options: Mapping[str, object], reads: tuple[Path, ...]
    ) -> str:
        made_of = [
            self._software,
            options,
            *(contents(path) for path in reads),
            contents(folder),
        ]
        text = json_text(made_of)
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
