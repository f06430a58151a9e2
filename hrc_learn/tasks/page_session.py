"""A person at the page leads the simulated arm and records demonstrations."""

from dataclasses import dataclass, field

import numpy as np
import torch

from ..controller import INTERVENTIONS
from ..human import BothHands, Eased, EasingConfig
from ..human.page import Page, PageStatus
from ..kinematics import panda
from ..protocols import Human, HumanInput, Request
from ..sim import MovingBodies, World
from .demonstration_recorder import DemonstrationRecorder
from .landing import way_left
from .led_arm import Frame, Instant, LedArm, LedArmConfig
from .workplace import Workplace

FEATURES = {
    "observation.human_twist": ("vx", "vy", "vz", "wx", "wy", "wz"),
    "observation.region": ("x", "y", "z", "half_x", "half_y", "half_z"),
}
"""Recorded beside the usual columns: motion of the hand that the person asked for, and the
region in force (zeros where there is none)."""


@dataclass(frozen=True, kw_only=True)
class PageSessionConfig:
    """How a session runs."""

    led: LedArmConfig = field(default_factory=LedArmConfig)
    """How the arm follows."""
    easing: EasingConfig = field(default_factory=EasingConfig)
    """How fast the motion of a hand that is led may change."""
    record_every: int = 2
    """Control steps from one recorded frame to the next."""
    show_every: int = 10
    """Control steps from one status shown on the page to the next."""

    def __post_init__(self) -> None:
        if self.record_every < 1 or self.show_every < 1:
            raise ValueError("record_every and show_every must be at least 1.")

    @property
    def fps(self) -> float:
        """Recorded frames a second."""
        return 1.0 / (self.led.dt * self.record_every)


class PageSession:
    """Steps the simulated arm as the person at the page asks.

    Attributes:
        world: That the arm is in.
        finished: Whether the person is done.
        led: The arm as it is led.
    """

    def __init__(
        self,
        workplace: Workplace,
        page: Page,
        recorder: DemonstrationRecorder,
        world: World,
        *,
        beside: tuple[Human, ...] = (),
        config: PageSessionConfig | None = None,
    ):
        """Put a thing into the hand, at home.

        Args:
            workplace: Where.
            page: Shows what happens, and hands on what the person asks for.
            recorder: Of demonstrations.
            world: Of the workplace.
            beside: Other sources of the person's input, such as a gamepad.
            config: How the session runs.
        """
        self.world, self.finished = world, False
        self._workplace, self._page, self._recorder = workplace, page, recorder
        self._config = config or PageSessionConfig()
        self._bodies = MovingBodies(world)
        self._home = workplace.home_joints().numpy()
        self._go_home()
        human = Eased(BothHands(page.human, *beside), self._config.easing)
        self.led = LedArm(panda, world.arm, human, self._config.led)
        self._ticks, self._width = 0, None

    def step(self) -> Instant:
        """One control step of the arm, and of the world."""
        with torch.inference_mode():
            instant = self.led.step()
        if self._ticks % self._config.record_every == 0:
            self._recorder.add(recorded(instant))
        self._grip(instant.asked)
        self.world.advance(self._config.led.dt)
        self._page.place(*self._bodies.poses())
        for request in instant.asked.requests:
            self._handle(request)
        if self._ticks % self._config.show_every == 0:
            self._page.show(self._status(instant))
        self._ticks += 1
        return instant

    def _handle(self, request: Request) -> None:
        if request == "finish":
            self.finished = True
        elif request == "home":
            # A jump of the arm has no place in a demonstration.
            if self._recorder.status.state == "recording":
                self._recorder.handle("stop")
            self._go_home()
            self.led.restart()
        else:
            self._recorder.handle(request)

    def _go_home(self) -> None:
        self.world.hold(self._workplace.scene.objects[0].name, self._home)

    def _grip(self, asked: HumanInput) -> None:
        if asked.gripper is not None and asked.gripper != self._width:
            self._width = asked.gripper
            self.world.arm.move(asked.gripper)

    def _status(self, instant: Instant) -> PageStatus:
        status, world = self._recorder.status, self.world
        notes = [status.note]
        if status.state != "ready":
            notes.insert(0, way_left(self._workplace, instant.pose.position.numpy()))
        monitors = (world.cabinet_contacts, world.table_contacts, world.self_contacts)
        counts = self.led.safety.counts.tolist()
        return PageStatus(
            title="Simulated Panda",
            recording=status.state,
            seconds=status.seconds,
            saved=status.saved,
            note="; ".join(filter(None, notes)),
            interventions=dict(zip(INTERVENTIONS, counts, strict=True)),
            contacts=sum(len(monitor.touches) for monitor in monitors),
        )


def recorded(instant: Instant) -> Frame:
    """Columns of an instant, with all that the person asked for."""
    asked, box = instant.asked, np.zeros(6)
    if asked.region is not None:
        box = np.array([*asked.region.centre, *asked.region.half_size])
    return {
        **instant.frame(),
        "observation.human_twist": asked.twist,
        "observation.region": box,
    }
