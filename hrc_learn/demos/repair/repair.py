"""A dataset repaired into a copy."""

import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from hrc_learn.demos.format.dataset_folder import DatasetFolder, EpisodeEntry, open_folder
from hrc_learn.demos.format.features import Sidecar, read_sidecar
from hrc_learn.demos.format.video_segments import Segments, read_segments
from hrc_learn.demos.issue import DatasetError
from hrc_learn.demos.read.column_mapping import MappingSpec, match_columns
from hrc_learn.demos.read.component_names import INDEX_KEYS
from hrc_learn.demos.read.episodes import frame_step, select_quantities
from hrc_learn.demos.read.frames import RawFrames, read_frames
from hrc_learn.demos.read.value_encodings import decide_units
from hrc_learn.demos.repair.episode_edit import (
    Draft,
    Meaning,
    RepairOptions,
    RepairReport,
    drop_bad_frames,
    drop_late,
    drop_repeats,
    fix_signs,
    regrid,
    trim,
    unwrap,
)
from hrc_learn.demos.repair.rewrite import Recast, cut_segments
from hrc_learn.demos.write.assembly import assemble
from hrc_learn.demos.write.staging import episode_path
from hrc_learn.store import DATASET, replacing

Progress = Callable[[Sequence[EpisodeEntry]], Iterable[EpisodeEntry]]


def repair_dataset(
    path: str | Path,
    out: str | Path,
    options: RepairOptions | None = None,
    *,
    mapping: MappingSpec | None = None,
    units: Mapping[str, str] | None = None,
    progress: Progress | None = None,
) -> RepairReport:
    """Repair a dataset of version 2.0, 2.1 or 3.0 into a new one of version 3.0.

    The old one is left as it is. Columns keep their keys, names and units. Where no column
    holds true stamps and the frames are not resampled, `observation.time` is added with
    LeRobot's old ones, because the new `timestamp` is frame / fps by definition.

    Args:
        path: The dataset to repair.
        out: Folder of the new one, which must not exist.
        options: What may be changed.
        mapping: Where quantities are that are not found by name, as in `load_demos`.
        units: Units on disk by role, as in `load_demos`; kept in the new dataset.
        progress: Called with the episodes one after another, and gives them back: a hook for
            a progress bar.

    Raises:
        DatasetError: An episode cannot be read or repaired, and may not be left out.
        FileExistsError: There is something at `out`.
    """
    options, units = options or RepairOptions(), units or {}
    folder, sidecar = open_folder(path), read_sidecar(Path(path))
    if not folder.episodes:
        raise DatasetError("the dataset holds no episodes", file=folder.root)
    meaning = _understand(folder, sidecar, mapping, units)
    segments = read_segments(folder) if options.videos else {}
    recast = Recast(folder, sidecar, meaning, options, units, segments)
    report = RepairReport(path=Path(out), notes=recast.notes)
    with replacing(out, DATASET) as target:
        staging = target / "episodes"
        staging.mkdir(parents=True)
        videos: list[Segments] = []
        for entry in progress(folder.episodes) if progress else folder.episodes:
            report.frames_before += entry.length
            try:
                draft = _repair(folder, entry, meaning, options)
                cut = cut_segments(draft, recast.videos_of(entry), folder.fps)
            except DatasetError as error:
                if not options.drop_bad_episodes:
                    raise
                report.left_out[entry.index] = error.finding.message
                continue
            recast.stage(episode_path(staging, len(report.changes)), draft, report.frames)
            videos.append(cut)
            report.changes[entry.index] = draft.changes
            report.frames += len(draft)
        if not report.changes:
            raise DatasetError("no episode could be repaired", file=folder.root)
        paths = [episode_path(staging, i) for i in range(len(report.changes))]
        assemble(paths, target, videos=videos, tasks=recast.tasks)
        shutil.rmtree(staging)
    return report


def _understand(
    folder: DatasetFolder,
    sidecar: Sidecar,
    mapping: MappingSpec | None,
    units: Mapping[str, str],
) -> Meaning:
    """Find the quantities, and guess units from whatever can be read and is finite."""
    matching = match_columns(folder.features, sidecar, mapping)
    largest = dict.fromkeys(matching.selections, 0.0)
    step = 1.0
    for _, frames in _readable(folder, folder.episodes):
        quantities = select_quantities(frames, matching.selections)
        for role, values in quantities.items():
            finite = np.abs(values[np.isfinite(values)])
            largest[role] = max(largest[role], float(finite.max(initial=0.0)))
        step = frame_step(quantities.get("time"), folder.fps)
    return Meaning(matching=matching, units=decide_units(largest, sidecar.units, units, step))


def _readable(
    folder: DatasetFolder, entries: Sequence[EpisodeEntry]
) -> Iterator[tuple[EpisodeEntry, RawFrames]]:
    for entry in entries:
        try:
            yield entry, _read(folder, entry)
        except DatasetError:
            continue  # it is reported, or left out, when its turn comes


def _read(folder: DatasetFolder, entry: EpisodeEntry) -> RawFrames:
    keys = [key for key, f in folder.features.items() if f.numeric and key not in INDEX_KEYS]
    ((_, frames),) = read_frames(folder, [entry], keys)
    if not entry.length:
        raise DatasetError("has no frames", file=entry.file, episode=entry.index)
    return frames


def _repair(
    folder: DatasetFolder, entry: EpisodeEntry, meaning: Meaning, options: RepairOptions
) -> Draft:
    frames = _read(folder, entry)
    draft = Draft(
        entry=entry,
        frames={k: v for k, v in frames.items() if k not in INDEX_KEYS or k == "task_index"},
        time=_stamps(folder, frames, meaning),
        kept=np.arange(entry.length),
    )
    draft = drop_bad_frames(draft, meaning, options.drop_bad_frames)
    if options.drop_repeats:
        draft = drop_late(draft)
    if options.trim:
        draft = trim(draft, meaning, options.keep_rest)
    if options.drop_repeats:
        draft = drop_repeats(draft)
    if options.unwrap:
        draft = unwrap(draft, meaning)
    if options.fix_signs:
        draft = fix_signs(draft, meaning)
    if options.fps is not None:
        draft = regrid(draft, meaning, options.fps)
    _require_order(draft)
    return draft


def _stamps(folder: DatasetFolder, frames: RawFrames, meaning: Meaning) -> np.ndarray:
    if "time" in meaning.matching.selections:
        ((key, index),) = meaning.matching.selections["time"].columns
        return frames[key][:, index].astype(float) * meaning.units["time"].factor
    if "timestamp" in frames:
        return frames["timestamp"][:, 0].astype(float)
    return np.arange(len(next(iter(frames.values())))) / folder.fps


def _require_order(draft: Draft) -> None:
    stalled = np.flatnonzero(np.diff(draft.time) <= 0)
    if len(stalled):
        raise draft.bad(
            "stamps must increase; let repeated frames be dropped (drop_repeats), or leave the "
            "episode out (drop_bad_episodes)",
            frame=int(stalled[0]) + 1,
        )
