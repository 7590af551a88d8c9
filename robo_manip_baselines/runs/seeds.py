"""Seeds of named streams, all from the one seed of a run."""

from __future__ import annotations

import numpy as np


def derive_seed(seed: int, stream: str, *numbers: int) -> int:
    """Return a seed, 0 to 2**63 - 1, that belongs to a named stream and to numbers such as a step.

    Args:
        seed: of the run, 0 or more.
        stream: what the randomness is for.
        numbers: 0 or more each.
    """
    words = np.random.SeedSequence([seed, *stream.encode(), *numbers])
    return int(words.generate_state(1, np.uint64)[0] >> np.uint64(1))
