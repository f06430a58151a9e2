"""Jobs to be learned in the simulated workplace: how they begin, are shown, and are done.

Success is read from MuJoCo's contacts and poses, whoever did the job.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from ..human import GuidedPath, ScriptedExpert, Tremor, gripper_down
from ..kinematics import panda
from ..protocols import ArmState, Human, HumanInput
from ..sim import World
from .teach_placing import PlacingLesson, placing_expert
from .workplace import Workplace, nearest_configuration

OPEN, CLOSED = 0.08, 0.0
"""Openings that the gripper is sent to [m]; closed, it squeezes what is between the fingers."""


class Scenario(ABC):
    """A job, the same for the person who shows it and the policy that has learned it."""

    workplace: Workplace

    @property
    @abstractmethod
    def task(self) -> str:
        """What is to be done, in words."""

    @property
    @abstractmethod
    def duration(self) -> float:
        """Of a demonstration [s]."""

    @abstractmethod
    def begin(self, world: World, rng: np.random.Generator) -> Human:
        """Put everything in place, and return who can show the job from there.

        Args:
            world: Of the workplace; its clock begins at zero.
            rng: Source of where things are, and of the person's unsteadiness.
        """

    @abstractmethod
    def succeeded(self, world: World) -> bool:
        """Whether the job is done."""


@dataclass(frozen=True, kw_only=True)
class Placing(Scenario):
    """Put the thing in the hand on a shelf, and let go."""

    workplace: Workplace = field(default_factory=Workplace)
    shelf: str = "middle"
    lesson: PlacingLesson = field(default_factory=PlacingLesson)
    release: float = 1.5
    """Time for the fingers to open [s]."""

    @property
    def task(self) -> str:
        return f"place the box on the {self.shelf} shelf"

    @property
    def duration(self) -> float:
        return self._let_go + self.release

    @property
    def _let_go(self) -> float:
        return self.lesson.duration + self.lesson.settle

    def begin(self, world: World, rng: np.random.Generator) -> Human:
        expert = placing_expert(self.workplace, self.shelf, self.lesson, rng)
        offset = torch.from_numpy(expert.path.position(0.0)) - self.workplace.home().position
        joints = self.workplace.home_joints(offset).numpy()
        world.hold(self.workplace.scene.objects[0].name, joints)
        return InTurn([(0.0, expert, CLOSED), (self._let_go, expert, OPEN)])

    def succeeded(self, world: World) -> bool:
        return world.rests_on(self.workplace.scene.objects[0].name, f"board_{self.shelf}")


@dataclass(frozen=True, kw_only=True)
class Grasping(Scenario):
    """Take a thing that lies at random on the table, and lift it."""

    workplace: Workplace = field(default_factory=Workplace)
    reach: tuple[float, float, float] = (0.10, 0.08, 0.0)
    """How far from the middle of the table it lies [m]."""
    approach: float = 4.0
    """From above the middle of the table down to the thing [s]."""
    grip: float = 0.7
    """Time for the fingers to close [s]."""
    lift: float = 2.0
    """Time to lift it [s]."""
    height: float = 0.15
    """How far it is lifted [m]."""
    settle: float = 0.5
    """Rest at the end [s]."""
    tremor: float = 2e-4
    """Amplitude of the hand's tremor [m]."""

    @property
    def task(self) -> str:
        return "grasp the box and lift it"

    @property
    def duration(self) -> float:
        return self.approach + self.grip + self.lift + self.settle

    def begin(self, world: World, rng: np.random.Generator) -> Human:
        item = self.workplace.scene.objects[0]
        pose = self.workplace.random_object_pose(self.reach, rng)
        hover = self.workplace.hover()
        joints = nearest_configuration(hover, near=self.workplace.hover_joints())
        world.reset(joints.numpy(), {item.name: pose})
        grasp = pose[:3, 3]
        above, lifted = (grasp + np.array([0.0, 0.0, h]) for h in (0.08, self.height))
        closing = self.approach + self.grip
        down = self._lead([hover.position.numpy(), above, grasp], self.approach, 0.0, rng)
        up = self._lead([grasp, lifted], self.lift, closing, rng)
        return InTurn([(0.0, down, OPEN), (self.approach, down, CLOSED), (closing, up, CLOSED)])

    def _lead(
        self, points: list[np.ndarray], duration: float, start: float, rng: np.random.Generator
    ) -> ScriptedExpert:
        return ScriptedExpert(
            panda,
            GuidedPath(np.vstack(points), duration, start),
            tremor=Tremor(self.tremor, rng),
            orientation=lambda _position, _time: gripper_down(),
        )

    def succeeded(self, world: World) -> bool:
        item = self.workplace.scene.objects[0]
        bottom = world.object_pose(item.name)[2, 3] - max(item.half_size)
        return world.holds(item.name) and bool(bottom > 0.5 * self.height)


class InTurn:
    """People who lead the arm one after the other, each with the gripper's opening."""

    def __init__(self, turns: list[tuple[float, Human, float]]):
        """Fix the turns.

        Args:
            turns: When each begins [s], who leads, and how far the gripper opens [m].
        """
        self._turns = turns

    def read(self, state: ArmState) -> HumanInput:
        """What the one asks for whose turn it is."""
        begun = [turn for turn in self._turns if turn[0] <= state.time]
        _, human, width = begun[-1] if begun else self._turns[0]
        return replace(human.read(state), gripper=width)
