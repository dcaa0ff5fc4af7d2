"""The trellis of dependent quantisation: which of two quantisers a coefficient is taken from.

The quantisers are the even and the odd multiples of half a step, 0 in both. What follows an index depends on whether it
is odd, as in JPEG 2000 part 2 and H.266; the states are those of the latter's successor.
"""

from __future__ import annotations

import numpy as np

__all__ = ["ODD", "TRANSITIONS"]

#: The state after an even and after an odd index, by the state before; every band of a tile begins in state 0.
TRANSITIONS = np.array([[0, 2], [5, 7], [1, 3], [6, 4], [2, 0], [4, 6], [3, 1], [7, 5]], np.int64)
#: Whether a coefficient is one of the odd multiples, by the state before it.
ODD = np.array([0, 1, 0, 1, 0, 1, 0, 1], np.int64)
