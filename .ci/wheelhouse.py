"""Download every wheel that an install on Linux x86-64 without network needs, and write how to.

The pins of constraints.txt are complete, so no resolver is asked: their markers are evaluated for
the Python of the other machine, which pip itself would do for the one that runs here.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
# with an underscore, pip before 23.3 does not find the extra
EXTRAS = "face-prediction,formats,ray,rl,train,dev"
SOURCES = {"easyhid"}  # of Python alone, released without a wheel: one is built here
SUPPORTED = ("3.10", "3.11", "3.12", "3.13")
# The oldest and newest C library of the machines it is for: 2.28 is that of RHEL 8; Debian 10 and
# Ubuntu 20.04 are newer still. A wheel may be tagged with any version up to it.
PLATFORMS = [
    *(f"manylinux_2_{minor}_x86_64" for minor in range(28, 4, -1)),
    *(f"manylinux{year}_x86_64" for year in ("2014", "2010", "1")),
    "linux_x86_64",
]
README = """\
{count} wheels for CPython {python} on Linux x86-64, glibc 2.28 or newer. To install them without
network, in this folder and in an environment of your own:

  python{python} -m pip install {options}

Unless torch-*.whl is here, torch is taken to be on the machine already.
"""


def pins(python: str, with_torch: bool) -> list[str]:
    """Return ``name==version`` for each package of constraints.txt that ``python`` needs."""
    environment = {"python_version": python, "python_full_version": f"{python}.0"}
    environment |= {"sys_platform": "linux", "platform_machine": "x86_64"}
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    requirements = [Requirement(line) for line in lines if line and not line.startswith("#")]
    return [
        f"{requirement.name}{requirement.specifier}"
        for requirement in requirements
        if (requirement.marker is None or requirement.marker.evaluate(environment))
        and (canonicalize_name(requirement.name) != "torch" or with_torch)
    ]


def run(*arguments: str) -> None:
    """Run this Python; a failure ends this program with what the command printed and its code."""
    result = subprocess.run(
        [sys.executable, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False
    )
    if result.returncode:
        sys.stderr.write(result.stdout.decode(errors="replace"))
        sys.exit(result.returncode)


def main() -> None:
    """Fill ``wheelhouse/cp3XX``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", default="3.12", metavar="3.X")
    parser.add_argument("--with_torch", action="store_true", help="several GB with its CUDA wheels")
    arguments = parser.parse_args()
    python = arguments.python.rpartition("python")[2]
    if python not in SUPPORTED:
        parser.error(f"unknown PYTHON '{arguments.python}'; valid: {', '.join(SUPPORTED)}")

    tag = "cp" + python.replace(".", "")
    folder = ROOT / "wheelhouse" / tag
    folder.mkdir(parents=True, exist_ok=True)
    target = ["--only-binary=:all:", "--implementation=cp", f"--python-version={python}"]
    target += [f"--abi={abi}" for abi in (tag, "abi3", "none")]
    target += [f"--platform={platform}" for platform in PLATFORMS]
    download = ["-m", "pip", "download", f"--dest={folder}", *target]
    chosen = {pin: pin.partition("==")[0] in SOURCES for pin in pins(python, with_torch=False)}
    run(*download, "--no-deps", *(pin for pin, is_source in chosen.items() if not is_source))
    built_here = [pin for pin, is_source in chosen.items() if is_source]
    run("-m", "pip", "wheel", f"--wheel-dir={folder}", "--no-deps", *built_here)
    if arguments.with_torch:  # what torch needs differs by its build, so here a resolver is asked
        torch = [pin for pin in pins(python, with_torch=True) if pin.startswith("torch==")]
        run(*download, f"--find-links={folder}", *torch)
    for stale in folder.glob("robo_manip_baselines-*.whl"):
        stale.unlink()
    with tempfile.TemporaryDirectory() as built:  # by way of an sdist: no stale build/ gets in
        run("-m", "build", "--outdir", built, str(ROOT))
        (wheel,) = Path(built).glob("*.whl")
        shutil.copy(wheel, folder)

    wheels = sorted(folder.glob("*.whl"))
    options = f"--no-index --find-links . 'robo_manip_baselines[{EXTRAS}]'"
    (folder / "README.txt").write_text(
        README.format(count=len(wheels), python=python, options=options), encoding="utf-8"
    )
    size = sum(wheel.stat().st_size for wheel in wheels) / 1e6
    print(f"{folder.relative_to(ROOT)}: {len(wheels)} wheels, {size:.0f} MB.")
    print("Copy that folder to the machine; there, in it and in an environment of your own:")
    print(f"  python{python} -m pip install {options}")


if __name__ == "__main__":
    main()
