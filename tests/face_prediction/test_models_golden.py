"""One training step of every network gives the committed numbers: a change is meant, or a bug."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import pytest

from face_prediction.models.settings import MODELS

pytestmark = pytest.mark.long

# The step is fp32: another processor or number of threads adds in another order, and Adam's first
# step, lr * sign(gradient), turns the few gradients around that are rounding alone. One and two
# threads and three instruction sets (SSE, AVX2, AVX-512) were within 3e-6 of one another.
TOLERANCE = 2e-5


@pytest.mark.parametrize("name", MODELS)
def test_a_training_step(repository: Path, name: str) -> None:
    golden: dict[str, Any] = runpy.run_path(str(repository / "tests/golden/regenerate.py"))
    expected = json.loads(golden["FACE_STEP"].read_text())[name]
    found = golden["face_step"](name)
    assert found.keys() == expected.keys()
    for part, numbers in expected.items():
        assert found[part] == pytest.approx(numbers, rel=TOLERANCE), part
