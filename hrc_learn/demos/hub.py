"""Datasets out to the Hugging Face Hub: checked, with a card that says what is in them.

Three things make a repository of the Hub a dataset that others can use: the card (`README.md`),
whose head the Hub searches and shows; the tag of the format's version, which LeRobot looks for
before anything else; and `.gitattributes`, without which a clone holds tables and videos as
ordinary blobs. The tag is moved last, so whoever reads by it never sees half of a push.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hrc_learn.demos.format.dataset_folder import DatasetFolder, open_folder
from hrc_learn.demos.issue import DatasetError, ValidationReport, plain_text
from hrc_learn.demos.validation.check import check_dataset

if TYPE_CHECKING:
    from huggingface_hub import DatasetCard, HfApi

UPLOADED = ("data/**", "videos/**", "images/**", "meta/**", "LICENSE*", "*.md")
"""What belongs to a dataset; other files beside it stay where they are."""
_OWNED = ("data/*", "videos/*", "images/*", "meta/*")
"""Of an earlier push, what is no longer here is removed; * matches folders too."""
_LARGE = ("*.parquet", "*.mp4", "*.png", "*.jpg")
ATTRIBUTES = "".join(f"{name} filter=lfs diff=lfs merge=lfs -text\n" for name in _LARGE)
"""`.gitattributes` of a dataset."""
_CARD = "README.md"
# Of the Hub's size categories, by frames: "n<1K", "1K<n<10K", ..., up to a trillion.
_SIZES = ("1K", "10K", "100K", "1M", "10M", "100M", "1B", "10B", "100B", "1T")
_MOST_TASKS = 20
"""Tasks that the card names one by one."""


@dataclass(frozen=True, kw_only=True)
class Push:
    """What goes to the Hub, or went."""

    repo: str
    revision: str
    """Branch."""
    tag: str
    """Version of the format, as LeRobot looks for it."""
    files: dict[str, int]
    """File, relative to the dataset -> bytes."""
    card: str
    report: ValidationReport
    url: str = ""
    """Of the repository; "" as long as nothing was sent."""

    @property
    def bytes(self) -> int:
        return sum(self.files.values())


def push_dataset(
    path: str | Path,
    repo: str,
    *,
    private: bool = True,
    license: str | None = None,
    tags: Sequence[str] = (),
    description: str = "",
    revision: str = "main",
    videos: bool = True,
    unsound: bool = False,
    dry_run: bool = False,
    api: "HfApi | None" = None,
) -> Push:
    """Check a dataset and bring it to the Hub, or bring a repository there up to it.

    The folder itself is not touched. A `README.md` of its own is kept, and its head completed.

    Args:
        path: The dataset's folder.
        repo: "OWNER/NAME" of the repository; made if it does not exist.
        private: Make a new repository private. One that exists stays as it is.
        license: Identifier of the licence, such as "cc-by-4.0".
        tags: Tags besides "LeRobot" and the robot's name.
        description: What was recorded and how, in Markdown, for the card.
        revision: Branch; made if it does not exist. Only on "main" the version's tag is moved.
        videos: Send videos too.
        unsound: Send a dataset that has errors.
        dry_run: Send nothing.
        api: Client of the Hub; one with the endpoint and token of the environment when None.

    Raises:
        DatasetError: The dataset has errors.
        ValueError: `repo` is no name of a repository.
        huggingface_hub.errors.HfHubHTTPError: The Hub refuses.
    """
    from huggingface_hub import CommitOperationAdd, HfApi
    from huggingface_hub.utils import validate_repo_id

    if repo.count("/") != 1:
        raise ValueError(f"repository {repo!r} must be OWNER/NAME")
    validate_repo_id(repo)
    folder = open_folder(path)
    report = check_dataset(path)
    if report.errors and not unsound:
        raise DatasetError(
            f"has {len(report.errors)} errors, the first: {report.errors[0]}. Repair it, or "
            f"send it as it is (--unsound)",
            file=folder.root,
        )
    card = dataset_card(
        folder, report, repo, license=license, tags=tags, description=description, videos=videos
    )
    push = Push(
        repo=repo,
        revision=revision,
        tag=folder.version,
        files=dict(_files(folder.root, videos)),
        card=str(card),
        report=report,
    )
    if dry_run:
        return push
    api = api or HfApi()
    url = api.create_repo(repo, repo_type="dataset", private=private, exist_ok=True)
    if revision != "main":
        api.create_branch(repo, repo_type="dataset", branch=revision, exist_ok=True)
    head = [CommitOperationAdd(_CARD, push.card.encode())]
    if attributes := _missing_attributes(api, repo, revision):
        head.append(CommitOperationAdd(".gitattributes", attributes.encode()))
    where: Any = {"repo_id": repo, "repo_type": "dataset", "revision": revision}
    # What is large by its name must be known as such before it comes.
    api.create_commit(operations=head, commit_message="Describe the dataset", **where)
    api.upload_folder(
        folder_path=folder.root,
        allow_patterns=[*UPLOADED],
        ignore_patterns=[_CARD, *([] if videos else ["videos/**"])],
        # What is not sent is not known to be gone.
        delete_patterns=[name for name in _OWNED if videos or name != "videos/*"],
        commit_message="Upload the dataset",
        **where,
    )
    if revision == "main":
        known = api.list_repo_refs(repo, repo_type="dataset").tags
        if any(known_tag.name == push.tag for known_tag in known):
            api.delete_tag(repo, tag=push.tag, repo_type="dataset")
        api.create_tag(repo, tag=push.tag, revision=revision, repo_type="dataset")
    return Push(**{**vars(push), "url": str(url)})


def _files(root: Path, videos: bool) -> Iterator[tuple[str, int]]:
    for pattern in UPLOADED:
        if pattern.startswith("videos") and not videos:
            continue
        for path in sorted(root.glob(pattern.replace("/**", "/**/*"))):
            if path.is_file():
                yield str(path.relative_to(root)), path.stat().st_size


def _missing_attributes(api: "HfApi", repo: str, revision: str) -> str:
    """`.gitattributes` with the lines that it lacks in the repository; "" where none."""
    name, there = ".gitattributes", ""
    if api.file_exists(repo, name, repo_type="dataset", revision=revision):
        there = Path(
            api.hf_hub_download(repo, name, repo_type="dataset", revision=revision)
        ).read_text(encoding="utf-8")
    known = {line.split()[0] for line in there.splitlines() if "filter=lfs" in line}
    lacking = [line for line in ATTRIBUTES.splitlines() if line.split()[0] not in known]
    if not lacking:
        return ""
    return "\n".join([*there.splitlines(), *lacking]) + "\n"


# The card.


def dataset_card(
    folder: DatasetFolder,
    report: ValidationReport,
    repo: str,
    *,
    license: str | None = None,
    tags: Sequence[str] = (),
    description: str = "",
    videos: bool = True,
) -> "DatasetCard":
    """The dataset's card: its own with the head completed, or one of what is in the dataset.

    Args:
        folder: The dataset.
        report: Its check, with the contract of its columns.
        repo: "OWNER/NAME" on the Hub.
        license: Identifier of the licence.
        tags: Further tags.
        description: What was recorded and how, in Markdown.
        videos: Whether the videos go along.
    """
    from huggingface_hub import DatasetCard

    own = folder.root / _CARD
    if own.is_file():
        card = DatasetCard(own.read_text(encoding="utf-8"), ignore_metadata_errors=True)
    else:
        body = "\n".join(_body(folder, report, repo, description, videos))
        card = DatasetCard(f"---\n{{}}\n---\n\n{body}\n")
    head: Any = card.data
    if license is not None:
        head.license = license
    robot = [folder.robot_type] if folder.robot_type not in (None, "", "unknown") else []
    earlier = getattr(head, "tags", None) or []
    head.tags = [*dict.fromkeys([*earlier, "LeRobot", *robot, *tags])]
    head.task_categories = head.task_categories or ["robotics"]
    frames = sum(entry.length for entry in folder.episodes)
    head.size_categories = [_size_category(frames)]
    if not getattr(head, "configs", None):
        # What the Hub's viewer shows, and `datasets.load_dataset` loads.
        head.configs = [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    card.data = head
    return card


def _size_category(frames: int) -> str:
    bounds = [10 ** (3 + k) for k in range(len(_SIZES))]
    place = sum(frames >= bound for bound in bounds)
    if place == 0:
        return f"n<{_SIZES[0]}"
    return (
        f"n>{_SIZES[-1]}" if place == len(_SIZES) else f"{_SIZES[place - 1]}<n<{_SIZES[place]}"
    )


def _body(
    folder: DatasetFolder,
    report: ValidationReport,
    repo: str,
    description: str,
    videos: bool,
) -> Iterator[str]:
    frames = sum(entry.length for entry in folder.episodes)
    yield f"# {repo.split('/')[1]}\n"
    if description:
        yield f"{description}\n"
    robot = plain_text(folder.robot_type or "unknown robot")
    yield (
        f"{len(folder.episodes)} demonstrations by {robot}, {frames} frames at "
        f"{folder.fps:g} Hz ({frames / folder.fps / 60:.1f} min), in the LeRobot format "
        f"{folder.version}.\n"
    )
    yield "| task | episodes |\n| --- | --- |"
    shown = Counter(task for entry in folder.episodes for task in entry.tasks)
    for task, count in shown.most_common(_MOST_TASKS):
        yield f"| {_cell(task)} | {count} |"
    if len(shown) > _MOST_TASKS:
        yield f"| and {len(shown) - _MOST_TASKS} more | |"
    cameras = [f for f in folder.features.values() if f.dtype in ("video", "image")]
    if cameras and videos:
        yield "\n| camera | shape | kept as |\n| --- | --- | --- |"
        for feature in cameras:
            shape = " x ".join(map(str, feature.shape))
            yield f"| `{_cell(feature.key)}` | {shape} | {feature.dtype} |"
    if report.contract is not None:
        header, *rows = report.contract.rows()
        yield "\n## What the columns mean\n"
        yield "LeRobot declares no units; these were declared or found from the values.\n"
        yield f"| {' | '.join(header)} |"
        yield f"|{' --- |' * len(header)}"
        yield from (f"| {' | '.join(map(_cell, row))} |" for row in rows)
    yield "\n## Checked\n"
    yield f"`hrc check`: {len(report.errors)} errors, {len(report.warnings)} warnings.\n"
    *findings, _ = report.lines()
    yield from (f"- {_cell(line)}" for line in findings)
    yield "\n## Use\n"
    yield "```python\nfrom lerobot.datasets.lerobot_dataset import LeRobotDataset\n"
    yield f'dataset = LeRobotDataset("{repo}")\n```'


def _cell(text: str) -> str:
    return plain_text(text).replace("|", "\\|").replace("<", "&lt;")
