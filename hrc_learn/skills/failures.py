"""How a task may fail."""


class TaskFailedError(RuntimeError):
    """A task could not be carried out; the message says at which phase and why."""


class MissedGraspError(TaskFailedError):
    """A grasp failed; another attempt may succeed."""


class StoppedByPersonError(TaskFailedError):
    """The person beside the arm has stopped it, or something has met it; it is at rest."""


class BlockedPathError(TaskFailedError):
    """A planned motion would collide or leave the limits of the arm."""
