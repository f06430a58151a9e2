"""Run sessions at the page: record demonstrations, or watch a job and pull the arm's body."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from hrc_learn.controller import INTERVENTIONS
from hrc_learn.demos.issues import counted
from hrc_learn.deploy import Rate
from hrc_learn.geometry import Box
from hrc_learn.geometry.numerics import check_positive
from hrc_learn.protocols import DrawnRegion, Human, OpenedArm, Request
from hrc_learn.sim import World
from hrc_learn.sim.workplace import Workplace
from hrc_learn.skills.arm_motion import joint_line
from hrc_learn.skills.grasping import INTERACT
from hrc_learn.skills.work_cell import WorkCell
from hrc_learn.teleoperation.demonstration_recorder import DemonstrationRecorder, pressed
from hrc_learn.teleoperation.gate.messages import TrackedHand
from hrc_learn.teleoperation.hand_guiding import (
    CombinedInput,
    Frame,
    GuidedStep,
    HandGuidedArm,
    HandGuidingConfig,
    InputFilter,
    InputFilterConfig,
)
from hrc_learn.teleoperation.page import Page, PageConfig, PageStatus
from hrc_learn.viz.palette import GREEN, rgba

# Half thickness of the fields drawn on the boards [m]: thick enough that a field and its board
# do not flicker.
_THICKNESS = 0.002
# Control steps between two statuses on the page: ten times a second at 10 ms.
_SHOW_EVERY = 10
# Spacing of the postures at which a path is checked for contacts [rad]: 5 cm at 1 m reach.
_LOOK = 0.05
# A recording continues for this long without a client [s]: reloading a page takes less.
_LEFT_FOR = 5.0
# Points of a drawn path, enough to look smooth.
_WAY_POINTS = 24
# Time for which a remark of the task is shown [s]: two lines can be read in half of this time.
_REMARK_STAYS = 6.0
_INVITATION = "Pull at a link or a knob: the end effector keeps servoing."

_HAND = ("x", "y", "z", "qw", "qx", "qy", "qz")

FEATURES = {
    "observation.human_twist": ("vx", "vy", "vz", "wx", "wy", "wz"),
    "observation.region": ("x", "y", "z", "half_x", "half_y", "half_z"),
    "observation.left_hand": _HAND,
    "observation.right_hand": _HAND,
}
"""Additional recorded columns: end-effector motion requested by the person, the active region
(zeros if there is none), and the pose of each hand in the base frame (zeros while no headset
sees it).
"""


def place_targets(workplace: Workplace) -> list[Box]:
    """A green field on each board, at the place for the object."""
    item, (red, green, blue, _) = workplace.scene.objects[0], rgba(GREEN)
    # Grasped from above, an object lies on its side once the end effector is level.
    x, y = item.half_size[0], item.half_size[2]
    fields = []
    for name in workplace.shelf_names():
        place = workplace.shelf(name).position.tolist()
        height = workplace.scene.cabinet.shelves[name] + _THICKNESS
        fields.append(
            Box(
                name=f"place_{name}",
                centre=(place[0], place[1], height),
                half_size=(x, y, _THICKNESS),
                colour=(red / 255, green / 255, blue / 255, 1.0),
            )
        )
    return fields


def place_target_hint(workplace: Workplace, position: Float[np.ndarray, "3"]) -> str:
    """Distance from the end effector to the place target of the nearest shelf, as text.

    Args:
        workplace: Workplace with the shelves.
        position: Position of the tool centre point [m].
    """
    names = workplace.shelf_names()
    offsets = {name: workplace.shelf(name).position.numpy() - position for name in names}
    nearest = min(names, key=lambda name: float(np.linalg.norm(offsets[name])))
    directions = (("away", "back"), ("left", "right"), ("up", "down"))
    steps = [
        f"{abs(distance):.0f} cm {forward if distance > 0 else backward}"
        for distance, (forward, backward) in zip(
            100 * offsets[nearest], directions, strict=True
        )
        if abs(distance) >= 1  # closer than a centimetre is close enough
    ]
    return f"{nearest} shelf: {', '.join(steps) or 'there'}"


@dataclass(frozen=True, kw_only=True)
class PageSessionConfig:
    """Settings of a recording session."""

    guiding: HandGuidingConfig = field(default_factory=HandGuidingConfig)
    """Gains and limits of the guided arm."""
    input_filter: InputFilterConfig = field(default_factory=InputFilterConfig)
    """Bounds on the acceleration of the end effector."""
    record_every: int = 2
    """Number of control steps from one recorded frame to the next."""

    __post_init__ = check_positive

    @property
    def fps(self) -> float:
        """Recorded frames per second."""
        return 1.0 / (self.guiding.dt * self.record_every)


class PageSession:
    """Steps the arm as the person at the page requests, and records demonstrations.

    Attributes:
        world: World of the arm.
        finished: True once the person has finished.
        arm: The hand-guided arm.
    """

    def __init__(
        self,
        workplace: Workplace,
        page: Page,
        recorder: DemonstrationRecorder,
        world: World,
        *,
        opened: OpenedArm | None = None,
        inputs: tuple[Human, ...] = (),
        config: PageSessionConfig | None = None,
    ):
        """Start at the present posture of the arm.

        Args:
            workplace: Workplace of the session.
            page: Page that shows the session and reads the person's input.
            recorder: Recorder of demonstrations.
            world: World of the workplace, in which the arm moves.
            opened: Driver of the arm; None: the simulated arm, with an object in its gripper,
                at home.
            inputs: Further sources of the person's input, such as a gamepad.
            config: Settings of the session.
        """
        self.world, self.finished = world, False
        self._workplace, self._page, self._recorder = workplace, page, recorder
        self._config = config or PageSessionConfig()
        self._home = workplace.home_joints().numpy()
        self._jumps, self._remark = opened is None, ""
        self._opened = opened or world.opened_arm
        if self._jumps:
            world.hold(workplace.scene.objects[0].name, self._home)
        human = InputFilter(CombinedInput(page.human, *inputs), self._config.input_filter)
        chain = world.arm.robot.chain
        self.arm = HandGuidedArm(chain, self._opened.arm, human, self._config.guiding)
        page.farewell = (
            "The program was ended. A demonstration that was open is kept. "
            "You can close this tab."
        )
        self._ticks, self._width = 0, None
        self._watched, self._alone = False, 0
        self._looked = world.time

    def step(self) -> GuidedStep:
        """One control step of the arm, and of the world."""
        with torch.inference_mode():
            step = self.arm.step()
        if self._ticks % self._config.record_every == 0:
            frame = recorded_frame(step, self._page.hands)
            self._recorder.add(frame, self._met(step))
        width = step.human_input.gripper
        if width is not None and width != self._width:
            self._width = width
            self._opened.gripper.move(width)
        self._opened.advance(self._config.guiding.dt)
        self._page.place()
        self._stop_when_left()
        for request in step.human_input.requests:
            self._remark = ""
            self._handle(request)
        if self._ticks % _SHOW_EVERY == 0:
            self._page.show(self._status(step))
        self._ticks += 1
        return step

    def _handle(self, request: Request) -> None:
        if request == "finish":
            self.finished = True
            self.arm.stop()
            self._recorder.finish()
            saved = self._recorder.status.saved
            self._page.farewell = (
                f"Finished: {counted(saved, 'demonstration')} saved. You can close this tab."
            )
        elif request == "home":
            # A demonstration must not contain the motion home.
            if self._recorder.state == "recording":
                self._recorder.handle("stop")
            self._go_home()
        else:
            self._recorder.handle(request)

    def _met(self, step: GuidedStep) -> tuple[str, ...]:
        """Unwanted contacts of the arm since the last frame, as text."""
        last, self._looked = self._looked, self.world.time
        if self._recorder.state != "recording":
            return ()
        felt = pressed(self.world.arm.robot.chain, step.state)
        return (*self.world.touched_since(last), *felt)

    def _stop_when_left(self) -> None:
        """Stop a recording after all clients have left the page, and keep the demonstration."""
        if self._recorder.state != "recording":
            self._watched, self._alone = False, 0
        elif self._page.control.people:
            self._watched, self._alone = True, 0
        elif self._watched:  # a page was open: not a recording with a gamepad only
            self._alone += 1
            if self._alone * self._config.guiding.dt > _LEFT_FOR:
                self._recorder.handle("stop")
                self._remark = (
                    f"the recording was stopped: no browser was open for {_LEFT_FOR:.0f} s"
                )

    def _go_home(self) -> None:
        """Bring the arm home. Without a driver, the arm jumps; with a driver, it moves on a
        straight line in joint space, unless that would cause a collision.
        """
        if self._jumps:
            self.world.hold(self._workplace.scene.objects[0].name, self._home)
            self.arm.restart()
            self._width = None  # the gripper is closed again
            return
        now, home = torch.from_numpy(self._opened.arm.read().joint_position), self._home
        way = joint_line(now, torch.from_numpy(home), speed=1.0, dt=_LOOK).numpy()
        touches = self.world.collisions_along(way)
        if touches:
            met = f"{touches[0].first} would meet {touches[0].second}"
            self._remark = f"on the straight way home, {met}: guide the arm out first"
        else:
            self.arm.move_to(torch.from_numpy(home))

    def _status(self, step: GuidedStep) -> PageStatus:
        status, world = self._recorder.status, self.world
        place = step.pose.position.numpy()
        hint = "" if status.state == "ready" else place_target_hint(self._workplace, place)
        notes = (hint, status.note, self._remark)
        monitors = (world.cabinet_contacts, world.table_contacts, world.self_contacts)
        counts = self.arm.safety.counts.tolist()
        return PageStatus(
            title=self._workplace.robot.name.capitalize() + " (simulated)" * self._jumps,
            **{**vars(status), "note": "; ".join(filter(None, notes))},
            interventions=dict(zip(INTERVENTIONS, counts, strict=True)),
            contacts=sum(len(monitor.touches) for monitor in monitors),
        )


def recorded_frame(step: GuidedStep, hands: Mapping[str, TrackedHand]) -> Frame:
    """Columns of a step, including the input of the person.

    Args:
        step: Step of the guided arm.
        hands: Tracked hands, by "left" and "right".
    """
    asked, box = step.human_input, np.zeros(6)
    if asked.region is not None:
        box = np.array([*asked.region.centre, *asked.region.half_size])
    frame = {**step.frame(), "observation.human_twist": asked.twist, "observation.region": box}
    for name in ("left", "right"):
        seen = hands.get(name)
        pose = np.zeros(7) if seen is None else np.array([*seen.position, *seen.orientation])
        frame[f"observation.{name}_hand"] = pose
    return frame


class TaskPage(Page):
    """Page for a task that runs autonomously: people watch it and pull the arm.

    Attributes:
        cell: Work cell of the task, whose log is shown; None: it has not begun.
    """

    def __init__(
        self, world: World, dt: float, config: PageConfig, title: str = "Pick and place"
    ):
        """Serve the page.

        Args:
            world: World to show, which the task moves.
            dt: Control step of the task [s].
            config: Settings of the page.
            title: Title of the task.
        """
        super().__init__(world, config, guides=False, draws=True)
        self._title, self._rate, self._ticks = title, Rate(dt), 0
        self.cell: WorkCell | None = None

    def tick(self) -> None:
        """Update the page after a control step, and wait until the next one is due."""
        self.place()
        if self._ticks % _SHOW_EVERY == 0 and self.cell is not None:
            self.show(self.status(self.cell))
        self._ticks += 1
        self._rate.wait()

    def status(self, cell: WorkCell) -> PageStatus:
        """Page status of a task that runs on a work cell."""
        world, log = self._world, cell.log
        phase = log.events[-1].text if log.events else "getting ready"
        note = _INVITATION if phase == INTERACT else ""
        if cell.remarks and cell.time - cell.remarks[-1].time < _REMARK_STAYS:
            note = cell.remarks[-1].text
        acted = log["safety"].sum(axis=0) if len(log) else [0] * len(INTERVENTIONS)
        return PageStatus(
            title=self._title,
            doing=phase,
            seconds=cell.time,
            note=note,
            region=_followed(cell),
            plan=_way(cell),
            interventions=dict(zip(INTERVENTIONS, map(int, acted), strict=True)),
            contacts=len(world.cabinet_contacts.touches) + len(world.table_contacts.touches),
        )


def _way(cell: WorkCell) -> Float[np.ndarray, "points 3"] | None:
    """Positions of the end effector along the path being followed [m]; None: no path."""
    if cell.plan is None:
        return None
    some = np.linspace(0, len(cell.plan) - 1, min(len(cell.plan), _WAY_POINTS)).astype(int)
    return cell.chain.forward(torch.from_numpy(cell.plan[some])).position.numpy()


def _followed(cell: WorkCell) -> DrawnRegion | None:
    """Region into which the controller moved the end effector in the last step, if any."""
    if cell.region is None:
        return None
    (x, y, z), (a, b, c) = cell.region.centre.tolist(), cell.region.half_size.tolist()
    return DrawnRegion(centre=(x, y, z), half_size=(a, b, c))
