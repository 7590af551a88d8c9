"""Is there an OpenGL backend that MuJoCo can render with, and if not, what installs one?

As a command (``python -m robo_manip_baselines.envs.mujoco.cell.opengl [--install]``) it prints
one line: what was found, or what to run. ``--install`` runs that line at once when the user is
root. It needs MuJoCo and the standard library only, so that it also works as a plain script,
before this package is installed.
"""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import traceback
from collections.abc import Sequence

# What Debian and Ubuntu call the libraries that each backend of MuJoCo opens; found by installing
# them one by one on a minimal Debian 12. ``libgl1-mesa-dri`` brings the software renderer, which a
# vendor's driver takes precedence over.
APT_PACKAGES: dict[str, tuple[str, ...]] = {
    "egl": ("libegl1", "libgl1", "libgl1-mesa-dri"),
    "osmesa": ("libosmesa6",),
    "glfw": ("libgl1", "libgl1-mesa-dri"),
}
DEVICE = "MUJOCO_EGL_DEVICE_ID"
"""Environment variable from which MuJoCo takes the number of the EGL device."""
PROBE_TIMEOUT = 120.0  # seconds; a cold start of software rendering takes about two

# Draws a red ball, off screen, in a process of its own: a backend is chosen once per process, and
# a driver may crash.
_PROBE = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='1' rgba='1 0 0 1'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = mujoco.Renderer(model, 32, 32)
renderer.update_scene(data)
if not renderer.render().any():
    raise RuntimeError("the rendered image is black")
from OpenGL import GL
print("renderer:", GL.glGetString(GL.GL_RENDERER).decode())
renderer.close()
"""


def backend_in_use() -> str:
    """Return the backend that rendering will use: ``$MUJOCO_GL``, else EGL."""
    return os.environ.get("MUJOCO_GL", "").strip().lower() or "egl"


def viewer_problem() -> str | None:
    """Return None if MuJoCo's viewer can open a window, else why not.

    The answer is found by opening the display in a subprocess.
    """
    is_linux = sys.platform == "linux"
    if is_linux and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return "no display ($DISPLAY is not set)"
    command = [sys.executable, "-c", "import glfw; raise SystemExit(not glfw.init())"]
    try:
        probe = subprocess.run(command, capture_output=True, timeout=PROBE_TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return f"the display did not answer within {PROBE_TIMEOUT:.0f} s"
    return None if probe.returncode == 0 else "no window can be opened on the display"


def require_viewer(option: str = "--view") -> None:
    """Require that MuJoCo's viewer can open a window.

    Raises:
        RequestError: it cannot, and why.
    """
    from robo_manip_baselines.runs.errors import RequestError  # this file is also a script

    if problem := viewer_problem():
        raise RequestError(
            f"{option}: {problem}; leave it out, or write a video (--video, or the preview)"
        )


def apt_line(backend: str) -> str:
    """Return the command that installs ``backend`` on Debian and Ubuntu."""
    sudo = "" if os.geteuid() == 0 else "sudo "
    packages = " ".join(APT_PACKAGES[backend])
    return f"{sudo}apt-get update && {sudo}apt-get install -y --no-install-recommends {packages}"


@functools.lru_cache(maxsize=1)
def opengl_problem() -> str | None:
    """Return None if an image can be rendered, else one line that says why not and what to do.

    The answer is found by rendering in a subprocess (a second or two), once per process.
    """
    return _probe(backend_in_use())[1]


def backend_problem(error: Exception) -> str | None:
    """Return why MuJoCo could not be imported with ``$MUJOCO_GL``, if that is what ``error`` is."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    modules = {frame.f_globals.get("__name__", "") for frame in frames}
    if "mujoco" in sys.modules or not any(name.split(".")[0] == "mujoco" for name in modules):
        return None
    problem = opengl_problem()
    return problem and f"{problem} (or unset MUJOCO_GL: --cameras none --preview 0 needs no OpenGL)"


def _probe(backend: str) -> tuple[str, str | None]:
    """Render with ``backend`` and return the renderer's name and the problem, if there is one."""
    if backend not in APT_PACKAGES:
        return "", f"MUJOCO_GL={backend} renders nothing; valid: {', '.join(APT_PACKAGES)}"
    environment = os.environ | {"MUJOCO_GL": backend}
    command = [sys.executable, "-c", _PROBE]
    try:
        probe = subprocess.run(
            command,
            env=environment,
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return "", f"OpenGL ({backend}) gave no image within {PROBE_TIMEOUT:.0f} s"
    renderer = probe.stdout.partition("renderer:")[2].strip()
    if probe.returncode == 0 and renderer:
        return renderer, None
    reason = (probe.stderr.strip().splitlines() or [f"exit code {probe.returncode}"])[-1]
    if "No module named 'mujoco'" in reason:
        return "", f"MuJoCo is not installed for {sys.executable}; run: pip install mujoco"
    return "", explain_failure(backend, reason)


def explain_failure(backend: str, reason: str) -> str:
    """Return one line with the cause of a failure to render and what to do.

    A wrong environment variable is distinguished from a missing library, which alone is to be
    installed.

    Args:
        backend: key of ``APT_PACKAGES``.
        reason: last line of the backend's own error.
    """
    platform = os.environ.get("PYOPENGL_PLATFORM", "")
    if platform and platform.lower() != backend:
        return f"PYOPENGL_PLATFORM={platform}: does not go with MUJOCO_GL={backend}; unset it"
    if backend == "glfw" and not os.environ.get("DISPLAY"):
        return "MUJOCO_GL=glfw needs a display and $DISPLAY is not set; use MUJOCO_GL=egl"
    given = os.environ.get(DEVICE)
    if backend == "egl" and given is not None and (count := _count_egl_devices()):
        choices = "0" if count == 1 else f"0 to {count - 1}"
        there = f"there {'is' if count == 1 else 'are'} {count}, valid: {choices}, or unset it"
        try:
            number = int(given)
        except ValueError:
            return f"{DEVICE}='{given}': must be the number of an EGL device; {there}"
        if not 0 <= number < count:
            return f"{DEVICE}={given}: there is no such EGL device; {there}"
        return f"{DEVICE}={given}: this EGL device cannot draw [{reason}]; {there}"
    return f"no OpenGL backend '{backend}' [{reason}]; run: {apt_line(backend)}"


def _count_egl_devices() -> int:
    """Return how many devices EGL lists; 0 where there is no EGL."""
    environment = {k: v for k, v in os.environ.items() if k != DEVICE} | {"MUJOCO_GL": "egl"}
    code = "from mujoco.egl import egl_ext; print(len(egl_ext.eglQueryDevicesEXT()))"
    try:
        answer = subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT,
            check=True,
        )
        return int(answer.stdout)
    except (subprocess.SubprocessError, ValueError):
        return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Print what was found or what to do; with ``--install``, do it. Return the exit code."""
    options = list(sys.argv[1:] if arguments is None else arguments)
    if unknown := [option for option in options if option != "--install"]:
        print(f"unknown option '{unknown[0]}'; valid: --install", file=sys.stderr)
        return 2
    backend = backend_in_use()
    renderer, problem = _probe(backend)
    can_install = backend in APT_PACKAGES and os.geteuid() == 0 and shutil.which("apt-get")
    if problem and "apt-get" in problem and "--install" in options and can_install:
        print(f"OpenGL: {problem}", flush=True)
        subprocess.run(["bash", "-c", apt_line(backend)], check=False, stdin=subprocess.DEVNULL)
        renderer, problem = _probe(backend)
    if problem:
        print(f"OpenGL: {problem}", file=sys.stderr)
        return 2
    print(f"OpenGL: {backend} works ({renderer})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
