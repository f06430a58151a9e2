"""The coordinates in which actions move linearly."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...dmp.orientation_error import nearest_turn, to_error, to_orientation
from ...geometry import quaternion

SMALLEST_SPREAD = 1e-3
"""Components that vary by less are not blown up to a spread of one."""


class ActionChart(nn.Module):
    """Actions as coordinates of mean zero and spread one, and back.

    A rotation vector becomes the error e = log(r conj(q)) to a reference r, in which an
    orientation moves linearly (see `dmp/rotation/error.py`), r being the mean orientation of
    the demonstrations. So nothing jumps where a rotation vector does, at half a turn, which is
    where a hand that points down is.
    """

    mean: Tensor
    std: Tensor
    reference: Tensor
    """Unit quaternions (w, x, y, z), one for each rotation vector."""

    def __init__(self, width: int, triples: Sequence[Sequence[int]]):
        """Identity, until it has learned.

        Args:
            width: A, components of an action.
            triples: Those that make up rotation vectors [rad].
        """
        super().__init__()
        self.triples = [list(triple) for triple in triples]
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("std", torch.ones(width))
        identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
        self.register_buffer("reference", identity.repeat(len(self.triples), 1))

    def to_coordinates(
        self, actions: Float[Tensor, "*batch T A"]
    ) -> Float[Tensor, "*batch T A"]:
        """Coordinates of actions along time."""
        return (self._unrolled(actions) - self.mean) / self.std

    def to_actions(
        self, coordinates: Float[Tensor, "*batch T A"]
    ) -> Float[Tensor, "*batch T A"]:
        """Actions again; rotation vectors are the ones nearest to the reference's."""
        actions = coordinates * self.std + self.mean
        for triple, reference in zip(self.triples, self.reference, strict=True):
            q = to_orientation(actions[..., triple], reference)
            vector = nearest_turn(quaternion.log(q), quaternion.log(reference))
            actions = _replaced(actions, triple, vector)
        return actions

    @torch.no_grad()
    def learn(self, episodes: Sequence[Float[Tensor, "_frames A"]]) -> None:
        """Take mean, spread and references from demonstrated actions.

        Raises:
            ValueError: Orientations more than half a turn away from their mean.
        """
        for k, triple in enumerate(self.triples):
            q = quaternion.exp(torch.cat([e[:, triple] for e in episodes]))
            self.reference[k] = _mean_orientation(q)
        unrolled = [self._unrolled(episode) for episode in episodes]
        for triple in self.triples:
            for k, episode in enumerate(unrolled):
                if (episode[:, triple].norm(dim=-1) > torch.pi).any():
                    raise ValueError(
                        f"demonstration {k} turns the hand by more than half a turn from the "
                        "mean orientation, where a rotation vector is ambiguous: leave it out "
                        "(fit_episodes), or use joints as actions"
                    )
        self.whiten(*torch.std_mean(torch.cat(unrolled), dim=0))

    def whiten(self, std: Float[Tensor, "A"], mean: Float[Tensor, "A"]) -> None:
        """Take these for spread and mean of what is to be whitened."""
        self.mean.copy_(mean)
        self.std.copy_(std.clamp_min(SMALLEST_SPREAD))

    def _unrolled(self, actions: Tensor) -> Tensor:
        for triple, reference in zip(self.triples, self.reference, strict=True):
            q = quaternion.exp(actions[..., triple])
            actions = _replaced(actions, triple, quaternion.unwrap_log(to_error(q, reference)))
        return actions


def _replaced(values: Tensor, columns: list[int], new: Tensor) -> Tensor:
    index = torch.tensor(columns, device=values.device)
    return values.index_copy(-1, index, new.to(values))


def _mean_orientation(q: Float[Tensor, "n 4"]) -> Float[Tensor, "4"]:
    """The one whose squared chords to all are the shortest (Markley et al. 2007)."""
    return torch.linalg.eigh(q.double().mT @ q.double()).eigenvectors[:, -1].to(q)
