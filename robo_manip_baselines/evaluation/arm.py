"""Experimental arms: what a policy was trained with, what it is shown, and what that is called."""

from __future__ import annotations

from dataclasses import fields, replace

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.observation.options import CorruptionOptions
from robo_manip_baselines.policy.checkpoint import Checkpoint


def arm_name(spec: ObservationSpec) -> str:
    """Name an experimental arm: what a policy is shown, such as ``current_pred_h2_uniform``."""
    horizon = f"_h{spec.horizon}" if spec.obs == "current_pred" else ""
    corruption = f"_{spec.corruption.label}" if spec.corruption else ""
    return f"{spec.obs}{horizon}{corruption}"


def changed_name(trained: ObservationSpec, shown: ObservationSpec) -> str:
    """Name what a policy is shown otherwise than in training: ``_under_delay3``; or nothing."""
    if _without_path(trained.corruption) == _without_path(shown.corruption):
        return ""
    return f"_under_{shown.corruption.label if shown.corruption else 'truth'}"


def describe(corruption: Corruption | None) -> str:
    """Say what stands between truth and policy, as options are spelt."""
    if corruption is None:
        return "no corruption"
    changed = {
        item.name: getattr(corruption, item.name)
        for item in fields(Corruption)
        if getattr(corruption, item.name) != item.default
    }
    return ", ".join(
        f"{name} {value[:12] if name == 'stats_sha256' else value}"
        for name, value in changed.items()
    )


def choose_corruption(
    checkpoint: Checkpoint, given: CorruptionOptions, is_change: bool
) -> Corruption | None:
    """Return what stands between truth and policy: as in training, or as was typed.

    Args:
        checkpoint: says what it was in training.
        given: what was typed; ``--no_corruption`` always holds.
        is_change: whether what was typed may differ from training.

    Raises:
        RequestError: it differs and may not, or cannot be used.
    """
    trained = checkpoint.spec.corruption
    chosen = given.apply(trained)
    chosen = chosen and chosen.pinned()
    # Statistics are the same wherever their file lies: their digest is compared.
    is_same = _without_path(chosen) == _without_path(trained)
    if is_same or not given.corruption or is_change:
        return chosen
    raise RequestError(
        f"checkpoint '{checkpoint.folder}' was trained with {describe(trained)}, not with "
        f"{describe(chosen)}; leave the options as trained, or say --change_corruption to "
        "evaluate it so all the same"
    )


def _without_path(corruption: Corruption | None) -> Corruption | None:
    return corruption and replace(corruption, error_stats=None)
