"""Exports of primitives for other programs: a NumPy stepper, and a `torch.export` program.

The program accepts batches of any size as dictionaries of tensors, so a control loop can run it
without this package:

    program = torch.export.load("place/step.pt2").module()
    state = program(state, dt, inputs)

The keys of a state are the names of its fields.
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
from hrc_learn.dmp.closed_loop_step import DMPState
from hrc_learn.dmp.joint_dmp import JointDMP
from hrc_learn.dmp.motion_primitive import MotionPrimitive
from hrc_learn.dmp.orientation_dmp import OrientationState
from hrc_learn.dmp.orientation_error import to_orientation
from hrc_learn.dmp.pose_dmp import BODY, POSITION, PoseDMP, PoseState
from hrc_learn.dmp.stepper import Stepper
from hrc_learn.geometry import Pose, quaternion

PRIMITIVE, PROGRAM = "primitive", "step.pt2"
STATE = tuple(field.name for field in fields(DMPState))
TRACED_BATCH = 3
"""Batch size during tracing: any except 0 and 1, which the tracer would treat as constants."""
ROUNDINGS = 8
"""Angles up to this many machine epsilons count as zero: quaternion products round 7 times."""
TRACED_STEP = 1e-3
"""Step [s] with which a program is traced; the program then accepts any step."""

type Tensors = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedDMP:
    """Primitive in forms that run outside of the training environment."""

    dmp: MotionPrimitive
    stepper: Stepper | None
    """NumPy stepper (float64) of a joint primitive; None for other kinds, which use
    `program`."""
    program: ExportedProgram
    """Program that maps (state, dt, inputs) to the next state.

    State and inputs are dictionaries of tensors (B, ...); dt is (B,) [s]. `state_tensors`
    returns such a state. Inputs are `phase_stopping`, `coupling` and `goal`; a pose has
    `goal_position`, `goal_orientation` and `goal_body` instead of `goal`, and its coupling is
    (B, 6). All inputs are required; the values of `resting_inputs` have no effect.
    """

    def save(self, folder: str | Path) -> None:
        """Write the primitive and `step.pt2` into `folder`, replacing an older export.

        Raises:
            InTheWayError: Something else is at `folder`, and stays unchanged. This error is a
                ValueError.
            BusyError: Another process is writing there.
        """
        with store.replacing(folder, store.EXPORT, overwrite=True) as new:
            new.mkdir()
            self.dmp.save(new / PRIMITIVE)
            torch.export.save(self.program, new / PROGRAM)


def export_dmp(dmp: MotionPrimitive, *, goal_filter: float | None = None) -> ExportedDMP:
    """Export one primitive.

    Args:
        dmp: A single primitive of any kind.
        goal_filter: Goal filter of the program, as in `step`; in the stepper, goals jump.

    Raises:
        TypeError: A model that is no primitive itself, but makes primitives.
        ValueError: The primitive is a batch.
    """
    if not isinstance(dmp, MotionPrimitive):
        raise TypeError(f"{type(dmp).__name__} is no primitive: export one that it makes")
    if dmp.duration.ndim:
        raise ValueError(f"export takes one primitive, got a batch {tuple(dmp.duration.shape)}")
    stepper = Stepper(dmp) if isinstance(dmp, JointDMP) else None
    return ExportedDMP(dmp=dmp, stepper=stepper, program=_program(dmp, goal_filter))


def load_stepper(folder: str | Path) -> Stepper:
    """NumPy stepper of an export, or of a saved joint primitive.

    Raises:
        FileNotFoundError: The folder holds no export.
        ValueError: Another kind of primitive, or a wrong field; the message names the file and
            the field.
    """
    folder = Path(folder)
    store.settle(folder)
    folder = folder / PRIMITIVE if (folder / PRIMITIVE).is_dir() else folder
    return Stepper(JointDMP.load(folder))


class StepModule(nn.Module):
    """Step of a primitive as a function of dictionaries of tensors."""

    def __init__(self, dmp: MotionPrimitive, goal_filter: float | None):
        super().__init__()
        self.dmp = dmp
        self.goal_filter = goal_filter

    def forward(self, state: Tensors, dt: Tensor, inputs: Tensors) -> Tensors:
        before, goals = _restored_state(self.dmp, state), _goals(inputs)
        options = {name: inputs[name] for name in ("phase_stopping", "coupling")}
        if self.dmp.error_columns is not None:
            goal = goals.pop("goal")
            filtered = self.goal_filter is not None
            new = self.dmp.retarget(before, goal, filtered=filtered)
            before = _where_new(new, before)
        after = self.dmp.step(before, dt, goal_filter=self.goal_filter, **goals, **options)
        # Copies, because a program must not return its inputs.
        return {name: x.clone() for name, x in _named(after).items()}


def state_tensors(state: Any) -> Tensors:
    """State for the program, as tensors (*batch, ...) by name; one motion is a batch of one."""
    tensors = _named(state)
    if not tensors["duration"].ndim:
        tensors = {name: x[None] for name, x in tensors.items()}
    # Copies, because the tracer treats one tensor in two places as one input.
    return {name: x.detach().clone() for name, x in tensors.items()}


def _named(state: Any) -> Tensors:
    """Tensors of a state by name, including the tensors of its columns."""
    tensors: Tensors = {}
    for name, part in vars(state).items():
        tensors |= _named(part) if isinstance(part, DMPState) else {name: part}
    return tensors


def _restored_state(dmp: MotionPrimitive, tensors: Tensors) -> Any:
    """State from its tensors; the inverse of `state_tensors`."""
    columns = DMPState(**{name: tensors[name] for name in STATE})
    # The frame: the reference of orientations, the velocity of moving goals, None for joints.
    return dmp.state_of(columns, tensors.get("reference", tensors.get("goal_velocity")))


def resting_inputs(dmp: Any, state: Mapping[str, Tensor]) -> Tensors:
    """Inputs of the program that have no effect: the current goal, and no coupling."""
    target, errors = state["target"], dmp.error_columns
    rest = {
        "phase_stopping": torch.zeros_like(state["pace"]),
        "coupling": torch.zeros_like(target),
    }
    if errors is None:
        return rest | {"goal": target.clone()}
    rotation = to_orientation(dmp.motion.goal.detach()[..., errors], state["reference"])
    if not isinstance(dmp, PoseDMP):
        return rest | {"goal": rotation}
    return rest | {
        "coupling": torch.zeros_like(target[..., :6]),
        "goal_position": target[..., POSITION].clone(),
        "goal_orientation": rotation,
        "goal_body": target[..., BODY].clone(),
    }


def _goals(inputs: Tensors) -> dict[str, Any]:
    """Goals among the inputs of a program, as arguments of `step`."""
    if "goal" in inputs:
        return {"goal": inputs["goal"]}
    goal = Pose(inputs["goal_position"], inputs["goal_orientation"])
    return {"goal": goal, "goal_body": inputs["goal_body"]}


def _where_new[S: (OrientationState, PoseState)](new: S, old: S) -> S:
    """The new state for motions whose goal has changed, the old state for the others.

    If the orientation is a whole number of turns away from an unchanged goal, the new state
    would lack a part of the velocity.
    """
    difference = quaternion.angle(new.reference, old.reference)
    changed = difference > ROUNDINGS * torch.finfo(difference.dtype).eps
    changed = changed | (new.motion.target != old.motion.target).any(-1)

    def choose(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(changed.reshape(-1, *[1] * (old.ndim - 1)), new, old)

    return tree_map(choose, new, old)


def _program(dmp: MotionPrimitive, goal_filter: float | None) -> ExportedProgram:
    frozen = dmp.with_tensors({name: x.detach() for name, x in dmp.tensors().items()})
    frozen.requires_grad_(False)
    state = state_tensors(frozen.initial_state())
    state = {k: x.repeat(TRACED_BATCH, *[1] * (x.ndim - 1)) for k, x in state.items()}
    inputs = resting_inputs(frozen, state)
    dt = torch.full((TRACED_BATCH,), TRACED_STEP).to(frozen.motion.duration)
    first = {0: Dim("batch", min=1)}
    shapes = dict.fromkeys(state, first), first, dict.fromkeys(inputs, first)
    step = StepModule(frozen, goal_filter)
    return torch.export.export(step, (state, dt, inputs), dynamic_shapes=shapes)
