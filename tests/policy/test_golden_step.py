"""One training step gives the numbers that were committed: a change of them is meant, or a bug."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.long

# The step is fp32: another processor or number of threads adds in another order, and AdamW's first
# step, lr * sign(gradient), turns the few gradients around that are rounding alone. One and two
# threads and three instruction sets (SSE, AVX2, AVX-512) were within 5e-5 of one another.
TOLERANCE = 3e-4


def numbers(tree: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """A nested dict as one, the keys joined."""
    flat: dict[str, float] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        flat |= numbers(value, f"{name}/") if isinstance(value, dict) else {name: value}
    return flat


@pytest.mark.parametrize("step", ["default", "paper_compat", "small_vision", "mlp", "sarnn"])
def test_a_training_step(repository: Path, step: str) -> None:
    golden = runpy.run_path(str(repository / "tests" / "golden" / "regenerate.py"))
    if step in ("mlp", "sarnn"):
        file = golden[f"{step.upper()}_STEP"]
        expected, found = json.loads(file.read_text()), golden[f"{step}_step"]()
    else:
        expected = json.loads(golden["ACT_STEP"].read_text())[step]
        found = golden["act_step"](step)
    expected, found = numbers(expected), numbers(found)
    assert found.keys() == expected.keys()
    assert found == pytest.approx(expected, rel=TOLERANCE)


@pytest.mark.parametrize(
    "name", ["diffusion unet", "flow unet", "flow transformer", "flow perceptron"]
)
def test_a_training_step_of_noise(repository: Path, name: str) -> None:
    golden = runpy.run_path(str(repository / "tests" / "golden" / "regenerate.py"))
    expected = numbers(json.loads(golden["DENOISING_STEP"].read_text())[name])
    found = numbers(golden["denoising_step"](*name.split()))
    assert found.keys() == expected.keys()
    assert found == pytest.approx(expected, rel=TOLERANCE)
