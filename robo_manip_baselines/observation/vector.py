"""All vectors of an observation as one, in the order in which the spec names them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.observation.spec import ObservationSpec


def vector_names(spec: ObservationSpec) -> list[str]:
    """Name the S elements of the vector."""
    return [name for names in spec.components().values() for name in names]


def to_vector(
    spec: ObservationSpec, observation: Mapping[str, NDArray[Any]]
) -> NDArray[np.float32]:
    """Join the vectors (..., n) of an observation to one of (..., S); images are left out."""
    return np.concatenate([observation[key] for key in spec.components()], axis=-1)
