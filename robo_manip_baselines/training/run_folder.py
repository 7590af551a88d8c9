"""The folder of a training run: whose it is, how far it has come, what is kept."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

CONFIG = "config.yaml"
METRICS = "metrics.jsonl"
CURVES = "curves.png"


def read_config(path: Path) -> dict[str, Any]:
    """Read a YAML file of options.

    Raises:
        RequestError: it cannot be read, or is no mapping.
    """
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RequestError(f"cannot read '{path}': {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RequestError(f"'{path}' is no YAML: {error}") from error
    values = {} if values is None else values
    if not isinstance(values, dict):
        raise RequestError(f"'{path}' must be lines of 'option: value'")
    return {str(name): value for name, value in values.items()}


def write_config(run: Path, config: Mapping[str, Any]) -> None:
    """Write the options of a run so that ``--config`` reads them."""
    with atomic_file(run / CONFIG) as temporary:
        text = yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True)
        temporary.write_text(text, encoding="utf-8")


def require_same_config(run: Path, config: Mapping[str, Any], free: frozenset[str]) -> None:
    """Make sure that a run folder's options are the ones that are given now.

    Args:
        run: folder with a ``config.yaml``.
        config: options now.
        free: names that may differ.

    Raises:
        RequestError: naming the first option that differs.
    """
    there = read_config(run / CONFIG)
    for name in [*config, *there]:
        old, new = there.get(name), config.get(name)
        if name not in free and old != new:
            raise RequestError(
                f"'{run}' holds a run with {name} {_show(old)}, not {_show(new)}; "
                "choose another --out, or give the same options"
            )


def start_anew(run: Path) -> None:
    """Remove what a run left that had saved no checkpoint."""
    (run / METRICS).unlink(missing_ok=True)
    shutil.rmtree(run / "tensorboard", ignore_errors=True)


def _show(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
