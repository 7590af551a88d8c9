"""Registry of policies: those of this package, and those that other packages register.

A policy of this package is a folder beside this module and a line of ``POLICIES``. Another package
registers one by an entry point of the group ``robo_manip_baselines.policies``: its name is the
policy's name, its value the place of a `PolicyEntry` (``"my_package.policy:ENTRY"``).

Importing this module imports no network: classes are named, and loaded when they are needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import entry_points
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.memory import free_memory

if TYPE_CHECKING:
    from robo_manip_baselines.policy.interface import PolicyModel
    from robo_manip_baselines.policy.presets import PolicyDims, PolicyPreset

ENTRY_POINT_GROUP = "robo_manip_baselines.policies"


@dataclass(frozen=True)
class PolicyEntry:
    """Places of the parts of a policy.

    Attributes:
        config: ``module:class`` of its frozen dataclass of settings.
        model: ``module:class`` of its ``PolicyModel``, built as ``Model(config, dims)``.
        presets: ``module:name`` of a dict: preset -> ``PolicyPreset``, the first of which is the
            default where none fits the machine.
        normalization: of its states and actions: ``mean_std``, ``min_max`` (to [-1, 1]),
            ``action_min_max`` (that of actions alone), ``none``, or ``module:function`` of its own;
            see `data.normalization`. Training's option ``norm`` goes before it.
    """

    config: str
    model: str
    presets: str
    normalization: str = "mean_std"


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
    "Sarnn": PolicyEntry(
        "robo_manip_baselines.policy.sarnn.config:SarnnConfig",
        "robo_manip_baselines.policy.sarnn.model:SarnnModel",
        "robo_manip_baselines.policy.sarnn.config:PRESETS",
    ),
    "Diffusion": PolicyEntry(
        "robo_manip_baselines.policy.diffusion.config:DiffusionConfig",
        "robo_manip_baselines.policy.diffusion.model:DiffusionModel",
        "robo_manip_baselines.policy.diffusion.config:PRESETS",
        normalization="action_min_max",
    ),
    "Flow": PolicyEntry(
        "robo_manip_baselines.policy.flow.config:FlowConfig",
        "robo_manip_baselines.policy.flow.model:FlowModel",
        "robo_manip_baselines.policy.flow.config:PRESETS",
        normalization="action_min_max",
    ),
}


def policy_names() -> list[str]:
    """Return the names of all policies, those of this package first."""
    others = entry_points(group=ENTRY_POINT_GROUP).names
    return [*POLICIES, *sorted(others - POLICIES.keys())]


def policy_entry(name: str) -> PolicyEntry:
    """Return the entry of a policy, importing the package that registers it if need be.

    Raises:
        RequestError: there is no such policy, or its entry point refers to something else.
    """
    if name in POLICIES:  # at once: looking for other packages takes 10 ms
        return POLICIES[name]
    require_choice("policy", name, policy_names())
    (point, *_) = entry_points(group=ENTRY_POINT_GROUP, name=name)
    try:
        entry = point.load()
    except (ImportError, AttributeError) as error:
        raise RequestError(f"policy '{name}': cannot load '{point.value}': {error}") from error
    if not isinstance(entry, PolicyEntry):
        raise RequestError(f"policy '{name}': '{point.value}' is no PolicyEntry")
    return entry


def policy_presets(name: str) -> dict[str, PolicyPreset]:
    """Return the presets of a policy by name.

    Raises:
        RequestError: there is no such policy.
    """
    return resolve_name(policy_entry(name).presets)


def make_model(name: str, config: Any, dims: PolicyDims) -> PolicyModel:
    """Build the network of a policy, freshly initialised.

    Raises:
        RequestError: there is no such policy, its settings do not fit the dimensions, or the
            network does not fit into memory.
    """
    require_memory(name, config, dims)
    return resolve_name(policy_entry(name).model)(config, dims)


def require_memory(name: str, config: Any, dims: PolicyDims, copies: int = 1) -> None:
    """Require the weights of a network to fit into free memory, before they are made.

    Args:
        name: of the policy.
        config: its settings; their ``num_parameters`` is asked, where they have it.
        dims: of its inputs and outputs.
        copies: of each weight; training holds the gradient and two moments, too.

    Raises:
        RequestError: they do not fit.
    """
    if not hasattr(config, "num_parameters"):
        return
    parameters, there = config.num_parameters(dims), free_memory()
    needed = 4 * copies * parameters
    if needed > there:
        raise RequestError(
            f"a network of {parameters:,} parameters needs {needed / 2**30:.1f} GiB, and "
            f"{there / 2**30:.1f} GiB are free; choose smaller sizes of {name}, such as hidden_size"
        )
