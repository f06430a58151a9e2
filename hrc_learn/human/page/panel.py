"""The panel beside the scene: how things stand, buttons and settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float

from ...protocols import DrawnRegion, Request
from ...viz import Box
from ..drag import DragConfig
from .config import PageConfig, PageStatus
from .controls import HandControls, PullControls, RecordingControls
from .library import ViserServer
from .panel_html import effort_html, interventions_html, state_html
from .region_editor import RegionEditor


class Panel:
    """All controls, and the status above them."""

    def __init__(
        self,
        server: ViserServer,
        boxes: Sequence[Box],
        config: PageConfig,
        request: Callable[[Request], None],
        show_twin: Callable[[bool], None],
        let_turn: Callable[[bool], None],
        task: str,
        *,
        leads: bool = True,
    ):
        """Build the panel.

        Args:
            server: Of the page.
            boxes: Furniture that targets may be marked on.
            config: Of the page.
            request: Receives what buttons ask for.
            show_twin: Shows or hides the twin.
            let_turn: Whether the hand's handle can be turned.
            task: What is to be shown, in words.
            leads: Whether the person leads the hand, draws regions and records; otherwise
                there are no controls but those of pulls.
        """
        self._largest_effort = config.drag.largest_effort
        gui = server.gui
        gui.configure_theme(
            control_width="medium",
            show_logo=False,
            show_share_button=False,
            brand_color=(0, 114, 178),
        )
        gui.main_panel.dock_right()
        self._state = gui.add_html("")
        self._recording = self._hand = self._region = None
        if leads:
            with gui.add_folder("Demonstration"):
                self._recording = RecordingControls(server, request, task)
        with gui.add_folder("Effort and safety"):
            self._bars = gui.add_html("")
            self._safety = gui.add_html("")
        with gui.add_folder("Arm"):
            if leads:
                self._hand = HandControls(server, let_turn)
            self._pull = PullControls(server, config.drag, show_twin)
        if leads:
            with gui.add_folder("Region and target"):
                self._region = RegionEditor(server, boxes)
        self._seen: Mapping[str, int] = {}
        self._latest = ""

    @property
    def task(self) -> str:
        """What is shown, in words."""
        return "" if self._recording is None else self._recording.task

    @property
    def coarse(self) -> bool:
        """Whether the hand turns by the coarse orientation rule."""
        return self._hand is None or self._hand.coarse

    @property
    def gripper(self) -> float | None:
        """Opening the person wants [m]; None until asked for."""
        return None if self._hand is None else self._hand.gripper

    @property
    def region(self) -> DrawnRegion | None:
        """The region in force."""
        return None if self._region is None else self._region.region

    @property
    def target(self) -> tuple[float, float, float] | None:
        """The point marked [m]."""
        return None if self._region is None else self._region.target

    @property
    def drag(self) -> DragConfig:
        """How strongly handles act."""
        return self._pull.drag

    def direction(self) -> Float[np.ndarray, "3"]:
        """Where keys lead the hand: a unit vector, or zero."""
        return np.zeros(3) if self._hand is None else self._hand.direction()

    def refresh(
        self,
        status: PageStatus,
        effort: Float[np.ndarray, " joints"],
        rate: float,
        people: int,
    ) -> None:
        """Show how things stand.

        Args:
            status: Of the session.
            effort: That is asked for now.
            rate: Steps that the loop takes [1/s].
            people: Browsers that show the page.
        """
        if self._recording is not None:
            self._recording.refresh(status.recording == "recording")
        self._state.content = state_html(status, rate, people)
        self._bars.content = effort_html(effort, self._largest_effort)
        self._safety.content = self._safety_html(status)

    def _safety_html(self, status: PageStatus) -> str:
        more = [
            name
            for name, count in status.interventions.items()
            if count > self._seen.get(name, 0)
        ]
        self._seen = dict(status.interventions)
        if more:
            self._latest = more[-1]
        return interventions_html(status, more, self._latest)
