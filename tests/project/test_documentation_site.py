"""The site of the documentation: its navigation and generated pages. `make docs` builds it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def documentation(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script(".ci/documentation.py")


def test_sections_are_bold_lines_and_pages_their_links(documentation: ModuleType) -> None:
    text = """Start with the [README](../README.md).

**To do this**

1. [First](first.md): one
2. a [second](second.md#part), see [first](first.md)

**To do that**

- [Third](there/README.md)
"""
    assert documentation.read_sections(text) == {
        "To do this": ["first.md", "second.md"],
        "To do that": ["there/README.md"],
    }


def test_every_page_is_in_the_navigation(documentation: ModuleType, repository: Path) -> None:
    docs = repository / "docs"
    sections = documentation.read_sections((docs / "README.md").read_text(encoding="utf-8"))
    listed = {page for pages in sections.values() for page in pages}
    assert {path.name for path in docs.glob("*.md")} - {"README.md"} <= listed


def test_the_reference_has_every_command(documentation: ModuleType) -> None:
    page = documentation.commands_page()
    for title in (
        "## bin/Rollout.py",
        "### bin/Train.py Act",
        "### bin/Dataset.py verify",
        "### bin/Dataset.py export",
        "### bin/Dataset.py import",
        "### bin/Benchmark.py foresight",
        "### face-prediction export-stats",
    ):
        assert f"{title}\n" in page
    assert "--horizon" in page
    assert "usage: bin/Replay.py" in page
    assert "pytest" not in page
