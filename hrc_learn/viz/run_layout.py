"""How the dashboard of a run is laid out."""

import numpy as np
import rerun.blueprint as rrb
from jaxtyping import Float

from .panels import run_tabs
from .recording import RunRecording
from .rerun_file import TIMELINE, look_at_all, tab_view


def run_outline(run: RunRecording) -> tuple:
    """What the layout depends on: runs with equal ones share a layout."""
    plots = [(tab.title, [plot.title for plot in tab.plots]) for tab in run_tabs(run)]
    return plots, run.camera is not None, bool(run.phases)


def run_layout(run: RunRecording) -> rrb.Blueprint:
    """The robot and its camera beside tabs of curves."""
    scene = rrb.Spatial3DView(
        origin="/world",
        contents=["+ /world/**", "- /world/camera/image/**"],
        name="Robot: path of the run (blue), demonstration (grey), plan (orange)",
        eye_controls=look_at_all(_sights(run)),
    )
    left: list[rrb.View] = [scene]
    if run.camera is not None:
        left.append(
            rrb.Spatial2DView(
                origin="/world/camera/image",
                name="Camera: feature (orange dot), target (green cross), path (blue) [px]",
                contents=["$origin/**"],
            )
        )
    tabs = [tab_view(tab) for tab in run_tabs(run)]
    right: list[rrb.Container | rrb.View] = [rrb.Tabs(contents=tabs, active_tab=0)]
    if run.phases:
        # The text tells the time as well: all other columns would only narrow it.
        text = rrb.TextLogColumns(timeline_columns=[], text_log_columns=["Body"])
        right.append(rrb.TextLogView(origin="/phases", name="Phases of the task", columns=text))
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(contents=left, row_shares=[3, 2][: len(left)]),
            rrb.Vertical(contents=right, row_shares=[5, 1][: len(right)]),
            column_shares=[1, 1],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        collapse_panels=True,
    )


def _sights(run: RunRecording) -> Float[np.ndarray, "n 3"]:
    """What the first look at the scene should not miss: the path and the camera."""
    eyes = [] if run.camera is None else [run.camera.model.pose[None, :3, 3]]
    return np.concatenate([run.position, *eyes])
