"""Which readings of a fast stream are shown."""

from __future__ import annotations

import numpy as np


class Thinning:
    """Lets the newest reading of each period pass.

    period : [ns] in the time of the stamps; a little less counts, or the jitter of the stamps
        would leave every other one out of a stream that is just as slow
    """

    def __init__(self, period: float) -> None:
        self._period = max(1, int(0.99 * period))
        self._due = 0

    def rows(self, stamps: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Rows of a block that are shown.

        stamps : (n,) ascending [ns]; valid : (n,) which rows can be
        """
        rows = np.flatnonzero(valid & (stamps >= self._due))
        if len(rows):
            slot = (stamps[rows] - max(self._due, int(stamps[rows[0]]))) // self._period
            rows = rows[np.append(slot[1:] != slot[:-1], True)]
            self._due = int(stamps[rows[-1]]) + self._period
        return rows
