"""Array types and the error that every wrong input raises."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating[Any]]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
AnyArray = NDArray[Any]
Cell = tuple[int, int]
"""Row and column; row 0 is the top row."""


class InputError(ValueError):
    """A value from outside breaks a rule.

    The message is one line: the value, the rule, what to do. The command line prints it and exits with 2.
    """
