"""Seeds and generators of named streams, all derived from the one seed of a run."""

from __future__ import annotations

import numpy as np


def derive_seed(seed: int, stream: str, *numbers: int) -> int:
    """Return a seed, 0 to 2**63 - 1, of a named stream and of numbers such as a step.

    Args:
        seed: seed of the run, 0 or more.
        stream: purpose of the randomness.
        numbers: 0 or more each.
    """
    words = np.random.SeedSequence([seed, *stream.encode(), *numbers])
    return int(words.generate_state(1, np.uint64)[0] >> np.uint64(1))


def stream_generator(seed: int, stream: str, *numbers: int) -> np.random.Generator:
    """Return the NumPy generator of a named stream at ``numbers``, such as a step or an epoch."""
    return np.random.default_rng([seed, *stream.encode(), *numbers])
