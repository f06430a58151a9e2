"""Measured values in the terminal."""

from collections.abc import Sequence

from .content import Measurement


def show_measurements(table: Sequence[Measurement], title: str = "Measured") -> None:
    """Print measured values beside their targets."""
    from rich.console import Console
    from rich.table import Table

    shown = Table("measured", "value", "target", "", title=title)
    marks = {True: "[green]ok[/]", False: "[red]missed[/]", None: ""}
    for m in table:
        shown.add_row(m.name, m.shown, m.bound, marks[m.ok])
    Console().print(shown)
