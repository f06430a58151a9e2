"""Merge datasets: match columns by name, convert to the first dataset's units, copy videos."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.quality import column_rewriter as copying
from hrc_learn.demos.quality import episode_edits as edits
from hrc_learn.demos.read.frames import RawFrames, read_frames
from hrc_learn.demos.read.metadata import Feature
from hrc_learn.demos.read.quantities import INDEX_KEYS
from hrc_learn.demos.read.source import OpenedDataset, open_dataset
from hrc_learn.demos.read.units import UnitDecision, unit_factor
from hrc_learn.demos.recorded_episode import RecordingHeader
from hrc_learn.demos.videos import read_segments

_ESSENTIAL = ("action", "observation.state")
"""Features that policies need; others may be left out."""


@dataclass(kw_only=True)
class MergeReport:
    """Content of a merged dataset."""

    path: Path
    episodes: int = 0
    frames: int = 0
    tasks: int = 0
    notes: list[str] = field(default_factory=list)
    """Differences between the datasets, and the treatment of each."""

    def __str__(self) -> str:
        counts = f"{self.episodes} episodes, {self.frames} frames, {self.tasks} tasks"
        return "\n".join([*self.notes, f"{self.path}: {counts}"])


def merge_datasets(
    paths: Sequence[str | Path],
    out: str | Path,
    *,
    fps: float | None = None,
    videos: bool = True,
) -> MergeReport:
    """Merge datasets of version 2.0, 2.1 or 3.0 into a new one of version 3.0.

    Names, order, units and types of the columns are those of the first dataset. Columns of the
    others are matched by their names, or by the quantity and joint that they hold. Tasks are
    matched by their texts. Features that not all datasets have are left out.

    Args:
        paths: The datasets, two or more. They are not changed.
        out: Folder of the new dataset, which must not exist.
        fps: Rate to which datasets of other rates are resampled [1/s]; None refuses them.
        videos: Keep the videos; they are copied without re-encoding.

    Raises:
        DatasetError: A dataset cannot be read, or its rate, a component, a unit or the size of
            its images does not fit the first one.
        FileExistsError: `out` exists.
        ValueError: Fewer than two datasets are given, or one is given twice.
    """
    if len(paths) < 2:
        raise ValueError("give two datasets or more to merge")
    if len({Path(path).resolve() for path in paths}) < len(paths):
        raise ValueError("a dataset is given twice: its episodes would be doubled")
    report = MergeReport(path=Path(out))
    opened = [open_dataset(path) for path in paths]
    rate = opened[0].folder.fps if fps is None else float(fps)
    for folder in (dataset.folder for dataset in opened):
        if np.isclose(folder.fps, rate):
            continue
        if fps is None:
            text = f"runs at {folder.fps:g} fps, but {opened[0].folder.root} at {rate:g}"
            advice = f"--fps {rate:g} --no-videos resamples it"
            raise DatasetError(f"{text}: {advice}", file=folder.root)
        report.notes.append(f"{folder.root}: resampled from {folder.fps:g} to {rate:g} fps")
    _Merge(opened, rate, videos, report).write()
    return report


_Column = tuple[str, int]
"""Feature, and index of a component."""


class _Source:
    """One of the datasets, and the mapping from its columns to those of the first dataset.

    Attributes:
        folder: Metadata of this dataset.
        decisions: Quantity -> its unit.
        meanings: Component -> its quantity and joint, for components that hold a quantity.
        units: Component -> its unit, for the same components.
        places: Feature -> components of this dataset in the order of the first dataset.
        factors: Feature -> factors that convert these components to the first dataset's units.
    """

    def __init__(self, dataset: OpenedDataset):
        self.dataset, self.folder = dataset, dataset.folder
        self.root, self.features = dataset.folder.root, dataset.folder.features
        self.decisions, faults = dataset.decide_units(dataset.folder.episodes, {})
        for fault in faults:
            raise fault
        self.meanings: dict[_Column, tuple[str, str]] = {}
        self.units: dict[_Column, UnitDecision] = {}
        for role, selection in dataset.columns.selections.items():
            decision = self.decisions[role]
            for number, column in enumerate(selection.columns):
                self.meanings[column] = role, selection.labels[number].removesuffix(".pos")
                self.units[column] = replace(decision, unit=decision.unit_of(number), units=())
        self.places: dict[str, list[int]] = {}
        self.factors: dict[str, np.ndarray] = {}

    def fault(self, message: str, key: str) -> DatasetError:
        """Error about a feature of this dataset."""
        return DatasetError(message, file=self.root, key=key)

    def converted(self, frames: RawFrames, features: Mapping[str, dict]) -> RawFrames:
        """Columns of an episode in the order and units of the first dataset."""
        made: RawFrames = {}
        for key, places in self.places.items():
            values = frames[key][:, places]
            if (self.factors[key] != 1).any():
                values = values * self.factors[key]
            made[key] = values.astype(features[key]["dtype"])
        return made | {"task_index": frames["task_index"]} if "task_index" in frames else made


class _Merge:
    """One merge: the datasets, their common features, and the report."""

    def __init__(
        self, opened: Sequence[OpenedDataset], fps: float, videos: bool, report: MergeReport
    ):
        self.sources, self.report = [*map(_Source, opened)], report
        self.fps, self.videos = fps, videos
        self.first = self.sources[0]
        self.features = self._common_features()
        robot = self.first.folder.robot_type
        for source in self.sources:
            for key, feature in self.features.items():
                if feature.numeric:
                    self._match(source, key)
            if source.folder.robot_type != robot:
                self.report.notes.append(
                    f"{source.root}: robot {source.folder.robot_type}; the merged dataset "
                    f"names {robot}"
                )

    def _common_features(self) -> dict[str, Feature]:
        """Features that all datasets have, as the first one declares them."""
        common = {}
        everywhere = dict.fromkeys(key for source in self.sources for key in source.features)
        for key in (key for key in everywhere if key not in INDEX_KEYS):
            without = [str(one.root) for one in self.sources if key not in one.features]
            if without and key in _ESSENTIAL:
                raise DatasetError(f"has no {key}, unlike the others", file=without[0])
            if without:
                self.report.notes.append(f"{key}: left out, as {', '.join(without)} lacks it")
            elif self.first.features[key].dtype != "video" or self.videos:
                common[key] = self.first.features[key]
        for source in self.sources:
            for key, own in common.items():
                other = source.features[key]
                alike = (other.dtype, other.shape) == (own.dtype, own.shape)
                if not (alike or (own.numeric and other.numeric and own.width == other.width)):
                    advice = "; --no-videos leaves videos out" if own.is_picture else ""
                    raise source.fault(
                        f"is {other.dtype} of shape {list(other.shape)}, but {own.dtype} of "
                        f"shape {list(own.shape)} in {self.first.root}{advice}",
                        key,
                    )
        return common

    def _match(self, source: _Source, key: str) -> None:
        """Match each component of a feature of the first dataset with a component of `source`.

        The matching components and the factors of their units are kept in the source.

        Raises:
            DatasetError: A component is missing, or its unit cannot be converted.
        """
        own, other = self.first.features[key], source.features[key]
        places = [*range(own.width)]
        if own.names and other.names and own.names != other.names:
            places = [self._place(source, key, index) for index in places]
            self.report.notes.append(f"{source.root}: {key} matched by name to {own.names}")
        elif source is not self.first and own.width > 1 and not (own.names and other.names):
            text = f"{source.root}: {key} matched by position, as not both datasets name it"
            self.report.notes.append(text)
        if len({*places}) < len(places):
            text = f"its components do not match those of {self.first.root} one to one"
            raise source.fault(f"{text}: {', '.join(other.names or ())}", key)
        factors = [self._factor(source, key, i, place) for i, place in enumerate(places)]
        source.places[key], source.factors[key] = places, np.array(factors)

    def _place(self, source: _Source, key: str, index: int) -> int:
        """Index of the source's component that matches a component of the first dataset.

        Two components match if their names or their meanings are equal.
        """
        name = self.first.features[key].component(index)
        wanted = self.first.meanings.get((key, index))
        names = source.features[key].names or ()
        if name in names:
            return names.index(name)
        for place in range(len(names)):
            if wanted is not None and source.meanings.get((key, place)) == wanted:
                return place
        text = f"lacks the component {name} of {self.first.root}, but has {', '.join(names)}"
        raise source.fault(f"{text}: rename it in {source.root}/meta/info.json", key)

    def _factor(self, source: _Source, key: str, index: int, place: int) -> float:
        own, other = self.first.units.get((key, index)), source.units.get((key, place))
        if own is None or other is None or own.unit == other.unit:
            return 1.0
        if (
            own.steps & other.steps & own.guessed
            and 0.7 < np.divide(other.factor, own.factor) < 1.4
        ):
            return 1.0  # two guesses of one factor, from different data
        for asked, decision in ((self.first, own), (source, other)):
            if decision.doubt:
                advice = f"hrc check {asked.root} --units {decision.role} UNIT --keep-contract"
                raise asked.fault(f"{decision.doubt}; declare the unit with `{advice}`", key)
        if own.role != other.role or own.si_unit != other.si_unit:
            raise source.fault(
                f"{source.features[key].component(place)} is {other.role} in {other.unit}, but "
                f"{own.role} in {own.unit} in {self.first.root}: one cannot be converted to "
                f"the other",
                key,
            )
        note = f"{source.root}: {key} converted from {other.unit} to {own.unit}"
        if note not in self.report.notes:
            self.report.notes.append(note)
        return unit_factor(other.role, other.unit) / unit_factor(own.role, own.unit)

    def write(self) -> None:
        """Write the merged dataset."""
        report, first = self.report, self.first.dataset
        listed = [t for source in self.sources for t in copying.listed_tasks(source.folder)]
        tasks = [*dict.fromkeys(listed)]
        header = self._header(copying.new_header(first, {}, self.features, fps=self.fps))

        def rewritten() -> Iterator[copying.Rewritten]:
            for source in self.sources:
                shown = read_segments(source.folder) if self.videos else {}
                writer = copying.ColumnRewriter(source.folder, header, shown)
                for edit in self._episodes(source, header.features):
                    report.episodes += 1
                    report.frames += len(edit)
                    yield writer.rewritten(edit)

        copying.write_copy(report.path, rewritten(), tasks)
        report.tasks = len(tasks)

    def _header(self, own: RecordingHeader) -> RecordingHeader:
        """Header of the first dataset without the features that are left out."""
        wanted = {*self.features, *INDEX_KEYS}
        features = {key: dict(value) for key, value in own.features.items() if key in wanted}
        for key, feature in features.items():
            others = [source.folder.info["features"].get(key, {}) for source in self.sources]
            if any(other.get("info") != feature.get("info") for other in others):
                # `info` describes the videos; LeRobot reads it from the video files.
                feature.pop("info", None)
        old = own.sidecar
        columns = {role: c for role, c in old.columns.items() if c.key in features}
        parts = tuple(part for part in old.contract.components if part.key in features)
        contract = replace(old.contract, components=parts)
        sidecar = replace(old, columns=columns, contract=contract)
        return replace(own, features=features, sidecar=sidecar)

    def _episodes(
        self, source: _Source, features: Mapping[str, dict]
    ) -> Iterator[edits.EpisodeEdit]:
        """Episodes of a dataset with the columns and the rate of the merged dataset."""
        folder = source.folder
        for entry, frames in read_frames(folder, folder.episodes, folder.numbers):
            edit = edits.unedited(source.dataset, source.decisions, entry, frames)
            if not np.isclose(folder.fps, self.fps):
                increasing = edits.drop_late(edits.renew_stamps(edit, folder.fps))
                edit = edits.resample_to_grid(increasing, self.fps)
            yield replace(edit, frames=source.converted(edit.frames, features))
