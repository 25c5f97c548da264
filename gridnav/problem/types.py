"""Array types, what a checkpoint is made of, and the errors that end a command."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
AnyArray = NDArray[Any]
Cell = tuple[int, int]
"""Row and column; row 0 is the top row."""


class State(NamedTuple):
    """Part of a checkpoint: what an object needs to go on exactly where it was."""

    arrays: dict[str, AnyArray]
    """Numbers by name; in checkpoints a safetensors file."""
    values: dict[str, Any]
    """Everything else, fit for JSON."""


class InputError(ValueError):
    """A value from outside breaks a rule.

    The message is one line: the value, the rule, what to do. The command line prints it and exits with 2.
    """


class NonFiniteError(ArithmeticError):
    """A NaN or infinity came up in training, which stopped before it reached the weights.

    The message is one line: where, and in what. The command line prints it and exits with 4.
    """
