"""Encode actions as coordinates without jumps, and find the meaning of action columns."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hrc_learn.dmp import orientation_error
from hrc_learn.geometry import quaternion

SMALLEST_SPREAD = 1e-3
"""Smallest divisor: a component with a smaller spread is not amplified to a spread of one."""


class ActionEncoding(nn.Module):
    """Actions as coordinates of mean zero and spread one, and back.

    A rotation vector of orientation q becomes the error e = log(r conj(q)) to a reference r,
    the mean orientation of the demonstrations. Orientations are interpolated linearly in e (see
    `hrc_learn/dmp/orientation_error.py`). A rotation vector jumps at half a turn, which is the
    orientation of a gripper that points down. The coordinates do not jump there.
    """

    def __init__(self, width: int, triples: Sequence[Sequence[int]]):
        """Start with a mean of zero, a spread of one and references without rotation.

        Args:
            width: Number A of components of an action.
            triples: Indices of the three components of each rotation vector [rad].
        """
        super().__init__()
        self.triples = [list(triple) for triple in triples]
        self.mean = nn.Buffer(torch.zeros(width))
        """Mean of each component, (A)."""
        self.std = nn.Buffer(torch.ones(width))
        """Spread of each component, (A)."""
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.reference = nn.Buffer(identity.repeat(len(self.triples), 1))
        """Unit quaternions (w, x, y, z), one for each rotation vector."""

    def to_coordinates(
        self, actions: Float[Tensor, "*batch T A"]
    ) -> Float[Tensor, "*batch T A"]:
        """Coordinates of successive actions."""
        return (self._unrolled(actions) - self.mean) / self.std

    def to_actions(
        self, coordinates: Float[Tensor, "*batch T A"]
    ) -> Float[Tensor, "*batch T A"]:
        """Actions from coordinates, with the rotation vectors nearest to that of the
        reference.
        """
        actions = coordinates * self.std + self.mean
        for triple, reference in zip(self.triples, self.reference, strict=True):
            q = orientation_error.to_orientation(actions[..., triple], reference)
            vector = orientation_error.nearest_turn(
                quaternion.log(q), quaternion.log(reference)
            )
            actions = _replaced(actions, triple, vector)
        return actions

    @torch.no_grad()
    def learn(self, episodes: Sequence[Float[Tensor, "_frames A"]]) -> None:
        """Set mean, spread and references from demonstrated actions.

        Raises:
            ValueError: An orientation is more than half a turn away from the mean.
        """
        for k, triple in enumerate(self.triples):
            q = quaternion.exp(torch.cat([e[:, triple] for e in episodes]))
            self.reference[k] = quaternion.mean(q)
        unrolled = [self._unrolled(episode) for episode in episodes]
        for triple in self.triples:
            for k, episode in enumerate(unrolled):
                if (episode[:, triple].norm(dim=-1) > torch.pi).any():
                    raise ValueError(
                        f"demonstration {k} turns the end effector by more than half a turn "
                        "from the mean orientation, where a rotation vector is ambiguous: "
                        "leave it out (fit_episodes), or use joints as actions"
                    )
        self.whiten(*torch.std_mean(torch.cat(unrolled), dim=0))

    def whiten(self, std: Float[Tensor, "A"], mean: Float[Tensor, "A"]) -> None:
        """Set the spread and the mean for whitening."""
        self.mean.copy_(mean)
        self.std.copy_(std.clamp_min(SMALLEST_SPREAD))

    def _unrolled(self, actions: Tensor) -> Tensor:
        """Actions with each rotation vector replaced by its error to the reference."""
        for triple, reference in zip(self.triples, self.reference, strict=True):
            q = quaternion.exp(actions[..., triple])
            error = orientation_error.to_error(q, reference)
            actions = _replaced(actions, triple, quaternion.unwrap_log(error))
        return actions


def _replaced(values: Tensor, columns: list[int], new: Tensor) -> Tensor:
    index = torch.tensor(columns, device=values.device)
    return values.index_copy(-1, index, new.to(values))


# The functions below find components of action and state that belong together, by their names.

ROTATION = ("wx", "wy", "wz")
"""Last part of the names of a rotation vector's components, as LeRobot names them."""
ENDINGS = ("", ".pos")
"""Possible endings of names; lerobot-rollout drops names without an ending."""


def rotation_triples(names: Sequence[str] | None) -> list[list[int]]:
    """Indices of components that make up rotation vectors, such as ee.wx, ee.wy, ee.wz.

    Args:
        names: Names of all components; None: unknown.
    """
    index = {name: i for i, name in enumerate(names or ())}
    triples = []
    for name in index:
        for ending in ENDINGS:
            stem = name.removesuffix(ROTATION[0] + ending)
            triple = [stem + part + ending for part in ROTATION]
            if stem != name and index.keys() >= {*triple}:
                triples.append([index[part] for part in triple])
    return triples


def matched_columns(
    action_names: Sequence[str] | None,
    state_names: Sequence[str] | None,
    widths: tuple[int, int],
) -> list[int]:
    """State columns that measure each component of the action; -1: not measured.

    If neither action nor state has names and their widths agree, the state counts as the
    measured action. A rotation vector counts as measured only if all its components are.

    Args:
        action_names: Names of the action's components; None: unknown.
        state_names: Names of the state's components; None: unknown.
        widths: Number of components of action and state.
    """
    actions, states = widths
    if action_names is None and state_names is None and actions == states:
        return list(range(actions))
    index = {name: i for i, name in enumerate(state_names or ())}
    columns = [index.get(name, -1) for name in action_names or [""] * actions]
    for triple in rotation_triples(action_names):
        if any(columns[i] < 0 for i in triple):
            for i in triple:
                columns[i] = -1
    return columns


TWO_LEVEL = 0.9
"""A column counts as two-level if its variance is more than this fraction of the largest
variance possible between its minimum and maximum (Bhatia and Davis 2000, "A better bound on the
variance"). The fraction is 1 for a column without values in between.
"""


def two_level_columns(mean: Tensor, std: Tensor, low: Tensor, high: Tensor) -> list[int]:
    """Columns that are mostly at their minimum or maximum, such as a gripper's.

    Args:
        mean: Mean of each column, (A).
        std: Standard deviation of each column.
        low: Minimum of each column.
        high: Maximum of each column.
    """
    largest = (high - mean) * (mean - low)
    return ((std > 0) & (std.square() > TWO_LEVEL * largest)).nonzero().flatten().tolist()
