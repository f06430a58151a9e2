"""Primitives for other programs: a NumPy stepper, and the step as a `torch.export` program.

The program is of a batch of any size and takes dictionaries of tensors, so that a loop runs it
without this package:

    program = torch.export.load("place/step.pt2").module()
    state = program(state, dt, inputs)

They hold a state's tensors by the names of its fields.
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
from hrc_learn.dmp._closed_loop_step import DMPState
from hrc_learn.dmp.dual_arm_dmp import DualArmDMP, DualArmState
from hrc_learn.dmp.limited_dmp import LimitedDMP
from hrc_learn.dmp.motion_primitive import AdaptedPrimitive, export_primitive
from hrc_learn.dmp.numpy_stepper import STEPPERS, AnyStepper, freeze_stepper
from hrc_learn.dmp.orientation_dmp import OrientationState
from hrc_learn.dmp.orientation_error import to_orientation
from hrc_learn.dmp.pose_dmp import BODY, POSITION, PoseDMP, PoseState
from hrc_learn.geometry import Pose, quaternion
from hrc_learn.model_files import saved_kind

PRIMITIVE, PROGRAM = "primitive", "step.pt2"
STATE = tuple(field.name for field in fields(DMPState))
HANDS = "arms", "planned"
FRAMES = "reference", "goal_velocity"
"""What states call the frame of their columns."""
TRACED_BATCH = 3
"""Any but 0 and 1, which a tracer would take for constants."""
SAME = 8
"""Angles of fewer roundings than this are none: a product of quaternions takes seven."""
TRACED_STEP = 1e-3
"""Step [s] that a program is traced with; any other will do as well when it runs."""

type Tensors = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True, eq=False)
class ExportedDMP:
    """A primitive ready to leave Python's training side."""

    dmp: AdaptedPrimitive
    stepper: AnyStepper | None
    """One motion in NumPy, float64; None for what has none (limits, moving goals, two arms) and
    for what is integrated (`formulation="ude"`)."""
    program: ExportedProgram
    """(state, dt, inputs) -> state, dictionaries of tensors (B, ...), dt (B,) [s].

    A state is what `state_tensors` makes of one. Inputs are `phase_stopping`, `coupling` and
    `goal`; for a pose instead of that `goal_position`, `goal_orientation` and `goal_body`, and
    its coupling is (B, 6); for two arms the object's `goal_position` and `goal_orientation`
    and a coupling (B, 2, 6). All are needed, and `resting_inputs` change nothing.
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


def export_dmp(dmp: AdaptedPrimitive, *, goal_filter: float | None = None) -> ExportedDMP:
    """Freeze one primitive.

    Args:
        dmp: Not a batch.
        goal_filter: Of the program, as in `step`; the stepper's goals are there at once.

    Raises:
        ValueError: The primitive is a batch.
    """
    kind: Any = dmp
    if kind.duration.ndim:
        raise ValueError(
            f"export takes one primitive, got a batch {tuple(kind.duration.shape)}"
        )
    return ExportedDMP(dmp=dmp, stepper=freeze_stepper(dmp), program=_program(dmp, goal_filter))


# Where `AdaptedPrimitive.export` finds it: nothing below this module has to know of it.
export_primitive.register(AdaptedPrimitive, export_dmp)


def load_stepper(folder: str | Path) -> AnyStepper:
    """The NumPy stepper of what `ExportedDMP.save` wrote, or of a saved primitive.

    Raises:
        FileNotFoundError: No export there.
        ValueError: Names the file and the field that is wrong.
    """
    folder = Path(folder)
    store.settle(folder)
    folder = folder / PRIMITIVE if (folder / PRIMITIVE).is_dir() else folder
    kinds = {kind.__name__: kind for kind in STEPPERS}
    kind = saved_kind(folder)
    if kind not in kinds:
        raise ValueError(f"{folder}: steps {', '.join(kinds)}, got {kind!r}")
    stepper = freeze_stepper(kinds[kind].load(folder))
    if stepper is None:
        raise ValueError(f"{folder}: its formulation has no stepper, run the program instead")
    return stepper


class StepModule(nn.Module):
    """The step of a primitive between dictionaries of tensors."""

    def __init__(self, dmp: AdaptedPrimitive, goal_filter: float | None):
        super().__init__()
        self.dmp = dmp
        self.goal_filter = goal_filter

    def forward(self, state: Tensors, dt: Tensor, inputs: Tensors) -> Tensors:
        before, goals = given_state(self.dmp, state), given_goals(self.dmp, inputs)
        options = {name: inputs[name] for name in ("phase_stopping", "coupling")}
        if self.dmp.adapter.error_columns is not None:
            goal = goals.pop("goal")
            before = _where_new(self.dmp.retarget(before, goal), before)
        after = self.dmp.step(before, dt, goal_filter=self.goal_filter, **goals, **options)
        # Copies: a program must not hand back what it was given.
        return {name: x.clone() for name, x in _named(after).items()}


def state_tensors(state: Any) -> Tensors:
    """A state as the program takes it: (*batch, ...) by name, a batch axis where none was."""
    tensors = _named(state)
    # Two arms are one primitive: their durations are (*batch, 2).
    arms = isinstance(state, DualArmState)
    if tensors["arms.duration" if arms else "duration"].ndim == int(arms):
        tensors = {name: x[None] for name, x in tensors.items()}
    # One tensor in two places would be one input to a tracer.
    return {name: x.detach().clone() for name, x in tensors.items()}


def _named(state: Any) -> Tensors:
    """All of a state that changes along a motion, by name; limits are the primitive's own."""
    tensors: Tensors = {}
    for name, part in vars(state).items():
        match part:
            case Tensor():
                tensors[name] = part
            case DMPState():
                tensors |= _named(part)
            case PoseState():
                tensors |= {f"{name}.{key}": x for key, x in _named(part).items()}
            case Pose():
                tensors |= {f"{name}_position": part.position}
                tensors |= {f"{name}_orientation": part.orientation}
    return tensors


def _part(tensors: Mapping[str, Tensor], name: str) -> Tensors:
    """Those of one state inside of another."""
    prefix = f"{name}."
    return {k.removeprefix(prefix): x for k, x in tensors.items() if k.startswith(prefix)}


def given_state(dmp: Any, tensors: Tensors) -> Any:
    """The state that `state_tensors` made tensors of."""
    if isinstance(dmp, DualArmDMP):
        hands = {name: given_state(dmp.arms, _part(tensors, name)) for name in HANDS}
        held = Pose(tensors["held_position"], tensors["held_orientation"])
        return DualArmState(**hands, held=held)
    columns = DMPState(**{name: tensors[name] for name in STATE})
    frames = [tensors[name] for name in FRAMES if name in tensors]
    return dmp.adapter.state(columns, frames[0] if frames else getattr(dmp, "limits", None))


def resting_inputs(dmp: Any, state: Mapping[str, Tensor]) -> Tensors:
    """Inputs of the program that change nothing: the goal as it is, and no coupling."""
    if isinstance(dmp, DualArmDMP):
        hands = resting_inputs(dmp.arms, _part(state, "planned"))
        # Either hand tells where the object is.
        hand = Pose(hands["goal_position"][..., 0, :], hands["goal_orientation"][..., 0, :])
        goal = hand @ dmp.grasp[..., 0].inverse()
        return {
            "phase_stopping": hands["phase_stopping"][..., 0],
            "coupling": hands["coupling"],
            "goal_position": goal.position,
            "goal_orientation": goal.orientation,
        }
    target, errors = state["target"], dmp.adapter.error_columns
    rest = {
        "phase_stopping": torch.zeros_like(state["pace"]),
        "coupling": torch.zeros_like(target),
    }
    if errors is None:
        limited = isinstance(dmp, LimitedDMP)
        return rest | {"goal": dmp.limits.constrain(target) if limited else target.clone()}
    rotation = to_orientation(dmp.motion.goal.detach()[..., errors], state["reference"])
    if not isinstance(dmp, PoseDMP):
        return rest | {"goal": rotation}
    return rest | {
        "coupling": torch.zeros_like(target[..., :6]),
        "goal_position": target[..., POSITION].clone(),
        "goal_orientation": rotation,
        "goal_body": target[..., BODY].clone(),
    }


def given_goals(dmp: AdaptedPrimitive, inputs: Tensors) -> dict[str, Any]:
    """Goals among the inputs of a program, as arguments of `step`."""
    if "goal" in inputs:
        return {"goal": inputs["goal"]}
    goal = Pose(inputs["goal_position"], inputs["goal_orientation"])
    return {"goal": goal} | {k: inputs[k] for k in ("goal_body",) if k in inputs}


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


def _program(dmp: AdaptedPrimitive, goal_filter: float | None) -> ExportedProgram:
    trained = {name: p.requires_grad for name, p in dmp.named_parameters()}
    dmp.requires_grad_(False)
    try:
        state = state_tensors(dmp.initial_state())
        state = {k: x.repeat(TRACED_BATCH, *[1] * (x.ndim - 1)) for k, x in state.items()}
        inputs = resting_inputs(dmp, state)
        dt = torch.full((TRACED_BATCH,), TRACED_STEP).to(dmp.motion.duration)
        first = {0: Dim("batch", min=1)}
        shapes = dict.fromkeys(state, first), first, dict.fromkeys(inputs, first)
        step = StepModule(dmp, goal_filter)
        return torch.export.export(step, (state, dt, inputs), dynamic_shapes=shapes)
    finally:
        for name, parameter in dmp.named_parameters():
            parameter.requires_grad_(trained[name])
