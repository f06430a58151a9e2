"""What training returns."""

from dataclasses import dataclass

from hrc_learn.dmp.training.descent import History


@dataclass(frozen=True, kw_only=True, eq=False)
class TrainingResult[Primitive]:
    """A trained primitive and how it came about."""

    dmp: Primitive
    """The best one; the primitive it was made from is as it was."""
    history: History
