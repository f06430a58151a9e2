"""Serve a browser page on which a person accepts, trims and rejects episodes of a dataset."""

from __future__ import annotations

import asyncio
import struct
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from hrc_learn.demos import DatasetError, open_demos
from hrc_learn.demos.dataset_views import Chart, demonstration_charts
from hrc_learn.demos.images import ImageReader, jpeg, thumbnail_size
from hrc_learn.demos.issues import plain_text
from hrc_learn.demos.quality.ranking import (
    MEASURES,
    Decision,
    Ranking,
    keep_decisions,
    read_decisions,
    write_curated,
)
from hrc_learn.demos.read.dataset_folder import open_folder
from hrc_learn.store import json_text
from hrc_learn.teleoperation.gate import AddressConfig, Content, Gate, folder_contents
from hrc_learn.teleoperation.gate.admission import RefusedError
from hrc_learn.teleoperation.gate.gate import Visitor, incoming
from hrc_learn.teleoperation.gate.messages import CurationMessage, Decide, curation_message

_BLOCK = 32
"""Number of images sent together: about a second of video, few enough to be shown soon."""
_TALLEST = 360
"""Images are scaled down to this height [px]."""
_MOST_LINES = 12
"""Largest number of components of a column of unknown meaning; a column with more components
is not drawn."""
_MOST_POINTS = 2000
"""Largest number of points of a curve. A longer curve is reduced to the extremes of its
sections."""
_CLIENT = Path(__file__).parent / "curation_client"


class CurationPage:
    """Browser page for reviewing ranked episodes. Each decision is saved immediately, next to
    the dataset.

        with CurationPage(rank_episodes(path), out) as page:
            print(page.url)
            page.wait()

    Attributes:
        decisions: Current decisions by episode.
        url: Address of the page, including its secret.
    """

    def __init__(self, ranking: Ranking, out: Path, address: AddressConfig | None = None):
        """Read the decisions made so far and bind the server to its port.

        Args:
            ranking: Ranking of the dataset's episodes.
            out: Folder that receives the cleaned dataset.
            address: Host, port and certificate of the page.

        Raises:
            DatasetError: The saved decisions belong to another dataset.
            ValueError: The page cannot be served at this address, or not securely.
        """
        config = address or AddressConfig()
        self.ranking, self.out = ranking, out
        self.decisions = read_decisions(ranking.path)
        self._lengths = {q.episode: q.length for q in ranking.episodes}
        self._images = ImageReader(ranking.path)
        self._features = open_folder(ranking.path).features
        self._lock, self._writing = Lock(), ThreadPoolExecutor(1)
        self._written: Future[str] | None = None
        routes = {"session": self._session}
        self._gate = Gate(config, folder_contents(_CLIENT), routes, self.answer)
        self.url = self._gate.address.link()

    def __enter__(self) -> CurationPage:
        self._gate.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._gate.close()
        self._writing.shutdown()

    def wait(self) -> None:
        """Wait until the page is closed by another thread, or for Ctrl-C."""
        self._gate.wait()

    def answer(self, path: str) -> Content | None:
        """Content at a path; None: there is no content.

        Raises:
            RefusedError: The content cannot be read.
        """
        try:
            match path.strip("/").split("/"):
                case ["data", "overview"]:
                    return _json(self.overview())
                case ["data", "state"]:
                    return _json(self.state())
                case ["data", "curves", episode]:
                    return _json(self.curves(int(episode)))
                case ["data", "images", episode, camera, first]:
                    return self.images(int(episode), int(camera), int(first))
        except DatasetError as error:
            raise RefusedError(422, str(error)) from error
        except (ValueError, LookupError):  # no such number
            return None
        return None

    def overview(self) -> dict[str, Any]:
        """All that the page shows before an episode is chosen."""
        episodes = [asdict(q) for q in self.ranking.episodes]
        for episode in episodes:
            cameras = self._images.available(episode["episode"])
            episode["cameras"] = [self._images.cameras.index(key) for key in cameras]
        # The most typical episode is shown next to every other episode.
        known = [q for q in self.ranking.episodes if "distance" in q.measures and not q.broken]
        usual = min(known, key=lambda q: q.measures["distance"], default=None)
        return {
            "name": plain_text(self.ranking.path.resolve().name),
            "notes": self.ranking.notes,
            "measures": MEASURES,
            "cameras": [plain_text(key.rpartition(".")[2]) for key in self._images.cameras],
            "block": _BLOCK,
            "episodes": episodes,
            "usual": None if usual is None else usual.episode,
            **self.state(),
        }

    def state(self) -> dict[str, Any]:
        """Decisions made so far, and the progress of writing the cleaned dataset."""
        with self._lock:
            written = {"out": str(self.out), "writing": False, "said": "", "failed": False}
            if self._written is not None:
                written["writing"] = not self._written.done()
                if self._written.done():
                    error = self._written.exception()
                    written["failed"] = error is not None
                    written["said"] = str(error) if error else self._written.result()
            return {"decisions": self.decisions, "written": written}

    def curves(self, episode: int) -> dict[str, Any]:
        """Curves of all quantities of an episode over time."""
        source = open_demos(self.ranking.path, [episode])
        (demo,) = source
        charts = [*demonstration_charts(demo, source.units)]
        for key, values in demo.extra.items():  # columns of unknown meaning, by their names
            if 0 < values.shape[1] <= _MOST_LINES:
                names = map(self._features[key].component, range(values.shape[1]))
                charts.append(Chart(key, key, "", dict(zip(names, values.T, strict=True))))
        return {
            "time": demo.time,
            "charts": [
                {
                    "name": plain_text(chart.title),
                    "unit": chart.unit,
                    "lines": [
                        {"name": plain_text(name), "points": _points(values)}
                        for name, values in chart.lines.items()
                    ],
                }
                for chart in charts
            ],
        }

    def images(self, episode: int, camera: int, first: int) -> Content:
        """A block of images: their number, each image's length in bytes, then the images."""
        key = self._images.cameras[camera]
        if episode not in self._lengths or not 0 <= first < self._lengths[episode]:
            raise RefusedError(404, "There is no such image.")
        wanted = range(first, min(first + _BLOCK, self._lengths[episode]))
        size = thumbnail_size(*self._images.size(key), _TALLEST)
        found = [jpeg(image) for _, image in self._images.stream(episode, key, wanted, size)]
        head = struct.pack(f"<{1 + len(found)}I", len(found), *map(len, found))
        return Content(body=head + b"".join(found), kind="application/octet-stream")

    async def _session(self, connection: Any, visitor: Visitor) -> None:
        """Receive messages, and answer each with the new state or the reason of a refusal."""
        async for _, message in incoming(connection, curation_message):
            try:
                await asyncio.to_thread(self.act, message)
                told = self.state()
            except (ValueError, OSError) as error:
                told = {"refused": str(error)}
            await connection.send(json_text(told, indent=False))

    def act(self, message: CurationMessage) -> None:
        """Apply a decision, or begin to write the cleaned dataset.

        Raises:
            ValueError: The decision is invalid, or the dataset is already being written.
        """
        with self._lock:
            if isinstance(message, Decide):
                self._decide(message)
            elif self._written is not None and not self._written.done():
                raise ValueError("The cleaned dataset is being written.")
            else:
                self._written = self._writing.submit(self._write, dict(self.decisions))

    def _decide(self, message: Decide) -> None:
        episode = message.episode
        if episode not in self._lengths:
            raise ValueError(f"There is no episode {episode}.")
        decisions = {index: d for index, d in self.decisions.items() if index != episode}
        if message.verdict is not None:
            decisions[episode] = Decision(
                verdict=message.verdict,
                length=self._lengths[episode],
                start=message.start,
                stop=message.stop,
            )
        keep_decisions(self.ranking.path, decisions)
        self.decisions = decisions

    def _write(self, decisions: dict[int, Decision]) -> str:
        report = write_curated(self.ranking.path, self.out, decisions)
        return (
            f"{len(report.changes)} episodes with {report.frames} of {report.frames_before} "
            f"frames are in {self.out}"
        )


def _json(content: Any) -> Content:
    return Content(body=json_text(content, indent=False).encode(), kind="application/json")


def _points(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames and values of a curve; a long curve is reduced to the extremes of its sections, so
    that no spike is lost.
    """
    frames = np.arange(len(values))
    if len(values) <= _MOST_POINTS:
        return frames, values
    # NaN is no extreme; a section without any number remains a gap.
    low, high = (np.where(np.isnan(values), end, values) for end in (np.inf, -np.inf))
    sections = np.array_split(frames, _MOST_POINTS // 2)
    ends = [(part[low[part].argmin()], part[high[part].argmax()]) for part in sections]
    chosen = np.unique(ends)
    return chosen, values[chosen]
