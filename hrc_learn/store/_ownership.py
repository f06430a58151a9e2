"""Ownership of files: those written by this package may be deleted with their folder."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hrc_learn.store._disk import dump_json, entries, matches, read_json

MADE_BY = "made_by.json"
"""File in each folder of results that records its inputs."""
MANIFEST = ".manifest.json"
"""File that lists all other files of a folder."""
_FORMAT, _VERSION = "hrc_learn manifest", 1


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
    manifest: bool = True
    """True if such a folder gets a manifest; not needed if it holds `files` only."""


_MODEL_FILES = ("config.json", "model.safetensors")
_MODELS = ("joint", "position", "orientation", "pose", "jacobian")

MODEL = Kind(
    name="saved model",
    mark="config.json",
    says=("format", "hrc_learn"),
    files=_MODEL_FILES,
    manifest=False,
)
EXPORT = Kind(
    name="export",
    mark="primitive/config.json",
    says=("format", "hrc_learn"),
    files=("step.pt2", *(f"primitive/{file}" for file in _MODEL_FILES)),
    manifest=False,
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
    if manifest is not None and manifest.get("kind") != kind.name:
        return None
    if manifest is None and not adopt and not _is_marked(folder, kind):
        return None
    owned = set() if manifest is None else _listed(folder, manifest)
    if manifest is None or adopt:
        owned |= {entry for entry in present if matches(entry, kind.files)}
        owned |= {f"{parent.as_posix()}/" for entry in owned for parent in Path(entry).parents}
    return present & owned


def write_manifest(folder: Path, kind: Kind, source: str) -> None:
    """Write the manifest of a folder, whose whole content was written here."""
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "kind": kind.name,
        "source": source,
        "entries": sorted(entries(folder) - {MANIFEST}),
    }
    dump_json(folder / MANIFEST, content)


def source_of(folder: str | os.PathLike[str]) -> str:
    """Source given by the writer of a folder; "" if there is none."""
    return str((_read_manifest(Path(folder)) or {}).get("source", ""))


def _read_manifest(folder: Path) -> dict[str, Any] | None:
    content = read_json(folder / MANIFEST)
    known = isinstance(content, dict) and content.get("format") == _FORMAT
    return content if known and isinstance(content.get("entries"), list) else None


def _listed(folder: Path, manifest: Mapping[str, Any]) -> set[str]:
    """Entries of a manifest, and those of the manifests of the folders it lists.

    A foreign folder added later is not listed, whatever its own manifest says.
    """
    listed = {str(entry) for entry in manifest["entries"]} | {MANIFEST}
    for entry in [entry for entry in listed if entry.endswith("/")]:
        inner = _read_manifest(folder / entry)
        if inner is not None:
            listed |= {entry + name for name in _listed(folder / entry, inner)}
    return listed


def _is_marked(folder: Path, kind: Kind) -> bool:
    if kind.says is None:
        return (folder / kind.mark).is_file()
    field, value = kind.says
    content = read_json(folder / kind.mark)
    return isinstance(content, dict) and content.get(field) == value
