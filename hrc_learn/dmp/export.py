"""Primitives for other programs: a NumPy stepper, and the step as a `torch.export` program.

The program is of a batch of any size and takes dictionaries of tensors, so that a loop runs it
without this package:

    program = torch.export.load("place/step.pt2").module()
    state = program(state, dt, inputs)
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram
from torch.utils._pytree import tree_map

from hrc_learn import store
from hrc_learn.dmp.joint import JointDMP
from hrc_learn.dmp.orientation import OrientationDMP
from hrc_learn.dmp.orientation_motion import OrientationState
from hrc_learn.dmp.orientation_stepper import OrientationStepper
from hrc_learn.dmp.pose import PoseDMP
from hrc_learn.dmp.pose_columns import BODY, ERROR, POSITION
from hrc_learn.dmp.pose_motion import PoseState
from hrc_learn.dmp.pose_stepper import PoseStepper
from hrc_learn.dmp.rotation.error import to_orientation
from hrc_learn.dmp.state import DMPState
from hrc_learn.dmp.stepper import Stepper
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.storage import saved_kind

REFERENCE = "reference"
PRIMITIVE, PROGRAM = "primitive", "step.pt2"
STATE = tuple(field.name for field in fields(DMPState))
TRACED_BATCH = 3
"""Any but 0 and 1, which a tracer would take for constants."""
SAME = 8
"""Angles of fewer roundings than this are none."""

type Exportable = JointDMP | OrientationDMP | PoseDMP
type Tensors = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedDMP:
    """A primitive ready to leave Python's training side."""

    dmp: Exportable
    stepper: Stepper | OrientationStepper | PoseStepper | None
    """One motion in NumPy, float64; None for what is integrated (`formulation="ude"`)."""
    program: ExportedProgram
    """(state, dt, inputs) -> state, dictionaries of tensors (B, ...), dt (B,) [s].

    A state is what `state_tensors` makes of one. Inputs are `slowdown`, `coupling` and `goal`,
    for a pose instead of that `goal_position`, `goal_orientation` and `goal_body`, and its
    coupling is (B, 6); all are needed, and `resting_inputs` change nothing.
    """

    def save(self, folder: str | Path) -> None:
        """Write the primitive and `step.pt2` into `folder`, replacing an older export.

        Raises:
            InTheWayError: A ValueError: `folder` holds anything else; it is left alone.
            BusyError: Another process is writing there.
        """
        with store.replacing(folder, store.EXPORT, overwrite=True) as new:
            new.mkdir()
            self.dmp.save(new / PRIMITIVE)
            torch.export.save(self.program, new / PROGRAM)


def export_dmp(dmp: Exportable, *, goal_filter: float | None = None) -> ExportedDMP:
    """Freeze one primitive.

    Args:
        dmp: Not a batch.
        goal_filter: Of the program, as in `step`; the stepper's goals are there at once.

    Raises:
        ValueError: The primitive is a batch.
    """
    linear = dmp if isinstance(dmp, JointDMP) else dmp.motion
    if linear.weights.ndim != 2:
        raise ValueError(f"export takes one primitive, got a batch {linear.weights.shape[:-2]}")
    return ExportedDMP(dmp=dmp, stepper=_stepper(dmp), program=_program(dmp, goal_filter))


def load_stepper(folder: str | Path) -> Stepper | OrientationStepper | PoseStepper:
    """The NumPy stepper of what `ExportedDMP.save` wrote, or of a saved primitive.

    Raises:
        FileNotFoundError: No export there.
        ValueError: Names the file and the field that is wrong.
    """
    folder = Path(folder)
    store.settle(folder)
    folder = folder / PRIMITIVE if (folder / PRIMITIVE).is_dir() else folder
    kinds: dict[str, type[Exportable]] = {
        kind.__name__: kind for kind in (JointDMP, OrientationDMP, PoseDMP)
    }
    kind = saved_kind(folder)
    if kind not in kinds:
        raise ValueError(f"{folder}: steps {', '.join(kinds)}, got {kind!r}")
    stepper = _stepper(kinds[kind].load(folder))
    if stepper is None:
        raise ValueError(f"{folder}: its formulation has no stepper, run the program instead")
    return stepper


def state_tensors(state: DMPState | OrientationState | PoseState) -> Tensors:
    """A state as the program takes it: (*batch, ...) by name, a batch axis where none was."""
    motion = state if isinstance(state, DMPState) else state.motion
    tensors = {name: getattr(motion, name) for name in STATE}
    if not isinstance(state, DMPState):
        tensors[REFERENCE] = state.reference
    if motion.duration.ndim == 0:
        tensors = {name: x[None] for name, x in tensors.items()}
    # One tensor in two places would be one input to a tracer.
    return {name: x.detach().clone() for name, x in tensors.items()}


class StepModule(nn.Module):
    """The step of a primitive between dictionaries of tensors."""

    def __init__(self, dmp: Exportable, goal_filter: float | None):
        super().__init__()
        self.dmp = dmp
        self.goal_filter = goal_filter

    def forward(self, state: Tensors, dt: Tensor, inputs: Tensors) -> Tensors:
        motion = DMPState(**{k: x for k, x in state.items() if k != REFERENCE})
        options: dict[str, Any] = {"goal_filter": self.goal_filter}
        options["slowdown"] = inputs["slowdown"]
        options["coupling"] = inputs["coupling"]
        if isinstance(self.dmp, JointDMP):
            return _tensors(self.dmp.step(motion, dt, goal=inputs["goal"], **options))
        if isinstance(self.dmp, OrientationDMP):
            before = OrientationState(motion=motion, reference=state[REFERENCE])
            before = _where_new(self.dmp.retarget(before, inputs["goal"]), before)
            after = self.dmp.step(before, dt, **options)
        else:
            before = PoseState(motion=motion, reference=state[REFERENCE])
            goal = Pose(inputs["goal_position"], inputs["goal_orientation"])
            before = _where_new(self.dmp.retarget(before, goal), before)
            after = self.dmp.step(before, dt, goal_body=inputs["goal_body"], **options)
        return _tensors(after.motion) | {REFERENCE: after.reference.clone()}


def _where_new[S: (OrientationState, PoseState)](new: S, old: S) -> S:
    """A state with a new goal, where that is another one.

    Whole turns away from its goal an orientation would lose velocity to one that stays.
    """
    away = quaternion.angle(new.reference, old.reference)
    changed = away > SAME * torch.finfo(away.dtype).eps
    changed = changed | (new.motion.target != old.motion.target).any(-1)

    def choose(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(changed.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return tree_map(choose, new, old)


def _tensors(state: DMPState) -> Tensors:
    # Copies: a program must not hand back what it was given.
    return {name: getattr(state, name).clone() for name in STATE}


def _stepper(dmp: Exportable) -> Stepper | OrientationStepper | PoseStepper | None:
    if isinstance(dmp, PoseDMP):
        return PoseStepper(dmp)
    if isinstance(dmp, JointDMP):
        return Stepper(dmp)
    return OrientationStepper(dmp) if dmp.formulation == "log" else None


def _program(dmp: Exportable, goal_filter: float | None) -> ExportedProgram:
    trained = {name: p.requires_grad for name, p in dmp.named_parameters()}
    dmp.requires_grad_(False)
    try:
        state = state_tensors(dmp.initial_state())
        state = {k: x.repeat(TRACED_BATCH, *[1] * (x.ndim - 1)) for k, x in state.items()}
        inputs = resting_inputs(dmp, state)
        arguments = state, torch.full_like(state["pace"], 1e-3), inputs
        first = {0: Dim("batch", min=1)}
        shapes = dict.fromkeys(state, first), first, dict.fromkeys(inputs, first)
        step = StepModule(dmp, goal_filter)
        return torch.export.export(step, arguments, dynamic_shapes=shapes)
    finally:
        for name, parameter in dmp.named_parameters():
            parameter.requires_grad_(trained[name])


def resting_inputs(dmp: Exportable, state: Mapping[str, Tensor]) -> Tensors:
    """Inputs of the program that change nothing: the goal as it is, and no influence."""
    target, slowdown = state["target"], torch.zeros_like(state["pace"])
    if isinstance(dmp, JointDMP):
        goals, push = {"goal": target.clone()}, torch.zeros_like(target)
    elif isinstance(dmp, OrientationDMP):
        goals = {"goal": to_orientation(dmp.motion.goal.detach(), state[REFERENCE])}
        push = torch.zeros_like(target)
    else:
        error = dmp.motion.goal.detach()[ERROR]
        goals = {
            "goal_position": target[:, POSITION].clone(),
            "goal_orientation": to_orientation(error, state[REFERENCE]),
            "goal_body": target[:, BODY].clone(),
        }
        push = torch.zeros_like(target[:, :6])
    return {"slowdown": slowdown, "coupling": push, **goals}
