"""The world as it looks: the arm with its real shape, in a model of its own.

Physics knows the arm by its capsules: meshes would cost time in each step and each start, and a
contact with them would be another one. Pictures are of a second model, which takes over the
state of the first.
"""

from collections.abc import Iterable

import mujoco

from hrc_learn.geometry import MeshFile, read_mesh
from hrc_learn.geometry.shapes import Colour
from hrc_learn.sim.world import World
from hrc_learn.viz.arm_bodies import arm_meshes

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
