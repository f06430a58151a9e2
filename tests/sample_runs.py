"""A small made-up run with every field filled, for the tests of `hrc_learn.viz`."""

from dataclasses import fields

import numpy as np

from hrc_learn.geometry import Body, Box, Capsule
from hrc_learn.log import CameraRecording, Event, JointRanges, RunRecording
from hrc_learn.vision import CameraModel

STEPS = 200
OPTIONAL = (
    "camera",
    "demo_joint_position",
    "demo_path",
    "elbow_motion",
    "followed",
    "nullspace_input",
    "image_jacobian",
    "joint_limits",
    "joint_velocity",
    "plan_path",
    "position_deviation",
    "push",
    "region",
    "rotation_deviation",
    "true_image_jacobian",
    "weight_norm",
    "worker_nearest",
)
"""Fields of a run that may be None."""
NAMES = tuple(f"joint{i}" for i in range(1, 8))
LIMITS = JointRanges(lower=np.full(7, -2.9), upper=np.full(7, 2.9), velocity=np.full(7, 2.0))


def camera_recording(time: np.ndarray, images: int = 3) -> CameraRecording:
    """A feature that comes near its target, unseen for a while, with a few small images."""
    model = CameraModel(width=160, height=120, focal=(150.0, 150.0), principal=(79.5, 59.5))
    feature = 80.0 + 40.0 * np.exp(-time)[:, None] * [1.0, -0.5]
    feature[50:60] = np.nan
    target = np.full_like(feature, 80.0)
    target[:20] = np.nan
    grey = tuple(np.full((120, 160, 3), 60 * (i + 1), dtype=np.uint8) for i in range(images))
    return CameraRecording(
        model=model.look_at(np.array([0.4, 0.0, 1.2]), np.array([0.4, 0.0, 0.0])),
        feature=feature,
        target=target,
        image_time=np.linspace(0.0, time[-1], images),
        images=grey,
    )


def sample_run(**changes) -> RunRecording:
    """Four seconds at 50 Hz. `changes` replace fields; None or empty leaves one out."""
    time = np.arange(STEPS) / 50
    rng = np.random.default_rng(0)
    position = np.stack([0.4 + 0.1 * np.sin(time), 0.1 * time, 0.3 + 0 * time], axis=-1)
    effort = np.zeros((STEPS, 7))
    effort[80:120, 3] = 1.0
    push = np.full((STEPS, 2, 3), np.nan)
    push[80:120] = [[0.4, 0.1, 0.5], [0.4, 0.5, 0.5]]
    upright = np.tile([np.cos(0.3), 0.0, 0.0, np.sin(0.3)], (STEPS, 1))
    body = Body(
        name="hand",
        position=position,
        orientation=upright,
        capsules=(Capsule(start=(0.0, 0.0, -0.1), end=(0.0, 0.0, 0.0), radius=0.03),),
        boxes=(Box(centre=(0.0, 0.0, 0.05), half_size=(0.02, 0.05, 0.05)),),
    )
    values = {
        "title": "Grasp",
        "time": time,
        "joint_names": NAMES,
        "joint_position": np.sin(time[:, None] + np.arange(7)),
        "joint_velocity": np.cos(time[:, None] + np.arange(7)),
        "joint_limits": LIMITS,
        "demo_joint_position": np.sin(time[:, None] + np.arange(7)) + 0.01,
        "position": position,
        "demo_path": position + 0.01,
        "plan_path": position + 0.02,
        "bodies": (body,),
        "boxes": (Box(centre=(0.4, 0.1, -0.1), half_size=(0.5, 0.5, 0.1), name="table"),),
        "region": Box(centre=(0.4, 0.1, 0.3), half_size=(0.1, 0.1, 0.1), name="region"),
        "camera": camera_recording(time),
        "image_jacobian": 1000.0 + rng.normal(size=(STEPS, 2, 6)),
        "true_image_jacobian": np.full((STEPS, 2, 6), 1000.0),
        "weight_norm": 5.0 + time,
        "potentials": {"vision": np.exp(-time), "Cartesian box": 2 * np.exp(-time)},
        "nullspace_input": effort,
        "push": push,
        "followed": np.where(time > 2.0, 0.4, np.nan),
        "hindered": {"joint_limit": time > 3.0, "person": time > 4.0},
        "elbow_motion": 0.1 * effort[:, 3],
        "position_deviation": 1e-4 * effort[:, 3],
        "rotation_deviation": np.radians(0.01) * effort[:, 3],
        "worker_distance": {"true": 0.2 + 0.1 * time, "seen": 0.25 + 0.1 * time},
        "worker_nearest": np.stack([position, position + 0.2], axis=1),
        "safety": {"velocity limit": time > 3.0},
        "phases": (Event(0.0, "Approach"), Event(1.0, "Servo")),
    }
    return RunRecording(**(values | changes))


def until(run: RunRecording, steps: int) -> RunRecording:
    """The first steps of a run, as it was recorded while it still went on."""
    now = run.time[steps - 1]
    changes = _cut(run, steps) | {"demo_path": run.demo_path, "plan_path": run.plan_path}
    for name in ("potentials", "safety", "worker_distance", "hindered"):
        changes[name] = {key: values[:steps] for key, values in changes[name].items()}
    changes["bodies"] = tuple(Body(**_cut(body, steps)) for body in run.bodies)
    changes["phases"] = tuple(phase for phase in run.phases if phase.time <= now)
    if run.camera is not None:
        taken = int((run.camera.image_time <= now).sum())
        images = {
            "images": run.camera.images[:taken],
            "image_time": run.camera.image_time[:taken],
        }
        changes["camera"] = CameraRecording(**_cut(run.camera, steps) | images)
    return RunRecording(**changes)


def _cut(recorded, steps: int) -> dict:
    """Fields with as many rows as the run has steps, cut."""
    values = {field.name: getattr(recorded, field.name) for field in fields(recorded)}
    return {
        name: value[:steps] if isinstance(value, np.ndarray) and len(value) == STEPS else value
        for name, value in values.items()
    }
