"""How tasks fail: the work could not be done, though nothing was wrong with the request."""


class TaskFailedError(RuntimeError):
    """A task could not be carried out; says at which phase and why."""


class MissedGraspError(TaskFailedError):
    """A grasp came to nothing; another attempt may do."""


class BlockedPathError(TaskFailedError):
    """A planned motion would hit something or leave the limits of the arm."""
