"""What is wrong with a dataset, and where: the one form that errors and reports share."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One fault or oddity of a dataset, located as closely as is known."""

    message: str
    """What is wrong and what to do about it."""
    file: str | None = None
    """File the fault lies in, relative to the dataset where possible."""
    episode: int | None = None
    """Episode index."""
    frame: int | None = None
    """First frame concerned, counted from the start of the episode."""
    key: str | None = None
    """Column (feature) concerned, with the name of its component where one is to blame."""

    def __str__(self) -> str:
        episode = None if self.episode is None else f"episode {self.episode}"
        frame = None if self.frame is None else f"frame {self.frame}"
        place = ", ".join(part for part in (self.file, episode, frame, self.key) if part)
        return f"{place}: {self.message}" if place else self.message


class DatasetError(ValueError):
    """A dataset that cannot be read, with the place of the fault as attributes.

    Attributes:
        finding: The fault and its place; `.file`, `.episode`, `.frame`, `.key` are its own.
    """

    def __init__(
        self,
        message: str,
        *,
        file: str | Path | None = None,
        episode: int | None = None,
        frame: int | None = None,
        key: str | None = None,
    ):
        self.finding = Finding(
            message=message,
            file=None if file is None else str(file),
            episode=episode,
            frame=frame,
            key=key,
        )
        super().__init__(str(self.finding))

    @property
    def file(self) -> str | None:
        return self.finding.file

    @property
    def episode(self) -> int | None:
        return self.finding.episode

    @property
    def frame(self) -> int | None:
        return self.finding.frame

    @property
    def key(self) -> str | None:
        return self.finding.key


class UnitsWarning(UserWarning):
    """Values were converted from units that the dataset does not declare."""
