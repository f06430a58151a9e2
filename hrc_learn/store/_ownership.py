"""Ownership of files: those written by this package may be deleted with their folder."""

import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from hrc_learn.store._disk import entries, matches
from hrc_learn.store._reading import json_text, read_json

MADE_BY = "made_by.json"
"""File in each folder of results that records its inputs."""
MANIFEST = ".manifest.json"
"""File that lists all other files of a folder, with their checksums."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Kind of folder that this package writes; only a folder of the same kind replaces it."""

    name: str
    mark: str
    """File that identifies a folder without a manifest."""
    says: tuple[str, str] | None = None
    """Field and value that this JSON file must hold; None if its existence is enough."""
    files: tuple[str, ...]
    """Patterns of the files owned by a folder without a manifest; * matches / too."""


_MODEL_FILES = ("config.json", "model.safetensors")
_MODELS = ("joint", "position", "orientation", "pose", "jacobian")

MODEL = Kind(
    name="saved model",
    mark="config.json",
    says=("format", "hrc_learn"),
    files=_MODEL_FILES,
)
EXPORT = Kind(
    name="export",
    mark="primitive/config.json",
    says=("format", "hrc_learn"),
    files=("step.pt2", *(f"primitive/{file}" for file in _MODEL_FILES)),
)
DATASET = Kind(
    name="dataset",
    mark="meta/hrc_learn.json",
    files=(
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        "meta/hrc_learn.json",
        "meta/episodes/chunk-*/file-*.parquet",
        "data/chunk-*/file-*.parquet",
        "videos/*/chunk-*/file-*.mp4",
    ),
)
# Files written by programs before there were manifests.
RESULTS = Kind(
    name="folder of results",
    mark=MADE_BY,
    files=(
        MADE_BY,
        *("measured.json", "metrics.json", "gains.json", "log.npz"),
        *("report.html", "report.json", "figures/*.png", "figures/*.svg"),
        *("fit.rrd", "run.rrd", "run_*.rrd", "compared_*.rrd"),
        *("trials.jsonl", "grasps.jsonl", "starts.jsonl", "lessons.jsonl"),
        *("error_map.png", "learning.png", "search.png", "n_basis.png", "joints.png"),
        *(f"{model}.png" for model in _MODELS),
        *("visual_target.json", "approach.json"),
        *(
            f"{folder}{model}/{file}"
            for folder in ("", "each/", "contextual/")
            for model in _MODELS
            for file in _MODEL_FILES
        ),
        # Checkpoint of a policy.
        *(*_MODEL_FILES, "policy_preprocessor*", "policy_postprocessor*"),
    ),
)


def owned_entries(folder: Path, kind: Kind, *, adopt: bool = False) -> set[str] | None:
    """Entries of a folder that its writer made, and that may be deleted with it.

    Args:
        folder: The folder.
        kind: Expected kind.
        adopt: Accept the folder as one of the kind, and all files with matching names as its
            own, regardless of mark and manifest.

    Returns:
        Relative paths, those of folders with "/" at the end; None for a folder of another
        kind.
    """
    if not folder.is_dir():
        return None
    present = entries(folder)
    if not present:
        return set()  # nothing could be lost
    manifest = _read_manifest(folder)
    if manifest is not None and manifest.kind != kind.name:
        return None
    if manifest is None and not adopt and not _is_marked(folder, kind):
        return None
    owned = set() if manifest is None else _listed(folder, manifest)
    if manifest is None or adopt:
        owned |= {entry for entry in present if matches(entry, kind.files)}
        owned |= {f"{parent.as_posix()}/" for entry in owned for parent in Path(entry).parents}
    return present & owned


@dataclass(frozen=True, kw_only=True)
class _Manifest:
    format: Literal["hrc_learn manifest"] = "hrc_learn manifest"
    version: Literal[1] = 1
    kind: str
    source: str = ""
    entries: list[str]
    """All files and folders of the folder, the latter with "/" at the end."""
    sha256: dict[str, str] = field(default_factory=dict)
    """Checksums of the files, by entry."""


def write_manifest(folder: Path, kind: Kind, source: str) -> None:
    """Write the manifest of a folder, whose whole content was written here."""
    names = sorted(entries(folder) - {MANIFEST})
    checksums = {name: _checksum(folder / name) for name in names if (folder / name).is_file()}
    manifest = _Manifest(kind=kind.name, source=source, entries=names, sha256=checksums)
    (folder / MANIFEST).write_text(json_text(manifest), encoding="utf-8")


def changed_files(folder: str | os.PathLike[str]) -> list[str]:
    """Files of a folder that have changed, or are missing, since this package wrote it.

    Returns:
        Paths relative to the folder; none for a folder without a manifest.

    Raises:
        ValueError: The manifest is damaged.
    """
    folder = Path(folder)
    if not (folder / MANIFEST).is_file():
        return []
    manifest = read_json(
        folder / MANIFEST, _Manifest, "restore the folder, or delete this file"
    )
    return [
        name
        for name, checksum in manifest.sha256.items()
        if not (folder / name).is_file() or _checksum(folder / name) != checksum
    ]


def require_unchanged(folder: str | os.PathLike[str]) -> None:
    """Check that a folder is as this package wrote it.

    Raises:
        ValueError: A file has changed or is missing.
    """
    if changed := changed_files(folder):
        raise ValueError(
            f"{Path(folder) / changed[0]} has changed since it was written: restore it, or "
            f"delete {MANIFEST} next to it if the change is intended"
        )


def source_of(folder: str | os.PathLike[str]) -> str:
    """Source given by the writer of a folder; "" if there is none."""
    manifest = _read_manifest(Path(folder))
    return "" if manifest is None else manifest.source


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _read_manifest(folder: Path) -> _Manifest | None:
    try:
        return read_json(folder / MANIFEST, _Manifest)
    except (OSError, ValueError):
        return None


def _listed(folder: Path, manifest: _Manifest) -> set[str]:
    """Entries of a manifest, and those of the manifests of the folders it lists.

    A foreign folder added later is not listed, whatever its own manifest says.
    """
    listed = {*manifest.entries, MANIFEST}
    for entry in [entry for entry in listed if entry.endswith("/")]:
        inner = _read_manifest(folder / entry)
        if inner is not None:
            listed |= {entry + name for name in _listed(folder / entry, inner)}
    return listed


def _is_marked(folder: Path, kind: Kind) -> bool:
    if kind.says is None:
        return (folder / kind.mark).is_file()
    name, value = kind.says
    try:
        return read_json(folder / kind.mark).get(name) == value
    except (OSError, ValueError):
        return False
