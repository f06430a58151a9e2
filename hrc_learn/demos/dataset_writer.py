"""Recording demonstrations as a LeRobot dataset of version 3.0."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hrc_learn.demos import recorded_episode as recorded
from hrc_learn.demos.dataset_assembly import begin, discard, finish
from hrc_learn.demos.demonstration import Demonstration
from hrc_learn.demos.issues import DatasetError
from hrc_learn.demos.read.contract import Sidecar, SidecarColumn, read_sidecar
from hrc_learn.demos.read.dataset_folder import (
    DatasetFolder,
    open_folder,
    recovery_advice,
    staging_folder,
)
from hrc_learn.demos.read.metadata import INDEX_FEATURES
from hrc_learn.demos.read.quantities import ROLES
from hrc_learn.demos.videos import CameraRecorder, Image, video_features
from hrc_learn.kinematics import Arm
from hrc_learn.store import DATASET, Claim


class DatasetWriter:
    """Recorder of episodes, frame by frame, into a LeRobot dataset.

        with DatasetWriter(root, fps=50, robot_type="panda", joint_names=names) as writer:
            writer.start_episode("put the bottle on the shelf")
            writer.add_frame(time=t, joint_position=q, position=p, orientation=quaternion)
            ...
            writer.save_episode()

    Saved episodes are kept in the folder `ROOT.recording/`. The end of the `with` block calls
    `finalize`, which turns them into the dataset in one step. If an exception or a kill
    interrupts the recording, the saved episodes stay in this folder. `recover_dataset` then
    makes a dataset of them or appends them to the dataset being extended.

    Attributes:
        root: Folder of the dataset.
        fps: Frame rate [1/s].
        robot_type: Name of the robot.
        joint_names: Names of the joints.
        features: User-defined features: key -> component names.
        episodes: Number of episodes, those of an extended dataset included.
    """

    @classmethod
    def of(cls, robot: Arm, root: str | Path, fps: float | int, **more: Any) -> "DatasetWriter":
        """Recorder of an arm's episodes; `more` are further arguments of `DatasetWriter`."""
        known = {"robot_type": robot.name, "joint_names": robot.chain.joint_names}
        return cls(root, fps, **{**known, "frames": robot.frame_names, **more})

    def __init__(
        self,
        root: str | Path,
        fps: float | int,
        robot_type: str,
        joint_names: Sequence[str] = (),
        features: Mapping[str, Sequence[str]] | None = None,
        *,
        cameras: Mapping[str, tuple[int, int]] | None = None,
        frames: Mapping[str, str] | None = None,
        details: Mapping[str, object] | None = None,
        append: bool = False,
    ):
        """Reserve the dataset for this process; `root` is not written before `finalize`.

        Args:
            root: Folder of the dataset; it must not exist, except with `append`.
            fps: Frame rate [1/s]. If frames have a `time`, these measured stamps are stored
                too.
            robot_type: Name of the robot in LeRobot's metadata.
            joint_names: Joint names, in the order of the values of every joint quantity.
            features: Further features: key (such as "observation.shelf") -> component names.
            cameras: Cameras whose images are stored as videos: name -> height, width [px].
            frames: Reference frames of the poses, such as
                {"base": "panda_link0", "ee": "panda_hand_tcp"}.
            details: Further values to keep with the dataset, as JSON values.
            append: Append episodes to the dataset `root`, written by a `DatasetWriter` with the
                same settings. `finalize` replaces this dataset by the longer one; until then,
                it stays readable.

        Raises:
            BusyError: Another process is recording this dataset.
            FileExistsError: `root`, or an interrupted recording of it, is already there.
            ValueError: An argument is invalid, or differs from the dataset to append to.
            DatasetError: The dataset to append to cannot be read.
        """
        self.root = Path(root)
        if not 0 < fps < np.inf:
            raise ValueError(f"fps must be positive, got {fps}")
        if len(set(joint_names) - {""}) != len(joint_names):
            raise ValueError(f"joint names must differ and not be empty, got {[*joint_names]}")
        for key in features or {}:
            if key != "action" and not key.startswith(("observation.", "action.")):
                text = f"feature {key!r} needs a key that LeRobot understands"
                raise ValueError(f"{text}: 'observation.{key}'")
        self.fps = float(fps)
        self.robot_type = robot_type
        self.joint_names = tuple(joint_names)
        self.features = {key: tuple(names) for key, names in (features or {}).items()}
        self._sidecar = Sidecar(
            joint_names=self.joint_names, frames=dict(frames or {}), details=dict(details or {})
        )
        self._given: tuple[str, ...] = ()
        self._task: str | None = None
        widths = {
            name: width or len(joint_names) for name, width in recorded.FRAME_WIDTHS.items()
        }
        self._widths = widths | {key: len(names) for key, names in self.features.items()}
        self._frames: list[recorded.Episode] = []
        self._tasks: dict[str, int] = {}
        self._saved_frames = 0
        self.episodes = 0
        self._video_features = video_features(cameras or {})
        self._staging = staging_folder(self.root)
        self._images = CameraRecorder(cameras or {}, self.fps, self._staging)
        self._staging.parent.mkdir(parents=True, exist_ok=True)
        self._claim = Claim(self.root)
        try:
            self._earlier = self._continue() if append else None
            if append:
                self._claim.require_replaceable(DATASET, True)
            begin(self.root, self.episodes if append else None)
        except BaseException:
            self._claim.release()
            raise

    def __enter__(self) -> "DatasetWriter":
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        with self._claim:
            if error is None:
                self.finalize()
                return
            self.discard_episode()
            if self._new_episodes:
                error.add_note(self._kept())
            else:
                discard(self._staging)

    def _kept(self) -> str:
        """Note with the folder of the saved episodes and the command that recovers them."""
        return (
            f"The {self._new_episodes} episodes saved so far are kept in {self._staging}; "
            f"{recovery_advice(self.root)} makes a dataset of them."
        )

    def start_episode(self, task: str) -> None:
        """Begin an episode of a task, described in words.

        Raises:
            RuntimeError: The previous episode was neither saved nor discarded.
        """
        self._require_no_open_episode("first")
        self._task = task

    def add_frame(self, *, images: Mapping[str, Image] | None = None, **values: Any) -> None:
        """Add one frame to the open episode.

        The first saved episode determines the recorded quantities; all later frames must give
        the same quantities.

        Args:
            images: Camera name -> RGB image (height, width, 3), uint8.
            values: Fields of `Demonstration` by name, one row each (`time` [s],
                `joint_position` [rad], `orientation` as (w, x, y, z), `feature` [px], ...),
                and the declared features by key, as arrays, lists or tensors; they are
                copied. Without `time`, frames are 1/fps apart.

        Raises:
            RuntimeError: No episode is open.
            ValueError: A quantity is unknown, missing, of the wrong length, or was not in the
                first frame.
        """
        self._open_task()
        row = recorded.frame_row(values, self._widths, self._frames)
        self._images.append(images or {})
        self._frames.append(row)

    def save_episode(self) -> int:
        """Save the open episode to disk.

        Returns:
            Index of the episode in the dataset.

        Raises:
            RuntimeError: No episode is open.
            ValueError: The episode is empty, holds values that are not finite, or its time
                does not increase. The episode is then discarded.
        """
        task = self._open_task()
        try:
            return self._save(recorded.stacked(self._frames), task)
        finally:
            self.discard_episode()

    def add_episode(
        self, demonstration: Demonstration, images: Mapping[str, Iterable[Image]] | None = None
    ) -> int:
        """Save a whole demonstration as one episode.

        Args:
            demonstration: The episode; its `extra` holds the declared features.
            images: Camera name -> RGB image of each frame.

        Returns:
            Index of the episode in the dataset.

        Raises:
            RuntimeError: An episode is open.
            ValueError: The joints differ from the dataset's, or images are missing or of the
                wrong size. Also as in `save_episode`.
        """
        self._require_no_open_episode("first")
        if demonstration.joint_names != self.joint_names:
            text = (
                f"the demonstration's joints {demonstration.joint_names} are not the dataset's"
            )
            advice = "select_joints(names) reorders them"
            raise ValueError(f"{text} {self.joint_names}: {advice}")
        episode = {name: getattr(demonstration, name) for name in demonstration.recorded}
        episode["time"] = demonstration.time + demonstration.start_time
        episode |= {key: demonstration.extra[key] for key in self.features}
        cameras = images or {}
        try:
            for _, *shown in zip(demonstration.time, *cameras.values(), strict=True):
                self._images.append(dict(zip(cameras, shown, strict=True)))
            return self._save(episode, demonstration.task)
        finally:
            self._images.discard()

    def write_draft(self, task: str, frames: Sequence[Mapping[str, Any]]) -> None:
        """Save the frames of an unfinished episode, so that a power failure does not lose them.

        `recover_dataset` makes an episode of them. The next draft or saved episode replaces
        them.

        Args:
            task: Task in words.
            frames: Values of each frame, as in `add_frame`.

        Raises:
            RuntimeError: The dataset has cameras; a draft cannot hold images.
            ValueError: As in `add_frame` and `save_episode`.
        """
        if self._video_features:
            raise RuntimeError("a draft holds no images: save episodes instead")
        rows: list[recorded.Episode] = []
        for values in frames:
            rows.append(recorded.frame_row(values, self._widths, rows))
        self._write(recorded.stacked(rows), task)

    def discard_draft(self) -> None:
        """Delete the draft, if any."""
        recorded.episode_path(self._staging, self.episodes).unlink(missing_ok=True)

    def discard_episode(self) -> None:
        """Delete the open episode, if any."""
        self._task, self._frames = None, []
        self._images.discard()

    def finalize(self) -> Path:
        """Turn the saved episodes into the dataset.

        Returns:
            The dataset's folder.

        Raises:
            RuntimeError: An episode is open.
            DatasetError: No episode was saved.
            OSError: The disk is full or read-only. The saved episodes are kept.
        """
        self._require_no_open_episode("before the recording ends")
        with self._claim:
            if not self._new_episodes:
                discard(self._staging)
                left = "the dataset stays as it was" if self._earlier else "there is no dataset"
                raise DatasetError(f"no episode was saved: {left}", file=self.root)
            try:
                finish(self.root, self._claim)
            except OSError as error:
                error.add_note(self._kept())
                raise
        return self.root

    @property
    def _new_episodes(self) -> int:
        return self.episodes - (len(self._earlier.episodes) if self._earlier else 0)

    def _continue(self) -> DatasetFolder:
        """Check the dataset to append to, continue its counts, and return its metadata."""
        folder, sidecar = open_folder(self.root), read_sidecar(self.root)
        frames = self._sidecar.frames or sidecar.frames
        for name, theirs, ours in (
            ("frame rate", folder.fps, self.fps),
            ("robot", folder.robot_type, self.robot_type),
            ("joints", sidecar.joint_names, self.joint_names),
            ("reference frames", sidecar.frames, frames),
        ):
            if theirs != ours:
                text = f"cannot append to {self.root}: its {name} is {theirs!r}, not {ours!r}"
                raise ValueError(text)
        self._tasks = {text: index for index, text in folder.tasks.items()}
        self._saved_frames = sum(entry.length for entry in folder.episodes)
        self.episodes = len(folder.episodes)
        return folder

    def _require_no_open_episode(self, when: str) -> None:
        if self._task is not None:
            text = f"an episode with {len(self._frames)} unsaved frames is open"
            raise RuntimeError(f"{text}: call save_episode() or discard_episode() {when}")

    def _open_task(self) -> str:
        if self._task is None:
            raise RuntimeError("no episode is open: call start_episode(task) first")
        return self._task

    def _save(self, episode: recorded.Episode, task: str) -> int:
        self._given, frames = self._write(episode, task)
        self._tasks.setdefault(task, len(self._tasks))
        self._saved_frames += frames
        self.episodes += 1
        return self.episodes - 1

    def _write(self, episode: recorded.Episode, task: str) -> tuple[tuple[str, ...], int]:
        """Write an episode and its images; return its quantity names and its length."""
        if not episode:
            raise ValueError(f"episode {self.episodes} has no frames")
        episode = recorded.complete(episode, self.fps)
        try:
            if self._given and episode.keys() != {*self._given}:
                raise ValueError(recorded.describe_difference(episode.keys(), self._given))
            recorded.require_valid(episode)
        except ValueError as error:
            raise ValueError(f"episode {self.episodes} was not saved: {error}") from error
        columns = recorded.columns_for(episode.keys(), self.joint_names, self.features)
        header, frames = self._header(columns), len(episode["time"])
        recorded.write_episode(
            recorded.episode_path(self._staging, self.episodes),
            header,
            recorded.encode(columns, episode),
            ([task], np.full(frames, self._tasks.get(task, len(self._tasks)))),
            self._saved_frames,
            statistics=self._images.finish(self.episodes),
        )
        return tuple(episode), frames

    def _header(self, columns: Sequence[recorded.RecordedColumn]) -> recorded.RecordingHeader:
        """Header of the recording; a dataset to extend must have the same features."""
        features = recorded.lerobot_features(columns) | self._video_features | INDEX_FEATURES
        earlier = features if self._earlier is None else self._earlier.info["features"]
        # LeRobot may have added "info" to the videos: leave it out of the comparison.
        theirs = {k: {n: v for n, v in f.items() if n != "info"} for k, f in earlier.items()}
        for key in theirs | features:
            if theirs.get(key) != features.get(key):
                raise ValueError(
                    f"cannot append to {self.root}: {key} is {theirs.get(key)} there, but "
                    f"{features.get(key)} here; record the same quantities or a new dataset"
                )
        known = {column.role: column for column in columns if column.role is not None}
        sidecar = replace(
            self._sidecar,
            units={role: ROLES[role].unit for role in known},
            columns={r: SidecarColumn(key=c.key, names=c.names) for r, c in known.items()},
        )
        return recorded.RecordingHeader(
            fps=self.fps, robot_type=self.robot_type, features=features, sidecar=sidecar
        )
