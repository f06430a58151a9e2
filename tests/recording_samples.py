"""Recordings in the formats of other programs, and their demonstrations."""

import json
from pathlib import Path

import numpy as np
from lerobot_folders import joint_path
from scipy.spatial.transform import Rotation

from hrc_learn.demos.recording_files import Recording, array_field
from hrc_learn.demos.recording_import import plan_import
from hrc_learn.demos.recording_meaning import understand
from hrc_learn.demos.recording_names import ImportOptions

TIME = np.cumsum(np.random.default_rng(0).uniform(0.002, 0.004, 40))
Q = joint_path(40)
TURN = Rotation.from_rotvec(Q)


def plan(*paths, names=(), **options):
    return plan_import(paths, ImportOptions(**options), names)


def read(*paths, names=(), **options):
    return [one.demonstration for one in plan(*paths, names=names, **options).episodes()]


def write_hdf5(path, arrays, attributes=None):
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
        for place, named in (attributes or {}).items():
            for name, value in named.items():
                file[place].attrs[name] = value


def aloha(frames=40):
    q = joint_path(frames, 14)
    images = np.random.default_rng(0).integers(0, 255, (frames, 32, 48, 3), np.uint8)
    return {
        "observations/qpos": q,
        "observations/qvel": np.gradient(q, 0.02, axis=0),
        "observations/images/cam_high": images,
        "action": np.roll(q, -1, axis=0),
    }


def robomimic(path, order=(2, 0, 10)):
    arrays, pose = {}, RigidPath()
    for k in order:
        group = f"data/demo_{k}"
        arrays |= {
            f"{group}/obs/robot0_eef_pos": pose.position + 0.001 * k,
            f"{group}/obs/robot0_eef_quat": pose.turn.as_quat(),
            f"{group}/obs/robot0_joint_pos": joint_path(40, 7),
            f"{group}/obs/robot0_gripper_qpos": np.tile([0.02, -0.02], (40, 1)),
            f"{group}/obs/object": joint_path(40, 10),
            f"{group}/next_obs/robot0_eef_pos": pose.position,
            f"{group}/actions": np.random.default_rng(k).uniform(-1, 1, (40, 7)),
            f"{group}/rewards": np.zeros(40),
        }
    settings = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 20}})
    write_hdf5(path, arrays, {"data": {"env_args": settings}})
    return arrays


class RigidPath:
    position = 0.1 * Q + 0.5
    turn = Rotation.from_rotvec(Q)


def write_video_and_table(path):
    import av

    path.mkdir()
    rows = np.column_stack([np.arange(40) / 20, Q])
    np.savetxt(path / "run.csv", rows, delimiter=",", header="t,j1,j2,j3", comments="")
    with av.open(str(path / "run_front.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for level in range(20):
            image = np.full((48, 64, 3), 12 * level, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


WAVES = np.stack([np.sin(np.arange(200) / 20 * (k + 1)) for k in range(3)], axis=1)


def understood(options=None, hinted=False, names=None, units=None, **arrays):
    """What the import understands of a recording with these arrays."""
    fields = {}
    for name, array in arrays.items():
        name = name.replace("__", "/")
        fields[name] = array_field(
            name,
            np.asarray(array),
            names=(names or {}).get(name),
            unit=(units or {}).get(name, ""),
        )
    one = Recording(file=Path("run.npz"), fields=fields)
    return understand([one], ImportOptions(**(options or {})), hinted)
