"""What of a folder was written here, and so may be deleted when another takes its name."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hrc_learn.store._disk import dump_json, entries, matches, read_json

MADE_BY = "made_by.json"
"""File in each folder of results: what it was made from."""
MANIFEST = ".manifest.json"
"""File in a folder that lists all others."""
_FORMAT, _VERSION = "hrc_learn manifest", 1


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of folder that this package writes; only another of its kind may replace one."""

    name: str
    mark: str
    """File by which a folder without a manifest is known."""
    says: tuple[str, str] | None = None
    """Field and value that this file, of JSON, must hold; None: it need only be there."""
    files: tuple[str, ...]
    """Patterns of the files that a folder without a manifest owns; * matches / too."""
    manifest: bool = True
    """Whether such a folder gets a manifest; not where `files` is all that it can hold."""


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
# Files are those that programs wrote before there were manifests.
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
        # A checkpoint of the policy.
        *(*_MODEL_FILES, "policy_preprocessor*", "policy_postprocessor*"),
    ),
)


def owned_entries(folder: Path, kind: Kind, *, adopt: bool = False) -> set[str] | None:
    """What of a folder its writer made, and so may be deleted with it.

    Args:
        folder: Of the kind, or not.
        kind: What it should be.
        adopt: Take the folder for one of the kind, and all files with the names of such a
            one's for its own, whatever mark and manifest say.

    Returns:
        Relative paths with /, those of folders with one at the end; None: not of the kind.
    """
    if not folder.is_dir():
        return None
    present = entries(folder)
    if not present:
        return set()  # nothing that could be lost
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
    """List what is in a folder, all of it ours."""
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "kind": kind.name,
        "source": source,
        "entries": sorted(entries(folder) - {MANIFEST}),
    }
    dump_json(folder / MANIFEST, content)


def source_of(folder: str | os.PathLike[str]) -> str:
    """What the writer of a folder gave as its source; empty where there is none."""
    return str((_read_manifest(Path(folder)) or {}).get("source", ""))


def _read_manifest(folder: Path) -> dict[str, Any] | None:
    content = read_json(folder / MANIFEST)
    known = isinstance(content, dict) and content.get("format") == _FORMAT
    return content if known and isinstance(content.get("entries"), list) else None


def _listed(folder: Path, manifest: Mapping[str, Any]) -> set[str]:
    """What a manifest lists, and what those of the folders list that it lists.

    A folder that somebody put into this one later is none of them, whatever its manifest says.
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
