"""Which components of action and state belong together, by their names."""

from collections.abc import Sequence

ROTATION = ("wx", "wy", "wz")
"""Last part of the names of a rotation vector's components, as LeRobot has them."""
ENDINGS = ("", ".pos")
"""What may follow it: lerobot-rollout hands on no names but those with an ending."""


def rotation_triples(names: Sequence[str] | None) -> list[list[int]]:
    """Components that make up rotation vectors, such as ee.wx, ee.wy, ee.wz.

    Args:
        names: Of all components; None: unknown, so that there is none.
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
    """Where each component of the action is measured: columns of the state, -1 for nowhere.

    Where neither has names, states as wide as actions are taken for what they command. A
    rotation vector is taken whole or not at all.

    Args:
        action_names: None: unknown.
        state_names: None: unknown.
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
