"""Failures of a task."""


class TaskFailedError(RuntimeError):
    """A task failed; the message says in which phase and why."""


class MissedGraspError(TaskFailedError):
    """A grasp failed; another attempt may succeed."""


class StoppedByPersonError(TaskFailedError):
    """A person or a contact has stopped the arm; it is at rest."""


class BlockedPathError(TaskFailedError):
    """A planned motion would collide, or leave the limits of the arm."""
