"""The folder of a training run: whose it is, how far it has come, what is kept."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml

from robo_manip_baselines.data.files import atomic_file, prepare_folder
from robo_manip_baselines.runs.checkpoints import list_checkpoints
from robo_manip_baselines.runs.errors import RequestError

CONFIG = "config.yaml"
METRICS = "metrics.jsonl"
CURVES = "curves.png"
KEPT_CHECKPOINTS = 2


@contextmanager
def locked(run: Path) -> Iterator[None]:
    """Hold the folder for one training process; a killed process holds nothing.

    Raises:
        RequestError: another process holds it, or it cannot be written to.
    """
    prepare_folder(run)
    descriptor = os.open(run / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise RequestError(
                f"'{run}' is being written by another training process; choose another --out"
            ) from error
        yield
    finally:
        os.close(descriptor)


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


def prune(run: Path) -> None:
    """Keep the newest checkpoints only."""
    for _, folder in list_checkpoints(run)[:-KEPT_CHECKPOINTS]:
        # Renamed first: a process that is killed here leaves no checkpoint with files missing.
        leaving = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
        folder.rename(leaving)
        shutil.rmtree(leaving, ignore_errors=True)


def start_anew(run: Path) -> None:
    """Remove what a run left that had saved no checkpoint."""
    (run / METRICS).unlink(missing_ok=True)
    shutil.rmtree(run / "tensorboard", ignore_errors=True)


def _show(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else str(value)
