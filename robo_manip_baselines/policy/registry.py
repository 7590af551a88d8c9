"""Which policies there are. Adding one is a folder and a line here.

Importing this module imports no network: classes are named, and loaded when they are asked for.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from robo_manip_baselines.runs.errors import require_choice

if TYPE_CHECKING:
    from robo_manip_baselines.policy.interface import PolicyModel
    from robo_manip_baselines.policy.presets import Sizes


@dataclass(frozen=True)
class PolicyEntry:
    """Where the parts of a policy are.

    Attributes:
        config: ``module:class`` of its frozen dataclass of settings.
        model: ``module:class`` of its ``PolicyModel``, made as ``Model(config, sizes)``.
        presets: ``module:name`` of a dict: preset -> ``PolicyPreset``.
    """

    config: str
    model: str
    presets: str


POLICIES: dict[str, PolicyEntry] = {
    "Act": PolicyEntry(
        "robo_manip_baselines.policy.act.config:ActConfig",
        "robo_manip_baselines.policy.act.model:ActModel",
        "robo_manip_baselines.policy.act.config:PRESETS",
    ),
    "Mlp": PolicyEntry(
        "robo_manip_baselines.policy.mlp.config:MlpConfig",
        "robo_manip_baselines.policy.mlp.model:MlpModel",
        "robo_manip_baselines.policy.mlp.config:PRESETS",
    ),
}


def policy_entry(name: str) -> PolicyEntry:
    """Return the entry of a policy.

    Raises:
        RequestError: there is no such policy.
    """
    return POLICIES[require_choice("policy", name, POLICIES)]


def load_part(reference: str) -> Any:
    """Import what ``module:name`` refers to."""
    module, _, name = reference.partition(":")
    return getattr(import_module(module), name)


def make_model(name: str, config: Any, sizes: Sizes) -> PolicyModel:
    """Build the network of a policy, freshly initialised.

    Raises:
        RequestError: there is no such policy, or its settings do not fit the sizes.
    """
    return load_part(policy_entry(name).model)(config, sizes)
