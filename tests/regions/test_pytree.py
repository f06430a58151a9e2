import torch
from torch.utils import _pytree

from hrc_learn.controller import Goals
from hrc_learn.regions import PositionRegion


def box(**options) -> PositionRegion:
    return PositionRegion(centre=torch.zeros(3), half_size=torch.ones(3), **options)


def test_tensors_are_leaves_and_gains_are_structure():
    leaves, structure = _pytree.tree_flatten(box(stiffness=0.7))
    assert len(leaves) == 2
    restored = _pytree.tree_unflatten([leaf + 1 for leaf in leaves], structure)
    assert isinstance(restored, PositionRegion)
    assert restored.stiffness == 0.7
    assert (restored.centre == 1).all()
    assert structure != _pytree.tree_flatten(box(stiffness=0.8))[1]


def test_an_absent_tensor_has_no_leaf():
    goals = Goals.at(torch.zeros(3), torch.eye(4)[0])
    count = len(_pytree.tree_leaves(goals))
    assert len(_pytree.tree_leaves(goals.approached_by(torch.zeros(7)))) == count + 1
    restored = _pytree.tree_unflatten(*_pytree.tree_flatten(goals))
    assert restored.posture is None


def test_leaves_are_named_after_their_fields():
    paths, _ = _pytree.tree_flatten_with_path(box())
    assert [_pytree.keystr(path) for path, _ in paths] == [".centre", ".half_size"]
