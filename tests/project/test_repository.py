"""Rules for files in the repository and for the form of code."""

from __future__ import annotations

import ast
import re
from pathlib import Path

PACKAGES = ("robo_manip_baselines", "face_prediction")
MAX_FILE_BYTES = 2_000_000  # data beyond that belongs in a release, not in everybody's clone
MAX_SCRIPT_LINES = 40
# Footage and photographs of people, and other people's model files, are not ours to publish.
FOOTAGE = {".mp4", ".mov", ".avi", ".mkv", ".webm", ".gif", ".jpg", ".jpeg", ".heic", ".webp"}
OURS = {
    # docs/predictors.md says of whom
    "face_prediction/assets/residual/model.safetensors",
    "face_prediction/assets/residual/baselines.safetensors",
    *(  # docs/training.md says of what
        f"robo_manip_baselines/policy/shipped/{name}/model.safetensors"
        for name in ("baseline", "current", "forecast")
    ),
    # renderings of the simulator, by the programs beside them
    "docs/images/suite.webp",
    "docs/images/dataset_view.webp",
}
MODELS = {".task", ".tflite", ".pt", ".pth", ".onnx", ".safetensors"}


def imported_modules(source: Path) -> set[str]:
    """Return the absolute names that a module imports, at any depth of its code."""
    tree = ast.parse(source.read_text(encoding="utf-8"))
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return names


def python_files(project_files: list[Path], *folders: str) -> list[Path]:
    files = [f for f in project_files if f.suffix == ".py" and f.parts[0] in folders]
    assert files, f"no Python file below {folders}"
    return files


def test_no_file_is_too_large_for_git(repository: Path, project_files: list[Path]) -> None:
    sizes = {str(f): (repository / f).stat().st_size for f in project_files}
    assert {f: size for f, size in sizes.items() if size > MAX_FILE_BYTES} == {}


def test_no_footage_and_no_models(project_files: list[Path]) -> None:
    found = {str(f) for f in project_files if f.suffix.lower() in FOOTAGE | MODELS}
    assert found - OURS == set()


def test_scripts_are_thin(repository: Path, project_files: list[Path]) -> None:
    lines = {
        str(f): len((repository / f).read_text(encoding="utf-8").splitlines())
        for f in python_files(project_files, "bin")
    }
    assert {f: n for f, n in lines.items() if n > MAX_SCRIPT_LINES} == {}


def test_modules_live_with_what_they_are_about(project_files: list[Path]) -> None:
    vague = {"utils", "util", "common", "helpers", "misc"}
    assert [str(f) for f in project_files if vague & {*f.parts[:-1], f.stem}] == []


def test_nothing_is_pickled(repository: Path, project_files: list[Path]) -> None:
    pickles = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve"}
    for f in python_files(project_files, *PACKAGES, "bin"):
        assert not pickles & imported_modules(repository / f), f
        source = (repository / f).read_text(encoding="utf-8")
        assert "allow_pickle=True" not in source, f
        calls = re.findall(r"np\.load\([^\n]*", source)
        assert all("allow_pickle=False" in call for call in calls), (f, calls)


def test_randomness_is_explicit(repository: Path, project_files: list[Path]) -> None:
    """No draw from NumPy's global generator, and none from the standard library's."""
    for f in python_files(project_files, *PACKAGES):
        source = (repository / f).read_text(encoding="utf-8")
        assert not re.search(
            r"np\.random\.(?!Generator|default_rng|SeedSequence|PCG64)\w", source
        ), f
        assert "random" not in imported_modules(repository / f), f


def test_licence_is_apache_2(repository: Path) -> None:
    text = (repository / "LICENSE").read_text(encoding="utf-8")
    assert "Apache License" in text
    assert "Version 2.0, January 2004" in text
    assert "END OF TERMS AND CONDITIONS" in text
