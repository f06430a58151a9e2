"""Make a table of the registered arms: joints, reach, agreement with MuJoCo, servoing, demo.

The table is written between the lines `<!-- arms:begin -->` and `<!-- arms:end -->` of the
given files. The servoing column repeats the scenario `near` of
`benchmarks/controller_sweep.py`: random starts, targets and uncalibrated cameras, simulated
kinematically. The last column comes from `hrc demo --robot NAME --json FOLDER/NAME.json`;
without this file, an arm keeps its old value. Arms whose package is not installed are left out.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import torch
from grasp_trials import TrialConfig, reach_of, run_trials
from rich.console import Console

from hrc_learn import cli
from hrc_learn.jacobian import KalmanEstimator
from hrc_learn.kinematics import (
    Arm,
    ArmChoice,
    MissingModelError,
    UnreachableError,
    arm,
    registered_arms,
    solve_inverse,
)
from hrc_learn.kinematics.capsule_fit import shape_points
from hrc_learn.kinematics.registry import _sources
from hrc_learn.sim.workplace import Workplace

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

_BEGIN, _END = "<!-- arms:begin -->", "<!-- arms:end -->"
_HEADER = (
    "| arm | maker | joints | reach [m] | difference from MuJoCo, Pinocchio "
    "| poses found [%] | self-collision [%]: capsules, MuJoCo, missed "
    "| servoing: done [%]; limit violations, self-contacts "
    "| `hrc demo`: grasp, placement [mm] |\n|---|---|---|---|---|---|---|---|---|"
)
_COLUMNS = _HEADER.splitlines()[0].count("|") - 1


@dataclass(frozen=True, kw_only=True)
class Args:
    states: int = 10_000
    """Number of random joint positions in which pose and Jacobian are compared."""
    postures: int = 500
    """Number of these joint positions in which contacts are compared."""
    poses: int = 1000
    """Number of random reachable poses to invert."""
    arms: tuple[str, ...] = ()
    """Arms to measure; the rows of other arms stay as they are. Default: all arms."""
    trials: int = 0
    """Number of servoing trials; 0 keeps the old value of the servoing column."""
    kinematics: bool = True
    """Measure kinematics; False keeps the old values."""
    demos: Path | None = None
    """Folder with NAME.json of `hrc demo`. For an arm without this file, the demo's check of
    the reach is run."""
    measure: bool = True
    """Measure arms; False renews only the demo column."""
    files: tuple[Path, ...] = ()
    """Files into which the table is written."""
    json: Path | None = None
    """File for the measured values, one flat JSON object of numbers."""


def main(args: Args) -> None:
    """Measure, print the table and write it."""
    torch.set_num_threads(1)
    rows, figures = [_HEADER], {}
    for name in registered_arms():
        if args.arms and name not in args.arms:
            rows += _row_before(name, args)
            continue
        try:
            described = arm(name)
        except MissingModelError:
            continue
        if not args.measure:
            cells = [*_cells_before(name, args)[:-1], _demo(name, args)]
            rows.append(f"| {' | '.join(cells)} |")
            continue
        if not args.kinematics:
            measured = _servoed(name, args.trials) if args.trials else {}
            cells = _cells_before(name, args)[:-2]
            cells += [_servoing(name, measured, args), _demo(name, args)]
            rows.append(f"| {' | '.join(cells)} |")
            Console().print(rows[-1], highlight=False)
            continue
        measured = _measured(described, args)
        figures |= {f"{name}_{key}": value for key, value in measured.items()}
        rows.append(
            f"| {name} | {_sources()[name]['maker']} | {measured['joints']:.0f} "
            f"| {measured['reach_m']:.2f} "
            f"| {_differences(measured)} "
            f"| {100 * measured['inverse_found']:.1f} "
            f"| {_percent(measured, 'capsules_touch', 'hulls_touch', 'missed')} "
            f"| {_servoing(name, measured, args)} | {_demo(name, args)} |"
        )
        Console().print(rows[-1], highlight=False)
    for file in args.files:
        text = file.read_text(encoding="utf-8")
        if _BEGIN not in text or _END not in text:
            raise ValueError(f"{file}: needs the lines {_BEGIN} and {_END}, for the table.")
        before, after = text.split(_BEGIN)[0], text.split(_END)[1]
        file.write_text("\n".join([before + _BEGIN, *rows, _END + after]), encoding="utf-8")
    if args.json is not None:
        cli.write_json(args.json, figures)


def _measured(described: Arm, args: Args) -> dict[str, float]:
    chain = described.chain
    n, rng = len(chain.joint_names), torch.Generator().manual_seed(0)
    lower, upper = chain.limits.lower, chain.limits.upper

    def drawn(count: int) -> torch.Tensor:
        share = torch.rand(count, n, generator=rng, dtype=torch.float64)
        return lower + (upper - lower) * share

    drawn(5000)  # the random numbers that `reach` uses: the following ones differ
    pose = chain.forward(drawn(args.poses))
    begun = time.thread_time()
    found = solve_inverse(chain, pose, task="pose" if n >= 6 else "position+axis").found
    spent = time.thread_time() - begun
    figures = {
        "joints": float(n),
        "reach_m": reach_of(described),
        "inverse_found": float(found.double().mean()),
        "inverse_ms": 1e3 * spent / args.poses,
    }
    if args.trials:
        figures |= _servoed(described.name, args.trials)
    q = drawn(args.states)
    if described.description is not None:
        figures |= _compared(described, q)
    return figures | _self_contacts(described, q[: args.postures])


def _servoed(name: str, trials: int) -> dict[str, float]:
    """Fractions of trials that succeed and that touch, and number of steps beyond limits; empty
    if the arm does not reach the table.
    """
    config = TrialConfig(
        count=trials, robot=ArmChoice(name), duration=8.0, contacts=True, pull="saturated"
    )
    try:
        result = run_trials(KalmanEstimator, config)
    except UnreachableError:
        return {}
    return {
        "servo_done": float((result.success & ~result.touched_itself).double().mean()),
        "servo_violations": float(result.violations.sum()),
        "servo_self_contacts": float(result.touched_itself.sum()),
        "servo_touched": float(result.touched.sum()),
    }


# Poses of base and flange, and the Jacobian of the flange, all in the world.
type Seen = tuple[np.ndarray, np.ndarray, np.ndarray]


def _compared(described: Arm, q: torch.Tensor) -> dict[str, float]:
    """Largest difference of flange positions [m], rotations and Jacobians from those of other
    libraries.
    """
    seen = mujoco_kinematics(described)
    figures = {"difference_from_mujoco": largest_difference(described, q, seen)}
    if find_spec("pinocchio") is not None:
        try:
            see = pinocchio_kinematics(described)
        except IndexError:  # Pinocchio 4.1 raises this for some files that MuJoCo reads
            return figures
        figures["difference_from_pinocchio"] = largest_difference(described, q, see)
    return figures


def largest_difference(
    described: Arm, q: torch.Tensor, see: Callable[[np.ndarray], Seen]
) -> float:
    """Largest difference of flange positions [m], rotations and Jacobians from another library.

    Args:
        described: The arm.
        q: Joint positions (states, joints) [rad, m].
        see: Returns the poses and the Jacobian of that library at one joint position.
    """
    flange = described.with_tool(torch.eye(4, dtype=torch.float64))
    poses, jacobians = flange.forward_and_jacobian(q)
    worst = 0.0
    for row, T, J in zip(q.numpy(), poses.matrix().numpy(), jacobians.numpy(), strict=True):
        base, tip, theirs = see(row)
        R = base[:3, :3]
        turned = np.concatenate([R.T @ theirs[:3], R.T @ theirs[3:]])
        off = T - np.linalg.inv(base) @ tip
        worst = max(worst, float(np.abs(off).max()), float(np.abs(J - turned).max()))
    return worst


def mujoco_kinematics(described: Arm) -> Callable[[np.ndarray], Seen]:
    """Kinematics of an arm as MuJoCo reads them from its file.

    Raises:
        ValueError: MuJoCo does not read the file.
    """
    assert described.description is not None
    model = mujoco_model(described.description)
    data, names = mujoco.MjData(model), described.joint_names
    addresses = [int(model.joint(name).qposadr[0]) for name in names]
    columns = [int(model.joint(name).dofadr[0]) for name in names]
    base = model.body(described.base).id if described.base else 0
    bodies = [model.body(i).name for i in range(model.nbody)]
    at_site = described.tip not in bodies
    tip = (model.site if at_site else model.body)(described.tip).id
    place, turn = (data.site_xpos, data.site_xmat) if at_site else (data.xpos, data.xmat)
    jacobian = mujoco.mj_jacSite if at_site else mujoco.mj_jacBody
    J = np.zeros((6, model.nv))

    def pose(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation.reshape(3, 3), position
        return T

    def see(row: np.ndarray) -> Seen:
        data.qpos[addresses] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jacobian(model, data, J[:3], J[3:], tip)
        standing = pose(data.xpos[base], data.xmat[base])
        return standing, pose(place[tip], turn[tip]), J[:, columns]

    return see


def pinocchio_kinematics(described: Arm) -> Callable[[np.ndarray], Seen]:
    import pinocchio  # pyright: ignore[reportMissingImports]

    assert described.description is not None
    urdf, mjcf = pinocchio.buildModelFromUrdf, pinocchio.buildModelFromMJCF
    read = urdf if described.description.suffix == ".urdf" else mjcf
    model = read(str(described.description))
    data, q = model.createData(), pinocchio.neutral(model)
    joints = [model.joints[model.getJointId(name)] for name in described.joint_names]
    columns = [joint.idx_v for joint in joints]
    body = pinocchio.FrameType.BODY
    base = model.getFrameId(described.base, body) if described.base else 0
    tip = model.getFrameId(described.tip, body)

    def see(row: np.ndarray) -> Seen:
        for joint, angle in zip(joints, row, strict=True):
            # Pinocchio represents a continuous joint by cosine and sine.
            value = [angle] if joint.nq == 1 else [math.cos(angle), math.sin(angle)]
            q[joint.idx_q : joint.idx_q + joint.nq] = value
        pinocchio.computeJointJacobians(model, data, q)
        pinocchio.updateFramePlacements(model, data)
        aligned = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
        J = pinocchio.getFrameJacobian(model, data, tip, aligned)
        return data.oMf[base].homogeneous, data.oMf[tip].homogeneous, J[:, columns]

    return see


def _self_contacts(described: Arm, q: torch.Tensor) -> dict[str, float]:
    """Fractions of postures in which an arm touches itself, by capsules and by MuJoCo's hulls.

    "missed" counts postures in which hulls of links that are not neighbours touch, but no
    capsules.
    """
    chain, n = described.chain, len(described.joint_names)
    capsules = described.body.self_distance(q).numpy() < 0
    spec = mujoco.MjSpec()
    shapes = (_panda_file() if described.is_franka else described).shape.shapes
    links = sorted({link for link, _ in shapes})
    for link in links:
        body = spec.worldbody.add_body(name=f"{link}")
        body.add_freejoint()
        for k, shape in enumerate(shape for number, shape in shapes if number == link):
            points = shape_points(shape) @ shape.pose[:3, :3].T + shape.pose[:3, 3]
            mesh = spec.add_mesh(name=f"{link}_{k}", uservert=points.ravel())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, mass=1.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    poses = chain.link_poses(q)
    still = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    touches = np.zeros(len(q), dtype=bool)
    for row in range(len(q)):
        for address, link in enumerate(links):
            place = (
                (poses.position[row, link - 1], poses.orientation[row, link - 1])
                if link
                else still
            )
            data.qpos[7 * address : 7 * address + 7] = np.concatenate(place)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        for contact in data.contact:
            a, b = sorted(links[model.geom_bodyid[g] - 1] for g in contact.geom)
            # Flange and tool are one body with the last link.
            apart = min(b, n) - min(a, n) > 1
            touches[row] |= contact.dist < 0 and apart
    return {
        "capsules_touch": float(capsules.mean()),
        "hulls_touch": float(touches.mean()),
        "missed": float((touches & ~capsules).mean()),
    }


def _panda_file() -> Arm:
    """The Panda of example-robot-data, used for its collision meshes."""
    ur5 = arm("ur5").description
    assert ur5 is not None
    robots = next(folder for folder in ur5.parents if folder.name == "robots")
    return arm(robots / "panda_description/urdf/panda.urdf", tip="panda_link8")


def mujoco_model(path: Path) -> mujoco.MjModel:
    """MuJoCo's model of a file. Of a URDF file, only the kinematics are read."""
    if path.suffix != ".urdf":
        return mujoco.MjModel.from_xml_path(str(path))
    robot = ElementTree.parse(path).getroot()
    for link in robot.findall("link"):
        for part in list(link):
            link.remove(part)
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "mass", value="1")
        zero = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        ElementTree.SubElement(inertial, "inertia", ixx="1", iyy="1", izz="1", **zero)
    kept_apart = '<mujoco><compiler fusestatic="false"/></mujoco>'
    robot.append(ElementTree.fromstring(kept_apart))
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(robot, encoding="unicode"))


def _differences(measured: dict[str, float]) -> str:
    """Differences from MuJoCo and Pinocchio as text. For Franka's arms, tests make this
    comparison.
    """
    found = [measured.get(f"difference_from_{name}") for name in ("mujoco", "pinocchio")]
    shown = [f"{error:.0e}" for error in found if error is not None]
    return ", ".join(shown) or "its own model"


def _percent(measured: dict[str, float], *names: str) -> str:
    return ", ".join(f"{100 * measured[name]:.0f}" for name in names)


def _row_before(name: str, args: Args) -> list[str]:
    """Row of an arm in the first file that has one; empty if there is none."""
    rows = [row for file in args.files for row in file.read_text(encoding="utf-8").splitlines()]
    return [row for row in rows if row.startswith(f"| {name} |")][:1]


def _cells_before(name: str, args: Args) -> list[str]:
    """Cells of that row; empty if the number of columns has changed."""
    before = _row_before(name, args)
    cells = [cell.strip() for cell in before[0].split("|")[1:-1]] if before else []
    return cells if len(cells) == _COLUMNS else []


def _servoing(name: str, measured: dict[str, float], args: Args) -> str:
    if not args.trials:
        before = _cells_before(name, args)
        return before[-2] if before else "not tried"
    if "servo_done" not in measured:
        return "out of reach"
    return (
        f"{100 * measured['servo_done']:.1f}; {measured['servo_violations']:.0f}, "
        f"{measured['servo_self_contacts']:.0f}"
    )


def _demo(name: str, args: Args) -> str:
    """Result of the demo. Without a new result, the old value of the table."""
    path = None if args.demos is None else args.demos / f"{name}.json"
    if path is None or not path.is_file():
        before = _row_before(name, args)
        said = before[0].split("|")[-2].strip() if before else "not tried"
        return _refusal(name) or said if path is not None else said
    values = json.loads(path.read_text(encoding="utf-8"))
    if values["success_rate"] < 1 or values["contacts"]:
        return "not done"
    return f"{values['grasp_offset_mm']:.1f}, {values['place_error_mm']:.1f}"


def _refusal(name: str) -> str:
    """Reason why the demo refuses an arm; empty if it does not."""
    choice = ArmChoice(name)
    try:
        Workplace.of(choice.work_arm())
    except UnreachableError:
        return "too small"
    return ""


if __name__ == "__main__":
    cli.run(main, Args)
