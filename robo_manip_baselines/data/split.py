"""Which episodes are trained on and which are held out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from robo_manip_baselines.errors import RequestError


@dataclass(frozen=True)
class Split:
    """Episodes by the seed that each was recorded with, so that it names them in any folder.

    Attributes:
        train: seeds of the training episodes, ascending.
        validation: seeds of the episodes held out, ascending; perhaps none.
    """

    train: tuple[int, ...]
    validation: tuple[int, ...]

    def to_json(self) -> dict[str, list[int]]:
        """Return what `from_json` takes, made of plain lists."""
        return {"train": list(self.train), "validation": list(self.validation)}

    @classmethod
    def from_json(cls, data: Any) -> Split:
        """Undo `to_json`.

        Raises:
            RequestError: ``data`` is no split.
        """
        parts: list[tuple[int, ...]] = []
        for name in ("train", "validation"):
            seeds = data.get(name) if isinstance(data, dict) else None
            if not isinstance(seeds, list) or not all(type(seed) is int for seed in seeds):
                raise RequestError(f"a split needs '{name}', a list of seeds, not {seeds!r}")
            parts.append(tuple(seeds))
        train, validation = parts
        if not train or set(train) & set(validation):
            raise RequestError(
                "a split needs at least one training seed, and none in both of its parts"
            )
        return cls(train, validation)


def split_episodes(seeds: Iterable[int], fraction: float, seed: int) -> Split:
    """Hold out a random share of the episodes.

    The result depends on which seeds there are, not on their order.

    Args:
        seeds: of the episodes, all different.
        fraction: share to hold out, 0 or more and less than 1, rounded to whole episodes. More
            than 0 holds out at least one episode wherever one is left to train on.
        seed: of the draw.

    Raises:
        RequestError: there is no episode, a seed is there twice, or a number is out of range.
    """
    ordered = sorted(seeds)
    if not ordered:
        raise RequestError("no episode to train on; record some first")
    if len(set(ordered)) < len(ordered):
        twice = next(a for a, b in pairwise(ordered) if a == b)
        raise RequestError(f"episode seed {twice} is there twice; each may be there once")
    if not 0.0 <= fraction < 1.0:
        raise RequestError(f"validation fraction {fraction}: must be 0 or more, less than 1")
    if seed < 0:
        raise RequestError(f"seed {seed}: must be 0 or more")
    held_out = round(fraction * len(ordered))
    if fraction > 0.0:
        held_out = min(max(held_out, 1), len(ordered) - 1)
    shuffled = np.random.default_rng([seed, *b"split"]).permutation(ordered).tolist()
    return Split(tuple(sorted(shuffled[held_out:])), tuple(sorted(shuffled[:held_out])))
