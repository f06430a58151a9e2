"""Tokens of integer vectors: a code in which every sequence of tokens is valid.

Each token answers a series of questions about the integers, in order: is the first one zero, is
it positive, is its magnitude above a threshold, is the next one zero, ... The questions of a
token form a binary tree with one leaf for each token of the vocabulary. Splitting the most
probable leaf until the vocabulary is used up makes all tokens about equally probable (Tunstall
1967, "Synthesis of noiseless compression codes"), so that each token carries nearly as much
information as possible. Every leaf stands for possible integers: no sequence is invalid, and a
prefix determines the first integers.

Encoder and decoder build equal trees on every machine, because the trees depend only on sums,
products, quotients and comparisons of float64 numbers.
"""

import heapq
from array import array
from bisect import bisect
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

END = 0
"""Token after which all integers are zero; it also pads sequences."""
PRIOR = 20.0
"""Weight of the prior (a Laplace distribution) of each integer, as a number of vectors."""
LEAST = 0.02
"""Value added to the mean magnitude of each integer, because the mean in the data may be 0."""
HEADROOM = 2.0
"""Largest allowed magnitude of an integer, relative to its largest magnitude in the data."""


class Interval(NamedTuple):
    """Knowledge of an integer: its index, its sign (0: unknown), bounds of its magnitude."""

    index: int
    sign: int
    low: int
    high: int


class _Tree(NamedTuple):
    """Questions of one token."""

    index: array
    """Integer that each question is about."""
    threshold: array
    """Largest magnitude in the first branch. -1: the question is the sign, and the second
    branch is negative."""
    branches: array
    """Two entries for each question: the next question, or -1 - i for leaf i."""
    after: list[Interval]
    """Knowledge after each leaf."""
    decided: list[tuple[Interval, ...]]
    """Integers other than zero that are decided on the way to each leaf."""


class TokenCode:
    """Code for vectors of K integers, with tokens 0 ... vocabulary_size - 1."""

    def __init__(self, vocabulary_size: int, table: Float[np.ndarray, "K M"]):
        """Prepare the code.

        Args:
            vocabulary_size: Number of tokens, `END` included.
            table: Probability of each magnitude of each integer; zero for magnitudes that are
                not allowed.
        """
        self.vocabulary_size, self.table = vocabulary_size, table
        self.size = len(table)
        self._largest = [int(row.nonzero()[0][-1]) for row in table]
        self._cumulative = np.cumsum(np.pad(table, ((0, 0), (1, 0))), 1).tolist()
        self._trees: dict[Interval, _Tree] = {}

    @classmethod
    def fit(cls, values: Int[np.ndarray, "N K"], vocabulary_size: int) -> "TokenCode":
        """Learn the distribution of each integer from vectors."""
        size = np.abs(values)
        largest = np.ceil(HEADROOM * size.max(0, initial=1)).astype(int)
        m = np.arange(largest.max(initial=1) + 1)
        scale = size.mean(0)[:, None] + LEAST
        laplace = np.exp(-m / scale) + 1e-12
        laplace[m > largest[:, None]] = 0
        table = PRIOR * laplace / laplace.sum(1, keepdims=True)
        for row, column in zip(table, size.T, strict=True):
            row += np.bincount(column, minlength=len(m))
        return cls(vocabulary_size, table / table.sum(1, keepdims=True))

    def bits(self) -> Float[Tensor, "K M"]:
        """Information [bit] of each magnitude of each integer; infinite above the largest."""
        signed = np.where(np.arange(self.table.shape[1]) > 0, 0.5, 1.0)
        with np.errstate(divide="ignore"):
            return torch.from_numpy(-np.log2(signed * self.table))

    def encode(self, values: Sequence[int]) -> list[int]:
        """Tokens of a vector; magnitudes are limited to the largest of each integer."""
        values = [max(-m, min(m, v)) for v, m in zip(values, self._largest, strict=True)]
        last = max((k for k, v in enumerate(values) if v), default=-1)
        state, ids = self._whole(0), []
        while state.index < self.size:
            tree, node = self._tree(state), 0
            while node >= 0:
                value, threshold = values[tree.index[node]], tree.threshold[node]
                second = value < 0 if threshold < 0 else abs(value) > threshold
                node = tree.branches[2 * node + second]
            done, state = state.index > last, tree.after[-1 - node]
            # `END` says that all remaining integers are zero, however many there are.
            if done and state.index < self.size:
                return [*ids, END]
            ids.append(-node)
        return ids

    def decode(self, ids: Sequence[int]) -> tuple[list[Interval], bool]:
        """Integers other than zero, and true if no further token could change them."""
        state, found = self._whole(0), []
        for i in ids:
            if state.index == self.size:
                break
            tree = self._tree(state)
            # A token has no leaf if fewer vectors are possible than there are tokens.
            if i == END or i > len(tree.after):
                return found, True
            found += tree.decided[i - 1]
            state = tree.after[i - 1]
        if state.sign:
            found.append(state)
        return found, state.index == self.size

    def _whole(self, index: int) -> Interval:
        """State before anything is known about an integer."""
        return Interval(index, 0, 0, self._largest[index] if index < self.size else 0)

    def _split(self, state: Interval) -> tuple[int, float, Interval, Interval]:
        """Next question: threshold, probability of the first branch, and both new states."""
        index, sign, low, high = state
        if low and not sign:
            return -1, 0.5, state._replace(sign=1), state._replace(sign=-1)
        row = self._cumulative[index]
        start, total = row[low], row[high + 1] - row[low]
        threshold = low and bisect(row, start + total / 2, low + 1, high) - 1
        parts = state._replace(high=threshold), state._replace(low=threshold + 1)
        return threshold, (row[threshold + 1] - start) / total, *parts

    def _tree(self, root: Interval) -> _Tree:
        """Tree that splits the most probable leaf until each token but 0 has a leaf."""
        if root in self._trees:
            return self._trees[root]
        tree = _Tree(array("i"), array("i"), array("i"), [], [])
        # Entries: minus the probability, the order, the state, the decided integers, and the
        # branch that leads to the leaf.
        heap: list[tuple[float, int, Interval, tuple[Interval, ...], int]] = []
        heap.append((-1.0, 0, root, (), -1))
        done = []
        while heap and len(heap) + len(done) < self.vocabulary_size - 1:
            minus, _, state, decided, branch = heapq.heappop(heap)
            node, (threshold, probability, *parts) = len(tree.index), self._split(state)
            tree.index.append(state.index)
            tree.threshold.append(threshold)
            tree.branches.extend((0, 0))
            if branch >= 0:
                tree.branches[branch] = node
            for i, part in enumerate(parts):
                share = minus * (1 - probability if i else probability)
                known = decided
                if part.low == part.high and (part.sign or not part.low):
                    known = (*decided, part) if part.sign else decided
                    part = self._whole(part.index + 1)
                leaf = (share, 2 * node + i, part, known, 2 * node + i)
                if part.index == self.size:
                    done.append(leaf)
                else:
                    heapq.heappush(heap, leaf)
        for i, (_, _, state, decided, branch) in enumerate(
            sorted(heap + done, key=lambda x: x[1])
        ):
            tree.branches[branch] = -1 - i
            tree.after.append(state)
            tree.decided.append(decided)
        self._trees[root] = tree
        return tree
