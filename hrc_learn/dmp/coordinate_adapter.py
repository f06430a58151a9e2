"""Between what a caller gives and gets and the columns that move linearly.

A kind of primitive is an adapter around the one linear implementation: joints are columns as
they are, an orientation becomes its error to a reference, a pose both side by side, limited
joints coordinates without bounds, two arms a batch of two poses.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

from torch import Tensor

from hrc_learn.dmp._arguments import Scalars, Times
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp.linear_primitive import Ends, LinearPrimitive


class ColumnPoints(NamedTuple):
    """Columns at the times of via points, (*batch, n, D); NaN where they are free."""

    position: Tensor
    velocity: Tensor
    """Per second."""


class Retargeted(NamedTuple):
    """A motion under way that was given a new goal: it goes on from the same state."""

    columns: DMPState
    frame: Any
    target: Any = None
    """The new goal in columns; None: the one that `columns` has."""


class CoordinateAdapter[Value, Path, State](ABC):
    """Maps values to columns and back.

    `Value` is what starts and goals are given as, `Path` what a rollout returns, `State` what
    is stepped. The frame is what columns are relative to and may differ between motions: the
    reference of an orientation error, the velocity of a moving goal; None where there is none.
    `motion` is always the linear primitive that the columns are of.
    """

    linear: ClassVar[bool] = True
    """Whether the columns move as a linear primitive does."""
    error_columns: ClassVar[slice | None] = None
    """Which columns are the error of an orientation, if any."""
    has_body: ClassVar[bool] = False
    """Whether there are columns of the arm's body, which via points may name."""

    @abstractmethod
    def ends(
        self, motion: LinearPrimitive, given: Ends, duration: Tensor, **others: Any
    ) -> tuple[Ends, Any]:
        """Ends of a motion in columns, and its frame.

        Args:
            motion: Supplies what is None.
            given: Where it starts and ends, and how fast.
            duration: [s], as `each` made it.
            others: Ends that only this kind has.
        """

    @abstractmethod
    def trajectory(self, columns: Any, frame: Any) -> Path:
        """What a rollout returns."""

    @abstractmethod
    def state(self, columns: DMPState, frame: Any) -> State:
        """What is stepped."""

    @abstractmethod
    def columns(self, state: State) -> tuple[DMPState, Any]:
        """The columns of a state and their frame: the inverse of `state`."""

    @abstractmethod
    def retarget(
        self,
        motion: LinearPrimitive,
        columns: DMPState,
        frame: Any,
        goal: Value | None,
        **others: Any,
    ) -> Retargeted:
        """The same values and velocities, on the way to a new goal.

        Args:
            motion: Of the columns.
            columns: Where it is.
            frame: Of them.
            goal: New goal; None if only `others` are new.
            others: Goals that only this kind has.
        """

    @abstractmethod
    def via_points(
        self,
        motion: LinearPrimitive,
        now: ColumnPoints,
        value: Any,
        velocity: Any,
        **others: Any,
    ) -> ColumnPoints:
        """Values and velocities at times on the way, as columns in the primitive's own frame.

        Args:
            motion: Of the columns.
            now: Where the columns are when nothing else is asked for.
            value: As the caller gives it; None or NaN is free.
            velocity: Per second, likewise.
            others: Values that only this kind has.
        """

    def begin(self, columns: DMPState, frame: Any) -> tuple[DMPState, Any]:
        """Columns and frame at the start of a motion in closed loop."""
        return columns, frame

    def external_acceleration(
        self, motion: LinearPrimitive, columns: DMPState, frame: Any, coupling: Any
    ) -> Any:
        """A coupling term as second derivatives of the columns, per s^2."""
        return coupling

    def each(self, value: Scalars | None) -> Scalars | None:
        """One number for each primitive, as the linear ones take it."""
        return value

    def times(self, time: Times) -> Times:
        """Times of each primitive, as the linear ones take them."""
        return time

    def roll(
        self,
        motion: LinearPrimitive,
        ends: Ends,
        duration: Tensor,
        time: Times | None,
        forcing_gain: Scalars | None,
    ) -> Any:
        """Motion of the columns; as in `LinearPrimitive.roll` unless they are not linear."""
        return motion.roll(ends, duration, time, forcing_gain)

    def advance(
        self, motion: LinearPrimitive, columns: DMPState, dt: Any, **step: Any
    ) -> DMPState:
        """As in `LinearPrimitive.advance`, unless the columns are not linear."""
        return motion.advance(columns, dt, **step)
