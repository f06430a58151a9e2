"""Arms read from URDF and MJCF files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from hrc_learn.kinematics._assembly import assemble
from hrc_learn.kinematics._description import Description
from hrc_learn.kinematics._mjcf import read_mjcf
from hrc_learn.kinematics._urdf import read_urdf
from hrc_learn.kinematics.arm import Arm, ArmShape
from hrc_learn.kinematics.chain import SerialChain
from hrc_learn.kinematics.limits import complete_limits, read_limits

type LimitsGiven = Mapping[str, Mapping[str, float]] | Path | None
"""Limits that replace or complete those of a description, see `complete_limits`, or a file."""


def arm_from_file(
    path: str | Path,
    *,
    base: str | None = None,
    tip: str | None = None,
    name: str | None = None,
    tool: Float[Tensor, "4 4"] | None = None,
    limits: LimitsGiven = None,
    ready: Sequence[float] | None = None,
    package_dirs: Sequence[str | Path] = (),
    meshes: bool = True,
) -> Arm:
    """An arm from a URDF (.urdf) or MJCF (.xml, .mjcf) file.

    Args:
        path: The file.
        base: Link (URDF) or body (MJCF) of the base; None: the root, or the world.
        tip: Link, body or site of the flange; None: the only end that the robot has.
        name: Name of the arm; None: the stem of the file.
        tool: Tool centre point in the frame of the flange, z in the direction of approach;
            None: the flange itself.
        limits: Limits that replace or complete those of the file; None: the TOML file named
            after it, `ur5e.limits.toml` for `ur5e.urdf`, if there is one.
        ready: A comfortable posture [rad, m]; None: the file's `home`, or a posture near the
            middle of the joints' ranges and far from singularities.
        package_dirs: Folders in which `package://NAME/` is looked up first (URDF).
        meshes: False skips the meshes of a URDF: the arm then has only the shapes that the
            file describes as boxes, cylinders and spheres.

    Raises:
        ValueError: The format is unknown, or the links form no serial chain.
        FileNotFoundError: The file, or a mesh that it names, is missing.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".urdf":
        description = read_urdf(path, [Path(folder) for folder in package_dirs], meshes=meshes)
    elif suffix in (".xml", ".mjcf"):
        description = read_mjcf(path)
    else:
        raise ValueError(f"{path}: a description ends in .urdf, .xml or .mjcf")
    return arm_from_description(
        description, base=base, tip=tip, name=name, tool=tool, limits=limits, ready=ready
    )


def arm_from_description(
    description: Description,
    *,
    base: str | None = None,
    tip: str | None = None,
    name: str | None = None,
    tool: Float[Tensor, "4 4"] | None = None,
    limits: LimitsGiven = None,
    ready: Sequence[float] | None = None,
) -> Arm:
    """An arm from a parsed description; arguments and errors as for `arm_from_file`."""
    parts = assemble(description, base, tip, tool)
    names = [joint.name for joint in parts.moving]
    chain_limits = complete_limits(
        names,
        parts.kinds,
        [
            {
                "lower": joint.lower,
                "upper": joint.upper,
                "velocity": joint.velocity,
                "torque": joint.effort,
            }
            for joint in parts.moving
        ],
        source=str(description.path),
        overrides=_overrides(description.path, limits),
    )
    home = description.home
    if ready is None and home is not None and all(n in home for n in names):
        ready = [home[n] for n in names]
    chain = SerialChain(
        joint_names=names,
        mounts=torch.from_numpy(parts.mounts),
        flange=torch.from_numpy(parts.flange),
        tcp=torch.from_numpy(parts.tcp),
        limits=chain_limits,
        ready=chain_limits.middle if ready is None else torch.tensor(ready).double(),
        kinds=parts.kinds,
    )
    if ready is None:
        chain.ready = _comfortable(chain)
    return Arm(
        name=name or description.path.stem,
        chain=chain,
        shape=ArmShape(
            visuals=parts.visuals,
            gripper=parts.gripper,
            shapes=parts.shapes,
            masses=parts.masses,
        ),
        description=description.path,
        format=description.format,
        base=parts.base,
        tip=parts.tip,
    )


def _overrides(path: Path, given: LimitsGiven) -> Mapping[str, Mapping[str, float]] | None:
    if given is None:
        sidecar = path.with_suffix(".limits.toml")
        return read_limits(sidecar) if sidecar.is_file() else None
    return read_limits(given) if isinstance(given, Path) else given


# Number of random postures among which `_comfortable` chooses; the seed repeats the choice.
_POSTURES, _SEED = 4096, 0


def _comfortable(chain: SerialChain) -> Float[Tensor, " joints"]:
    """Default ready posture [rad, m].

    Among random postures, the one with the highest sum of four scores, each at most one:
    distance from singularities, distance from limits, the tool pointing down, and the tool in
    front of the base at half of its reach.
    """
    rng = torch.Generator().manual_seed(_SEED)
    lower, upper = chain.limits.lower, chain.limits.upper
    # Joints with more than one revolution are sampled around their middle.
    half = ((upper - lower) / 2).clamp(max=torch.pi)
    random = torch.rand(_POSTURES, len(lower), generator=rng, dtype=torch.float64)
    q = chain.limits.middle + (2 * random - 1) * half
    T, J = chain.transform_and_jacobian(q)
    smallest = torch.linalg.svdvals(J)[:, -1]
    position = T[:, :3, 3]
    reach = torch.linalg.vector_norm(position, dim=-1).amax()
    wanted = torch.stack([reach / 2, 0 * reach, reach / 4])
    away = torch.linalg.vector_norm(position - wanted, dim=-1) / reach
    margin = (torch.minimum(q - lower, upper - q) / half).amin(-1)
    score = smallest / smallest.amax() + margin.clamp(max=1) - T[:, 2, 2] - away
    return q[score.argmax()]
