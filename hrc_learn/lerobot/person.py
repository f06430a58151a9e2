"""Person that guides the body of a LeRobot robot while actions command its end effector."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from hrc_learn.controller.contact_limits import PersonMode
from hrc_learn.geometry.numerics import check_settings
from hrc_learn.kinematics import Arm, SerialChain
from hrc_learn.protocols import Arm as Driver
from hrc_learn.protocols import Human

if TYPE_CHECKING:
    from hrc_learn.sim import World
    from hrc_learn.teleoperation import ScriptedForce

PersonKind = Literal["none", "scripted", "page", "gamepad", "keyboard"]
"""No person; a script that pulls the elbow at random moments of a simulation; or the input
device of a real person. Gamepad and keyboard guide the elbow here, not the end effector."""


def nullspace_inputs(chain: SerialChain) -> tuple[str, ...]:
    """Names of the person's null-space efforts on the joints [N m]."""
    return tuple(f"{name}.human_torque" for name in chain.joint_names)


def offsets(chain: SerialChain) -> tuple[str, ...]:
    """Names of the joints' displacements from the positions that actions command [rad]."""
    return tuple(f"{name}.pushed_aside" for name in chain.joint_names)


COLUMNS = {"observation.human_effort": nullspace_inputs, "observation.pushed_aside": offsets}
"""Dataset columns for the person's values, with the functions that name the components."""


@dataclass
class PersonConfig:
    """Person that guides the body while actions, of any policy, command the end effector."""

    kind: PersonKind = "none"
    """Input device: "page", "gamepad", "keyboard", "scripted"; "none": no person."""
    after_push: Literal["return", "stay"] = "return"
    """Behaviour after release: the joints return to the positions that the actions command
    ("return"), or keep their offset from these positions ("stay").
    """
    observed: Literal["posture", "joints"] = "posture"
    """Observed joint positions and velocities: those of the policy's own posture, as if there
    were no person ("posture"), or the measured ones ("joints").
    """
    record: bool = False
    """Observe the person's null-space input, and the joint displacement that it causes."""
    host: str = "127.0.0.1"
    """Address of the page. Anyone that can reach this address can move the arm."""
    port: int | None = None
    """Port of the page; None: the first free one from 8080 on."""
    worker: bool = False
    """Simulate a worker at the table, near whom the arm slows down and waits."""
    mode: PersonMode = "ssm"
    """Reaction to the worker: separation monitoring ("ssm"), force limiting ("pfl"), or both
    ("ssm+pfl").
    """

    __post_init__ = check_settings

    def names(self, chain: SerialChain) -> tuple[str, ...]:
        """Names of the observed values of the person's input."""
        if not self.record or self.kind == "none":
            return ()
        return (*nullspace_inputs(chain), *offsets(chain))


def scripted_pulls(seed: int) -> tuple[ScriptedForce, ...]:
    """Pulls of the scripted person, drawn from a seed."""
    from hrc_learn.teleoperation import random_pulls

    # With a separate generator, runs with and without pulls differ in nothing but the pulls.
    return random_pulls(np.random.default_rng([seed, 1]))


class RobotPage:
    """Serves a page that shows a robot; a simulated robot is shown with its surroundings.

    Attributes:
        page: The page, served until `close`.
    """

    def __init__(
        self, arm: Arm, host: str, port: int | None, note: str, *, guides: bool = True
    ):
        """Serve the page.

        Args:
            arm: Arm to show.
            host: Address of the page.
            port: Port of the page; None: the first free one from 8080 on.
            note: Text shown on the page.
            guides: True if the person guides the end effector, too; False: only the body.
        """
        from hrc_learn.sim import World
        from hrc_learn.sim.workplace import Workplace
        from hrc_learn.teleoperation.hand_guiding import InteractionForceConfig
        from hrc_learn.teleoperation.page import Page, PageConfig, PageStatus

        workplace = Workplace.of(arm)
        forces = InteractionForceConfig(level_at=workplace.level_at)
        self._ghost = World(workplace.scene)
        page = Page(self._ghost, PageConfig(host=host, port=port, forces=forces), guides=guides)
        self.page = page.__enter__()
        self.page.show(PageStatus(title="LeRobot", note=note))

    def show(self, driver: Driver, world: World | None) -> None:
        """Show the present posture of the arm.

        Args:
            driver: Driver of the arm; it is read only if there is no world.
            world: Simulated world with everything around the arm; None for a real arm.
        """
        if world is None:
            state = driver.read()
            world = self._ghost
            world.reset(state.joint_position, gripper_width=state.gripper_width)
        self.page.place(world)

    def close(self) -> None:
        """Stop serving the page."""
        self.page.__exit__(None, None, None)


def open_device(config: PersonConfig, arm: Arm) -> tuple[Human, RobotPage | None]:
    """Input device of a person, and its page if the device is a page.

    Args:
        config: Kind of the device, and address of the page.
        arm: The arm whose body is guided.

    Raises:
        ValueError: There is no such device.
    """
    from hrc_learn.teleoperation.devices import Gamepad, TerminalKeyboard
    from hrc_learn.teleoperation.hand_guiding import LinkGuide
    from hrc_learn.teleoperation.scripted_expert import ScriptedPerturbation

    chain = arm.chain
    match config.kind:
        case "page":
            note = "A policy commands the end effector. Pull a link or a knob."
            page = RobotPage(arm, config.host, config.port, note, guides=False)
            return page.page.human, page
        case "gamepad":
            return LinkGuide(Gamepad.open(chain), chain), None
        case "keyboard":
            return LinkGuide(TerminalKeyboard.open(chain), chain), None
        case "scripted":
            return ScriptedPerturbation(chain, ()), None
    kinds = ", ".join(get_args(PersonKind))
    raise ValueError(f"person.kind must be one of {kinds}, but is {config.kind!r}.")


def scripted_person(chain: SerialChain, seed: int) -> Human:
    """Scripted person that pulls the elbow as drawn from a seed."""
    from hrc_learn.teleoperation.scripted_expert import ScriptedPerturbation

    return ScriptedPerturbation(chain, scripted_pulls(seed))
