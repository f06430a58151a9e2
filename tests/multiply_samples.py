"""Demonstrations of a Panda that takes a block from a table, for tests of multiplying them."""

import numpy as np
import torch

from hrc_learn.demos import DatasetWriter, Demonstration
from hrc_learn.geometry import Pose, minimum_jerk, quaternion
from hrc_learn.kinematics import gripper_down, panda
from hrc_learn.kinematics.inverse import follow_poses

FPS, GRASP, END = 20, 40, 64
"""Frames a second; frame at which the gripper closes, and number of frames."""
START = torch.tensor([0.42, 0.0, 0.35], dtype=torch.float64)


def turned(yaw: float) -> torch.Tensor:
    """Orientation of a block turned about the vertical."""
    return quaternion.exp(torch.tensor([0.0, 0.0, yaw], dtype=torch.float64))


def block(x: float, y: float, yaw: float) -> Pose:
    """Pose of a block on the table."""
    return Pose(torch.tensor([x, y, 0.05], dtype=torch.float64), turned(yaw))


BLOCKS = [block(0.45, 0.10, 0.3), block(0.55, -0.10, -0.3), block(0.50, 0.02, 0.0)]


def tool_path(start: torch.Tensor, at: Pose) -> Pose:
    """Motion from a start to above a block, straight down onto it, and up again."""
    down = quaternion.multiply(at.orientation, gripper_down())
    turn = quaternion.log(quaternion.multiply(down, quaternion.conjugate(gripper_down())))
    above = at.position + torch.tensor([0.0, 0.0, 0.08], dtype=torch.float64)
    places, turns = [], []
    for k in range(END):
        there, _ = minimum_jerk(k / 24)
        lower, _ = minimum_jerk((k - 24) / 12)
        up, _ = minimum_jerk((k - 46) / 14)
        places.append(start + there * (above - start) + (lower - up) * (at.position - above))
        turns.append(quaternion.multiply(quaternion.exp(there * turn), gripper_down()))
    return Pose(torch.stack(places), torch.stack(turns))


def demonstrations(blocks: list[Pose] = BLOCKS) -> list[Demonstration]:
    """One demonstration for each place of the block."""
    demos, opened = [], np.where(np.arange(END) < GRASP + 2, 0.08, 0.04)
    for episode, at in enumerate(blocks):
        begin = START + 0.01 * episode
        path = tool_path(begin, at)
        near = panda.inverse(path[0], near=panda.ready)
        q, error = follow_poses(panda, path, near)
        assert float(error[1:].max()) < 1e-3
        demos.append(
            Demonstration(
                time=np.arange(END) / FPS,
                joint_position=q.numpy(),
                gripper=opened,
                command_position=np.concatenate([q[1:].numpy(), q[-1:].numpy()]),
                task="take the block",
                joint_names=panda.joint_names,
                fps=FPS,
                episode=episode,
            )
        )
    return demos


def write_dataset(folder, robot_type: str = "panda", *, gripper: bool = False) -> None:
    """The demonstrations as a dataset, with the pose of the block and a column of its own.

    Args:
        folder: Folder of the dataset.
        robot_type: LeRobot's name of the robot.
        gripper: True if the opening of the gripper is commanded, too.
    """
    names = tuple(f"block.{axis}" for axis in ("x", "y", "z", "wx", "wy", "wz"))
    features = {"observation.block": names, "observation.mood": ("mood",)}
    if gripper:
        features["action.gripper"] = ("gripper.pos",)
    with DatasetWriter(folder, FPS, robot_type, panda.joint_names, features) as writer:
        for demo, at in zip(demonstrations(), BLOCKS, strict=True):
            writer.start_episode(demo.task)
            tool = panda.forward(torch.from_numpy(demo.joint_position))
            held = tool @ tool[GRASP + 2].inverse() @ at
            for k in range(END):
                commanded = {"action.gripper": demo.gripper[[k]]} if gripper else {}
                writer.add_frame(
                    joint_position=demo.joint_position[k],
                    gripper=demo.gripper[k],
                    command_position=demo.command_position[k],
                    **{
                        "observation.block": (at if k < GRASP + 2 else held[k]).vector(),
                        "observation.mood": [k / END],
                    },
                    **commanded,
                )
            writer.save_episode()
