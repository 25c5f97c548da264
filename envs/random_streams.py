"""Streams of random numbers, one per environment of a batch."""

from __future__ import annotations

import numba
import numpy as np

from gridnav.problem.types import FloatArray, IntArray, State


class RandomStreams:
    """One stream of uniform numbers per environment, drawn in blocks so that a batch costs no Python loop.

    Environment i sees the numbers its generator would give one by one, whatever the others do.
    """

    BLOCK = 128

    def __init__(self, generators: list[np.random.Generator]) -> None:
        self.generators = generators
        self._block = np.empty((len(generators), self.BLOCK))
        self._next = np.full(len(generators), self.BLOCK)

    def draw(self, ids: IntArray, n: int) -> FloatArray:
        """The next ``n`` numbers in [0, 1) of the given streams, shape ``(len(ids), n)``."""
        numbers = np.empty((len(ids), n))
        if not _take(ids, self._block, self._next, numbers):
            for i in ids[self._next[ids] + n > self.BLOCK]:
                unused = self._block[i, self._next[i] :]
                fresh = self.generators[i].random(self.BLOCK - unused.size)
                self._block[i] = np.concatenate([unused, fresh])
                self._next[i] = 0
            _take(ids, self._block, self._next, numbers)
        return numbers

    def state(self) -> State:
        """Everything that decides the numbers to come."""
        generators = [generator.bit_generator.state for generator in self.generators]
        return State({"block": self._block.copy(), "next": self._next.copy()}, {"generators": generators})

    def set_state(self, state: State) -> None:
        """Go on where the streams of ``state`` were; the generators stay the same objects."""
        if (state.arrays["next"] < 0).any() or (state.arrays["next"] > self.BLOCK).any():
            raise ValueError(f"a stream's next number must be one of a block of {self.BLOCK}")
        for generator, values in zip(self.generators, state.values["generators"], strict=True):
            generator.bit_generator.state = values
        self._block[:], self._next[:] = state.arrays["block"], state.arrays["next"]


@numba.njit(cache=True)
def _take(ids: IntArray, block: FloatArray, position: IntArray, numbers: FloatArray) -> bool:
    """Take numbers off the blocks, unless one of them has too few left."""
    n = numbers.shape[1]
    for i in ids:
        if position[i] + n > block.shape[1]:
            return False
    for k in range(len(ids)):
        i = ids[k]
        for j in range(n):
            numbers[k, j] = block[i, position[i] + j]
        position[i] += n
    return True
