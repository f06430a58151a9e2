"""Check a dataset and upload it to the Hugging Face Hub with a dataset card.

A dataset repository needs two things besides its data. The Hub indexes and displays the header
of the card (`README.md`). LeRobot looks for a tag with the version of the format. The upload
sets the tag last, so that LeRobot does not load a partial upload.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hrc_learn.demos.issues import DatasetError, ValidationReport, plain_text
from hrc_learn.demos.quality.check import check_dataset
from hrc_learn.demos.read.dataset_folder import DatasetFolder, open_folder

if TYPE_CHECKING:
    from huggingface_hub import DatasetCard, HfApi

UPLOADED = ("data/**", "videos/**", "images/**", "meta/**", "LICENSE*", "*.md")
"""Files that belong to a dataset. `push_dataset` does not upload other files, and deletes those
in the four folders from the repository if the dataset no longer has them."""
_CARD = "README.md"
_TEMPLATE = Path(__file__).with_name("dataset_card.md")
_MOST_TASKS = 20
"""Largest number of tasks that the card lists."""


@dataclass(frozen=True, kw_only=True)
class Push:
    """A planned or completed upload."""

    repo: str
    tag: str
    """Version of the format, which LeRobot looks for."""
    files: dict[str, int]
    """Size [bytes] of each file, by its path relative to the dataset."""
    card: str
    report: ValidationReport
    url: str = ""
    """Address of the repository; "" if nothing was uploaded."""

    @property
    def bytes(self) -> int:
        """Size of all files [bytes]."""
        return sum(self.files.values())


def push_dataset(
    path: str | Path,
    repo: str,
    *,
    private: bool = True,
    license: str | None = None,
    tags: Sequence[str] = (),
    unsound: bool = False,
    dry_run: bool = False,
    api: "HfApi | None" = None,
) -> Push:
    """Check a dataset and upload it, or update its repository.

    The local folder does not change. If it contains a `README.md`, the upload keeps the text
    and completes the header.

    Args:
        path: Folder of the dataset.
        repo: "OWNER/NAME" of the repository, created if it does not exist.
        private: Make a new repository private; an existing one keeps its visibility.
        license: Identifier of the licence, such as "cc-by-4.0".
        tags: Tags besides "LeRobot" and the robot's name.
        unsound: Upload the dataset even if it has errors.
        dry_run: Check the dataset and prepare the card, but upload nothing.
        api: Client of the Hub; None creates one with the environment's endpoint and token.

    Raises:
        DatasetError: The dataset has errors and `unsound` is False.
        ValueError: `repo` is not a valid repository name.
        huggingface_hub.errors.HfHubHTTPError: The Hub rejects a request.
    """
    from huggingface_hub import HfApi
    from huggingface_hub.utils import validate_repo_id

    if repo.count("/") != 1:
        raise ValueError(f"repository name {repo!r} must have the form OWNER/NAME")
    validate_repo_id(repo)
    folder = open_folder(path)
    report = check_dataset(path)
    if report.errors and not unsound:
        raise DatasetError(
            f"has {len(report.errors)} errors: repair the dataset, or upload it as it is "
            f"(--unsound). The first: {report.errors[0]}",
            file=folder.root,
        )
    push = Push(
        repo=repo,
        tag=folder.version,
        files=dict(_files(folder.root)),
        card=str(dataset_card(folder, report, repo, license, tags)),
        report=report,
    )
    if dry_run:
        return push
    api = api or HfApi()
    url = api.create_repo(repo, repo_type="dataset", private=private, exist_ok=True)
    _upload(api, folder.root, push)
    return replace(push, url=str(url))


def _upload(api: "HfApi", root: Path, push: Push) -> None:
    """Upload the files, then set the tag with the format version."""
    where: Any = {"repo_id": push.repo, "repo_type": "dataset"}
    api.upload_file(
        path_or_fileobj=push.card.encode(),
        path_in_repo=_CARD,
        commit_message="Describe the dataset",
        **where,
    )
    api.upload_folder(
        folder_path=root,
        allow_patterns=[*UPLOADED],
        ignore_patterns=[_CARD],
        delete_patterns=[*UPLOADED[:4]],
        commit_message="Upload the dataset",
        **where,
    )
    known = api.list_repo_refs(push.repo, repo_type="dataset").tags
    if push.tag in [tag.name for tag in known]:
        api.delete_tag(push.repo, tag=push.tag, repo_type="dataset")
    api.create_tag(push.repo, tag=push.tag, repo_type="dataset")


def _files(root: Path) -> Iterator[tuple[str, int]]:
    for pattern in UPLOADED:
        for path in sorted(root.glob(pattern.replace("/**", "/**/*"))):
            if path.is_file():
                yield str(path.relative_to(root)), path.stat().st_size


def dataset_card(
    folder: DatasetFolder,
    report: ValidationReport,
    repo: str,
    license: str | None = None,
    tags: Sequence[str] = (),
) -> "DatasetCard":
    """The dataset card: the `README.md` of the folder with a completed header, or a new card.

    Args:
        folder: The dataset.
        report: Result of `check_dataset`, including the meaning and unit of each column.
        repo: "OWNER/NAME" on the Hub.
        license: Identifier of the licence.
        tags: Tags besides "LeRobot" and the robot's name.
    """
    from huggingface_hub import DatasetCard, DatasetCardData

    own = folder.root / _CARD
    if own.is_file():
        card = DatasetCard(own.read_text(encoding="utf-8"), ignore_metadata_errors=True)
    else:
        shown = Counter(task for entry in folder.episodes for task in entry.tasks)
        *findings, counts = report.lines()
        card = DatasetCard.from_template(
            DatasetCardData(),
            template_path=str(_TEMPLATE),
            repo=repo,
            folder=folder,
            frames=sum(entry.length for entry in folder.episodes),
            tasks=shown.most_common(_MOST_TASKS),
            cameras=[feature for feature in folder.features.values() if feature.is_picture],
            report=report,
            findings=findings,
            counts=counts.removeprefix(f"{report.path}: "),
            cell=_cell,
        )
    head: Any = card.data
    if license is not None:
        head.license = license
    robot = [folder.robot_type] if folder.robot_type not in (None, "", "unknown") else []
    earlier = getattr(head, "tags", None) or []
    head.tags = [*dict.fromkeys([*earlier, "LeRobot", *robot, *tags])]
    head.task_categories = head.task_categories or ["robotics"]
    if not getattr(head, "configs", None):
        # The Hub's dataset viewer and `datasets.load_dataset` read `configs`.
        head.configs = [{"config_name": "default", "data_files": "data/*/*.parquet"}]
    card.data = head
    return card


def _cell(text: str) -> str:
    """Text from a dataset, safe in a table of the card."""
    return plain_text(text).replace("|", "\\|").replace("<", "&lt;")
