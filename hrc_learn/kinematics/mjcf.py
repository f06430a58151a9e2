"""Robot descriptions in MJCF. MuJoCo itself reads the files, with defaults and includes."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from hrc_learn.geometry.shapes import Colour
from hrc_learn.kinematics.description import (
    MOVING,
    Description,
    Joint,
    Link,
    Shape,
    Transform,
    motion,
    pseudo_inertia,
    transform,
)

_NO_MASS = 1e-9
"""Mass that marks bodies without a known mass [kg]."""


def read_mjcf(path: Path) -> Description:
    """Read an MJCF file.

    A body becomes a link, and a site becomes a link fixed to its body. Each joint of a body
    adds a link before the body's link, named after the body and the joint. Missing meshes are
    left out, and a warning names the first one.

    Raises:
        ValueError: The file is not MJCF.
        ModuleNotFoundError: MuJoCo is not installed.
    """
    try:
        import mujoco
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            f"{path} is MJCF, which MuJoCo reads: install hrc-learn[sim]", name="mujoco"
        ) from None
    try:
        model: Any = mujoco.MjModel.from_xml_path(str(path))  # pyright: ignore
    except ValueError as error:
        model = _model_without_missing_meshes(path, mujoco)
        if model is None:
            raise ValueError(f"{path}: {' '.join(str(error).split())}") from None
    return _Reader(path, model, mujoco).description()


def _model_without_missing_meshes(path: Path, mujoco: Any) -> Any | None:
    """Model without the meshes whose files are missing, with a warning; None if the description
    has another error.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        folder = path.parent / spec.meshdir
        missing = [
            mesh for mesh in spec.meshes if mesh.file and not (folder / mesh.file).is_file()
        ]
        names, files = {mesh.name for mesh in missing}, [mesh.file for mesh in missing]
        for geom in [g for g in spec.geoms if g.meshname and g.meshname in names]:
            spec.delete(geom)
        for mesh in missing:
            spec.delete(mesh)
        # A body that took its mass from these meshes gets `_NO_MASS`: its mass is unknown.
        spec.compiler.boundmass = spec.compiler.boundinertia = _NO_MASS
        model = spec.compile()
    except ValueError:
        return None
    if files:
        warnings.warn(
            f"{path}: {len(files)} meshes are missing, such as {files[0]}: links without "
            "shapes get capsules",
            stacklevel=4,
        )
    return model if files else None


class _Reader:
    def __init__(self, path: Path, model: Any, mujoco: Any):
        self.path, self.model, self.mujoco = path, model, mujoco

    def description(self) -> Description:
        model = self.model
        links, joints = [], []
        followers = self._followers()
        for i in range(model.nbody):
            links.append(self._link(i))
            if i > 0:
                joints += self._joints(i, links, followers)
        taken = {link.name for link in links}
        for i in range(model.nsite):
            site = model.site(i)
            if site.name and site.name not in taken:
                links.append(Link(name=site.name))
                pose = self._pose(site.pos, site.quat)
                body = self._name(int(model.site_bodyid[i]))
                joints.append(_fixed(f"{site.name} (site)", body, site.name, pose))
        return Description(self.path, links, joints, self._home())

    def _name(self, body: int) -> str:
        return self.model.body(body).name or ("world" if body == 0 else f"(body {body})")

    def _joint_name(self, joint: int) -> str:
        return self.model.joint(joint).name or f"(joint {joint})"

    def _link(self, i: int) -> Link:
        model, visuals, collisions = self.model, [], []
        first = int(model.body_geomadr[i])
        for g in range(first, first + int(model.body_geomnum[i])):
            shape = self._shape(g)
            if shape is not None:
                touches = model.geom_contype[g] or model.geom_conaffinity[g]
                # By convention visual geoms do not collide, and group 3 and up is not drawn.
                if touches:
                    collisions.append(shape)
                if not touches or int(model.geom_group[g]) < 3:
                    visuals.append((bool(touches), shape))
        # Geoms that also collide are drawn only on bodies without purely visual geoms.
        alone = [shape for touches, shape in visuals if not touches]
        drawn = alone or [shape for _, shape in visuals]
        mass, known = float(model.body_mass[i]), float(model.body_mass[i]) > _NO_MASS
        axes = self._pose(model.body_ipos[i], model.body_iquat[i])
        body = pseudo_inertia(mass, (0.0, 0.0, 0.0), np.diag(model.body_inertia[i]))
        return Link(
            name=self._name(i),
            mass=mass if known else None,
            inertia=axes @ body @ axes.T if known else None,
            visuals=tuple(drawn),
            collisions=tuple(collisions),
        )

    def _shape(self, g: int) -> Shape | None:
        model, kinds = self.model, self.mujoco.mjtGeom
        kind = int(model.geom_type[g])
        pose = self._pose(model.geom_pos[g], model.geom_quat[g])
        place = {"pose": pose, "colour": self._colour(g)}
        x, y, z = model.geom_size[g].tolist()
        if kind == kinds.mjGEOM_MESH:
            mesh = int(model.geom_dataid[g])
            # MuJoCo moves a mesh to its principal axes, and moves the geom to compensate.
            moved = self._pose(model.mesh_pos[mesh], model.mesh_quat[mesh])
            place["pose"] = pose @ np.linalg.inv(moved)
            sx, sy, sz = model.mesh_scale[mesh].tolist()
            place_of_name = int(model.mesh_pathadr[mesh])
            if place_of_name < 0:  # the description itself contains the vertices
                return None
            name = bytes(model.paths[place_of_name:]).partition(b"\0")[0]
            path = Path(name.decode())
            return Shape(kind="mesh", path=path, scale=(sx, sy, sz), **place)
        known = {
            kinds.mjGEOM_BOX: ("box", (x, y, z)),
            kinds.mjGEOM_SPHERE: ("sphere", (x, 0.0)),
            kinds.mjGEOM_CAPSULE: ("capsule", (x, y)),
            kinds.mjGEOM_CYLINDER: ("cylinder", (x, y)),
        }
        if kind not in known:  # planes, height fields and the like are no part of an arm
            return None
        name, size = known[kind]
        return Shape(kind=name, size=size, **place)

    def _colour(self, g: int) -> Colour:
        material = int(self.model.geom_matid[g])
        rgba = self.model.geom_rgba[g] if material < 0 else self.model.mat_rgba[material]
        red, green, blue, opacity = rgba.tolist()
        return (red, green, blue, opacity)

    def _joints(self, i: int, links: list[Link], followers: dict[int, Any]) -> list[Joint]:
        model, name = self.model, self._name(i)
        parent = self._name(int(model.body_parentid[i]))
        placed = self._pose(model.body_pos[i], model.body_quat[i])
        first, count = int(model.body_jntadr[i]), int(model.body_jntnum[i])
        if count == 0:
            return [_fixed(f"{name} (fixed)", parent, name, placed)]
        joints = []
        for j in range(first, first + count):
            kind = ("free", "ball", "prismatic", "revolute")[int(model.jnt_type[j])]
            anchor = np.eye(4)
            anchor[:3, 3] = model.jnt_pos[j]
            # Joint positions count from the reference position in the file.
            moving = f"{name} ({self._joint_name(j)})"
            at = float(model.qpos0[model.jnt_qposadr[j]]) if kind in MOVING else 0.0
            zero = motion(kind, model.jnt_axis[j], -at) if at else np.eye(4)
            limited = bool(model.jnt_limited[j])
            lower, upper = model.jnt_range[j].tolist() if limited else (None, None)
            if kind == "revolute" and not limited:
                kind = "continuous"
            links.append(Link(name=moving))
            joints.append(
                Joint(
                    name=self._joint_name(j),
                    kind=kind,
                    parent=parent,
                    child=moving,
                    origin=placed @ anchor @ zero,
                    axis=model.jnt_axis[j].copy(),
                    lower=lower,
                    upper=upper,
                    effort=self._effort(j),
                    follows=followers.get(j),
                )
            )
            parent, placed = moving, np.linalg.inv(anchor)
        joints.append(_fixed(f"{name} (fixed)", parent, name, placed))
        return joints

    def _effort(self, j: int) -> float | None:
        """Force [N] or torque [N m] limit of a joint, or else of the joint's first limited
        actuator; None: no limit.
        """
        model = self.model
        if model.jnt_actfrclimited[j]:
            return float(np.abs(model.jnt_actfrcrange[j]).max())
        for a in range(model.nu):
            if model.actuator_trntype[a] == 0 and model.actuator_trnid[a, 0] == j:
                force = math.inf
                if model.actuator_forcelimited[a]:
                    force = np.abs(model.actuator_forcerange[a]).max()
                motor = model.actuator_biastype[a] == 0 and model.actuator_gaintype[a] == 0
                if motor and model.actuator_ctrllimited[a]:
                    control = np.abs(model.actuator_ctrlrange[a]).max()
                    force = min(force, abs(model.actuator_gainprm[a, 0]) * control)
                if force < math.inf:
                    return float(abs(model.actuator_gear[a, 0]) * force)
        return None

    def _followers(self) -> dict[int, tuple[str, float, float]]:
        """Leading joint, factor and offset, by the number of the following joint.

        A joint follows if an active equality constraint couples it to another joint or holds it
        in place.
        """
        model, tied = self.model, {}
        for e in range(model.neq):
            if model.eq_type[e] == self.mujoco.mjtEq.mjEQ_JOINT and model.eq_active0[e]:
                other = int(model.eq_obj2id[e])
                leader = self._joint_name(other) if other >= 0 else ""
                offset, factor = model.eq_data[e, :2].tolist()
                # MuJoCo couples displacements from the reference positions.
                joint = int(model.eq_obj1id[e])
                offset += model.qpos0[model.jnt_qposadr[joint]]
                if other >= 0:
                    offset -= factor * model.qpos0[model.jnt_qposadr[other]]
                tied[joint] = (leader, factor, float(offset))
        return tied

    def _home(self) -> dict[str, float] | None:
        model = self.model
        for k in range(model.nkey):
            if model.key(k).name == "home":
                qpos = model.key_qpos[k].tolist()
                addresses = model.jnt_qposadr.tolist()
                return {self._joint_name(j): qpos[a] for j, a in enumerate(addresses)}
        return None

    def _pose(self, position: np.ndarray, quat: np.ndarray) -> Transform:
        R = np.zeros(9)
        self.mujoco.mju_quat2Mat(R, np.ascontiguousarray(quat, dtype=np.float64))
        return transform(R.reshape(3, 3), np.array(position, dtype=np.float64))


def _fixed(name: str, parent: str, child: str, origin: Transform) -> Joint:
    axis = np.array([0.0, 0.0, 1.0])
    return Joint(name=name, kind="fixed", parent=parent, child=child, origin=origin, axis=axis)
