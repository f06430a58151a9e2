"""Several demonstrations of one robot."""

from collections.abc import Callable, Iterator, Sequence
from typing import overload

from .demonstration import Demonstration
from .padding import PaddedDemonstrations, pad


class DemonstrationSet(Sequence[Demonstration]):
    """Demonstrations of one robot, in the order they were read.

    Attributes:
        notes: What the reader guessed or converted, one sentence each; show it to the user.
        source: The dataset's folder, "" for demonstrations made in memory.
    """

    def __init__(
        self,
        demonstrations: Sequence[Demonstration],
        *,
        notes: Sequence[str] = (),
        source: str = "",
    ):
        self._demonstrations = tuple(demonstrations)
        self.notes = tuple(notes)
        self.source = source
        names = {demo.joint_names for demo in self._demonstrations}
        if len(names) > 1:
            raise ValueError(
                f"demonstrations of one set share their joints, but these differ: {names}. "
                f"select_joints(names) brings them to one order."
            )

    @overload
    def __getitem__(self, index: int) -> Demonstration: ...
    @overload
    def __getitem__(self, index: slice) -> "DemonstrationSet": ...
    def __getitem__(self, index):
        if isinstance(index, slice):
            return DemonstrationSet(
                self._demonstrations[index], notes=self.notes, source=self.source
            )
        return self._demonstrations[index]

    def __len__(self) -> int:
        return len(self._demonstrations)

    def __iter__(self) -> Iterator[Demonstration]:
        return iter(self._demonstrations)

    def __repr__(self) -> str:
        return (
            f"DemonstrationSet({len(self)} demonstrations, {self.frames} frames, "
            f"joints: {', '.join(self.joint_names) or 'none'})"
        )

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self._demonstrations[0].joint_names if self._demonstrations else ()

    @property
    def frames(self) -> int:
        """Frames of all demonstrations together."""
        return sum(map(len, self._demonstrations))

    def select_joints(self, names: Sequence[str]) -> "DemonstrationSet":
        """The same demonstrations with these joints only, in this order.

        Raises:
            DatasetError: A name is not among `joint_names`.
        """
        return DemonstrationSet(
            [demo.select_joints(names) for demo in self], notes=self.notes, source=self.source
        )

    def filter(self, wanted: Callable[[Demonstration], bool]) -> "DemonstrationSet":
        """Only the demonstrations for which `wanted` is true."""
        chosen = [demo for demo in self if wanted(demo)]
        return DemonstrationSet(chosen, notes=self.notes, source=self.source)

    def map(self, change: Callable[[Demonstration], Demonstration]) -> "DemonstrationSet":
        """What `change` makes of each demonstration, such as a step of `demos.preparation`."""
        changed = [change(demo) for demo in self]
        return DemonstrationSet(changed, notes=self.notes, source=self.source)

    def padded(self) -> PaddedDemonstrations:
        """All demonstrations as tensors of one length, with a mask.

        Raises:
            ValueError: The set is empty.
        """
        if not self._demonstrations:
            raise ValueError("an empty set of demonstrations has no padded form")
        return pad(self._demonstrations)
