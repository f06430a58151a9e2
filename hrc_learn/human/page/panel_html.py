"""What the panel says, as HTML."""

import html
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...viz.palette import BLUE, GREEN, GREY, PERSON, VERMILION
from .config import PageStatus


def state_html(status: PageStatus, rate: float, people: int) -> str:
    """What is led here, what it is doing, and who watches.

    Args:
        status: Of the session.
        rate: Steps that the loop takes [1/s].
        people: Browsers that show the page.
    """
    return (
        '<div style="padding:.2em .9em .5em;line-height:1.5">'
        f'<div style="font-size:1.15em;font-weight:600">{html.escape(status.title)}</div>'
        f"{_doing_html(status) if status.doing else _recording_html(status)}"
        f'<div style="opacity:.75;font-size:.85em">{html.escape(status.note) or "&nbsp;"}</div>'
        f'<div style="opacity:.75;font-size:.85em">{rate:.0f} steps a second, '
        f"{people} connected</div></div>"
    )


def _doing_html(status: PageStatus) -> str:
    return f"{_badge(BLUE, status.doing)}&ensp;{status.seconds:.1f} s"


def _recording_html(status: PageStatus) -> str:
    colour = {"ready": GREY, "recording": VERMILION, "stopped": PERSON}[status.recording]
    words = {
        "ready": "ready",
        "recording": f"recording {status.seconds:.1f} s",
        "stopped": f"stopped at {status.seconds:.1f} s",
    }[status.recording]
    return f"{_badge(colour, words)}&ensp;{status.saved} saved"


def _badge(colour: str, words: str) -> str:
    return (
        f'<span style="color:white;background:{colour};border-radius:.8em;padding:.1em .7em">'
        f"{html.escape(words)}</span>"
    )


def effort_html(effort: Float[np.ndarray, " joints"], largest: float) -> str:
    """A bar to the left or right for each joint.

    Args:
        effort: d [N m].
        largest: That fills half the width [N m].
    """
    rows = []
    for k, d in enumerate(effort):
        width = 50 * min(abs(d) / largest, 1.0)
        left = 50 - (width if d < 0 else 0)
        rows.append(
            f'<div style="display:flex;align-items:center;height:1.15em">'
            f'<span style="width:1.4em;opacity:.7">{k + 1}</span>'
            '<div style="flex:1;position:relative;height:.7em;background:rgba(128,128,128,.15);'
            'border-radius:.2em"><div style="position:absolute;height:100%;'
            f"left:{left:.1f}%;width:{width:.1f}%;background:{PERSON};"
            'border-radius:.2em"></div></div>'
            f'<span style="width:3.4em;text-align:right">{d:+.1f}</span></div>'
        )
    return _block("Effort d [N m]", "".join(rows))


def interventions_html(status: PageStatus, more: Sequence[str], latest: str) -> str:
    """What the safety filter had to do.

    Args:
        status: Of the session.
        more: Kinds of interventions that have just been needed.
        latest: Kind that was needed last; empty if none was.
    """
    rows = [
        f'<tr style="{f"color:{VERMILION};font-weight:600" if name in more else ""}">'
        f"<td>{html.escape(name.replace('_', ' '))}</td>"
        f'<td style="text-align:right">{count}</td></tr>'
        for name, count in status.interventions.items()
        if count
    ]
    nothing = f'<tr><td style="color:{GREEN}">the filter has not had to act</td></tr>'
    contacts = (
        f'<tr style="color:{VERMILION}"><td>touches of the surroundings</td>'
        f'<td style="text-align:right">{status.contacts}</td></tr>'
    )
    table = "".join(rows) or nothing
    table += contacts if status.contacts else ""
    words = f"Safety filter, steps; latest: {latest}" if latest else "Safety filter"
    return _block(words, f'<table style="width:100%;border-spacing:0">{table}</table>')


def _block(title: str, content: str) -> str:
    title = html.escape(title.replace("_", " "))
    return (
        '<div style="padding:.2em .9em .4em;font-size:.85em">'
        f'<div style="opacity:.75;margin-bottom:.2em">{title}</div>'
        f"{content}</div>"
    )
