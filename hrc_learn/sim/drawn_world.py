"""The world as it looks: the arm with its real shape, in a model of its own.

Physics knows the arm by its capsules: meshes would cost time in each step and each start, and a
contact with them would be another one. Pictures are of a second model, which takes over the
state of the first.
"""

from collections.abc import Iterable

import mujoco
import numpy as np

from hrc_learn.geometry import Body, MeshFile, read_mesh
from hrc_learn.geometry.shapes import Box, Colour
from hrc_learn.kinematics.arm_shapes import arm_meshes
from hrc_learn.log import RunRecording
from hrc_learn.sim.scene import add_surroundings
from hrc_learn.sim.world import World

# pyright: reportAttributeAccessIssue=false
# MuJoCo ships no type stubs; its names come from a compiled module.

_HIDDEN = 4  # geoms and sites of this group are not drawn
_SHOWN = 1
_SPECULAR, _SHININESS = 0.3, 0.4  # of painted metal and plastic


class DrawnWorld:
    """A world with meshes in place of the capsules of its arm, to be rendered.

    Where there are no meshes, capsules are drawn.

    Attributes:
        model: To be rendered.
        data: As the world was at the last `update`.
    """

    def __init__(self, world: World):
        self._world = world
        spec = world.describe()
        for body in spec.bodies:
            if meshes := arm_meshes(world.arm.robot, body.name):
                for geom in body.geoms:
                    # Plates and the pictures on them are no part of the meshes.
                    if "marker" not in geom.name:
                        geom.group = _HIDDEN
                for mesh in meshes:
                    add_mesh(spec, body, mesh)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._colours = self.model.geom_rgba.copy()
        self.update()

    def update(self) -> None:
        """Take over where everything is."""
        data, now = self.data, self._world.data
        data.qpos[:], data.time = now.qpos, now.time
        data.mocap_pos[:], data.mocap_quat[:] = now.mocap_pos, now.mocap_quat
        mujoco.mj_kinematics(self.model, data)
        mujoco.mj_camlight(self.model, data)

    def paint(self, geoms: Iterable[str], colour: Colour) -> None:
        """Let geoms of the world stand out, or the bodies that are drawn in their place.

        Args:
            geoms: Their names; all others have their own colour again.
            colour: RGBA, 0 to 1.
        """
        self.model.geom_rgba[:] = self._colours
        for name in geoms:
            geom = self.model.geom(name)
            if geom.group == _HIDDEN:
                own = self.model.geom_bodyid == geom.bodyid
                self.model.geom_rgba[own & (self.model.geom_group == _SHOWN)] = colour
            else:
                self.model.geom_rgba[geom.id] = colour


class RecordedWorld:
    """A run as its recording shows it, to be rendered at any of its steps.

    It needs no more than the recording: a run of any task, in simulation or not, can be looked
    at without the world that it ran in.

    Attributes:
        model: To be rendered. Its bodies have no joints; each is put where it was.
        data: As the run was at the last `show`.
    """

    def __init__(self, recording: RunRecording):
        self._bodies = recording.bodies
        spec = mujoco.MjSpec()
        spec.compiler.degree = False
        add_surroundings(spec)
        for box in recording.boxes:
            _add_drawn_box(spec.worldbody, box)
        for number, body in enumerate(recording.bodies):
            _add_drawn_body(spec, body, f"body{number}")
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.show(0)

    def show(self, step: int) -> None:
        """Put everything where it was at a step."""
        for number, body in enumerate(self._bodies):
            self.data.mocap_pos[number] = body.position[step]
            self.data.mocap_quat[number] = body.orientation[step]
        self.update()

    def update(self) -> None:
        """Make ready to be rendered."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    def paint(self, geoms: Iterable[str], colour: Colour) -> None:
        """Nothing stands out: a recording does not know what touched what."""


def _add_drawn_body(spec: mujoco.MjSpec, body: Body, name: str) -> None:
    drawn = spec.worldbody.add_body(name=name, mocap=True)
    for mesh in body.meshes:
        add_mesh(spec, drawn, mesh)
    for box in body.boxes:
        if box.name or not body.meshes:  # as in every other picture of a body
            _add_drawn_box(drawn, box)
    for capsule in () if body.meshes else body.capsules:
        ends = np.array([*capsule.start, *capsule.end])
        if np.allclose(ends[:3], ends[3:]):  # a capsule without a length has no direction
            drawn.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=(capsule.radius, 0, 0),
                pos=capsule.start,
                rgba=capsule.colour,
            )
            continue
        drawn.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            size=(capsule.radius, 0, 0),
            fromto=ends,
            rgba=capsule.colour,
        )


def _add_drawn_box(body: mujoco.MjsBody, box: Box) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=box.half_size,
        pos=box.centre,
        rgba=box.colour,
    )


def add_mesh(spec: mujoco.MjSpec, body: mujoco.MjsBody, mesh: MeshFile) -> None:
    """Add a shape that is seen, touches nothing and weighs nothing to a body."""
    for part in read_mesh(mesh.path):
        placed = part.placed(mesh)
        name = f"mesh{len(spec.meshes)}"
        shape = spec.add_mesh(name=name)
        shape.uservert = placed.vertices.ravel()
        shape.usernormal = placed.normals.ravel()
        shape.userface = placed.faces.ravel()
        shape.userfacenormal = placed.faces.ravel()
        # Of an open surface there is no volume to compute an inertia from.
        shape.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        material = spec.add_material(name=name, specular=_SPECULAR, shininess=_SHININESS)
        material.rgba = (1.0, 1.0, 1.0, 1.0)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=name,
            material=name,
            rgba=placed.colour or (1.0, 1.0, 1.0, 1.0),
            group=_SHOWN,
            contype=0,
            conaffinity=0,
            mass=0.0,
        )
