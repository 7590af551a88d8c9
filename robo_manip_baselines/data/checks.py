"""Whether arrays are what the table says: shapes, sizes that agree, values that make sense."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from robo_manip_baselines.data.schema import ALLOWED_SIZES, FIELDS, Field, shape_text

# A quaternion that went through float32 somewhere is off by a few 1e-7; a wrong one by far more.
QUATERNION_TOLERANCE = 1e-5


def shape_problems(shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Compare the shapes of all fields present with the table and with one another."""
    problems: list[str] = []
    sizes: dict[str, tuple[int, str]] = {}  # symbol -> (size, field that set it)
    for field in FIELDS:
        shape = shapes.get(field.name)
        if shape is None:
            continue
        if len(shape) != len(field.shape):
            problems.append(f"'{field.name}' has shape {shape}, not {shape_text(field)}")
            continue
        for size, expected in zip(shape, field.shape, strict=True):
            if isinstance(expected, int):
                if size != expected:
                    problems.append(f"'{field.name}' has shape {shape}, not {shape_text(field)}")
                continue
            known, owner = sizes.setdefault(expected, (size, field.name))
            if size != known:
                problems.append(
                    f"'{field.name}' has {expected}={size} where '{owner}' has {expected}={known}"
                )
    for symbol, (size, owner) in sizes.items():
        allowed = ALLOWED_SIZES.get(symbol)
        if size < 1 or (allowed and size not in allowed):
            valid = " or ".join(map(str, allowed)) if allowed else "at least 1"
            problems.append(f"'{owner}' has {symbol}={size}, not {valid}")
    return problems


def value_problems(field: Field, values: np.ndarray, num_phases: int | None) -> list[str]:
    """Check the numbers of one field: finite, and obeying the field's rule.

    Args:
        field: what the array should be.
        values: the field's array, already known to have its shape.
        num_phases: length of ``phase_names``; None leaves that rule out.
    """
    name = field.name
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.argwhere(~finite)[0][0])
        return [f"'{name}' is NaN or infinite, first at step {row}"]
    if field.rule == "increasing":
        steps = np.flatnonzero(np.diff(values) <= 0)
        return [f"'{name}' does not increase at step {int(steps[0]) + 1}"] if steps.size else []
    if field.rule == "unit quaternion":
        error = np.abs(np.linalg.norm(values[:, -4:], axis=1) - 1)
        bad = np.flatnonzero(error > QUATERNION_TOLERANCE)
        return [f"'{name}' is no unit quaternion at step {int(bad[0])}"] if bad.size else []
    if field.rule == "not negative":
        bad = np.flatnonzero(values < 0)
        return [f"'{name}' is negative at step {int(bad[0])}"] if bad.size else []
    if field.rule == "phase index" and num_phases is not None:
        bad = np.flatnonzero((values < 0) | (values >= num_phases))
        if bad.size:
            row = int(bad[0])
            return [f"'{name}' is {int(values[row])} at step {row}, of {num_phases} phases"]
    return []
