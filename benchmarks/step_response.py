"""Step response of the VX300s' servos: a 0.3 rad step of every arm joint, a grasp and a held cube.

Prints a table and draws the responses (``--plot``):

    python benchmarks/step_response.py --plot docs/images/robot_step_response.png
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.envs.mujoco.cell.scene import add_cube, build_cell
from robo_manip_baselines.envs.mujoco.cell.vx300s import FINGER_CLOSED, FINGER_OPEN, HOME_QPOS
from robo_manip_baselines.observation.spec import ARM_JOINTS
from robo_manip_baselines.runs.command import parse, run_command
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import atomic_file

EXAMPLE = "python benchmarks/step_response.py --plot step_response.png"
ARM = "right"
DURATION = 0.8  # s
BAND = 0.02  # of the step: within it, the joint has settled


@dataclass(frozen=True)
class Options:
    """Measure the step responses of the VX300s' servos.

    Attributes:
        step: size of the step, rad.
        plot: PNG to draw the responses to.
    """

    step: float = 0.3
    plot: Path | None = None

    def __post_init__(self) -> None:
        if not 0.01 <= abs(self.step) <= 0.5:
            raise RequestError(f"--step {self.step} is not valid; 0.01 to 0.5 rad, or negative")


@dataclass(frozen=True)
class Response:
    """A response to a step at time 0, at every physics step.

    Attributes:
        time: (T,) s.
        position: (T,) as a fraction of the step.
        force: (T,) of the servo, N m or N.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    force: NDArray[np.float64]

    @property
    def settling_time(self) -> float:
        """S until the response stays within `BAND` of its end."""
        outside = np.flatnonzero(np.abs(self.position - 1.0) > BAND)
        return float(self.time[outside[-1]]) if len(outside) else 0.0

    @property
    def overshoot(self) -> float:
        """Fraction of the step, 0 or more."""
        return max(0.0, float(self.position.max()) - 1.0)


def at_home(model: mujoco.MjModel, finger: float) -> mujoco.MjData:
    """Return a state at rest in the home pose, with the fingers at a position, m."""
    data = mujoco.MjData(model)
    for arm in ("left", "right"):
        for joint, angle in zip(ARM_JOINTS, HOME_QPOS, strict=True):
            data.joint(f"{arm}/{joint}").qpos = data.actuator(f"{arm}/{joint}").ctrl = angle
        data.joint(f"{arm}/left_finger").qpos = finger
        data.joint(f"{arm}/right_finger").qpos = -finger
        data.actuator(f"{arm}/gripper").ctrl = finger
    mujoco.mj_forward(model, data)
    return data


def respond(
    model: mujoco.MjModel, data: mujoco.MjData, joint: str, servo: str, target: float, end: float
) -> Response:
    """Set a servo's target and record its joint until it is at ``end``, where it will stop."""
    moving, motor = data.joint(joint), data.actuator(servo)
    start = float(moving.qpos[0])
    motor.ctrl = target
    rows = []
    for step in range(1, round(DURATION / model.opt.timestep) + 1):
        mujoco.mj_step(model, data)
        position = (moving.qpos[0] - start) / (end - start)
        rows.append((step * model.opt.timestep, position, motor.force[0]))
    return Response(*np.array(rows).T)


def step_joint(model: mujoco.MjModel, joint: str, step: float) -> Response:
    """Step one arm joint from home; the others hold."""
    goal = HOME_QPOS[ARM_JOINTS.index(joint)] + step
    name = f"{ARM}/{joint}"
    return respond(model, at_home(model, FINGER_OPEN), name, name, goal, goal)


def close_on_cube(model: mujoco.MjModel, half: float) -> Response:
    """Close the open fingers on a cube that floats between them."""
    data = at_home(model, FINGER_OPEN)
    data.joint("cube").qpos[:3] = data.site(f"{ARM}/gripper").xpos
    # Level with the gripper, which the home pose tilts by 0.1 rad about y.
    mujoco.mju_mat2Quat(data.joint("cube").qpos[3:], data.site(f"{ARM}/gripper").xmat)
    model.body_gravcomp[model.body("cube").id] = 1.0
    joint, servo = f"{ARM}/left_finger", f"{ARM}/gripper"
    return respond(model, data, joint, servo, FINGER_CLOSED, FINGER_CLOSED + half)


def plot(path: Path, responses: dict[str, Response], step: float) -> None:
    """Draw every response in a panel of its own."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 4, figsize=(13, 5.5), sharex=True, sharey=True)
    for axis, (name, response) in zip(axes.flat, responses.items(), strict=False):
        axis.axhspan(1 - BAND, 1 + BAND, color="0.85")
        axis.axvline(0.4, color="0.6", linestyle=":")
        axis.plot(response.time, response.position)
        axis.set_title(f"{name}: {1000 * response.settling_time:.0f} ms", fontsize=11)
    axes.flat[-1].axis("off")
    axes.flat[-1].text(
        0.0,
        0.5,
        f"step of {step} rad from home,\nfingers closing on the cube\n\n"
        f"grey: within {100 * BAND:.0f} %\ndotted: 0.4 s",
        va="center",
    )
    figure.supxlabel("time (s)")
    figure.supylabel("fraction of the step")
    figure.tight_layout()
    with atomic_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=80)
    pyplot.close(figure)


def main() -> None:
    """Measure, print, draw."""
    options = parse(Options, EXAMPLE)
    spec = build_cell()
    half = float(add_cube(spec).first_geom().size[1])
    model = spec.compile()
    responses = {joint: step_joint(model, joint, options.step) for joint in ARM_JOINTS}
    responses["fingers on cube"] = close_on_cube(model, half)
    print(f"{'':16s} {'settles in':>10s} {'overshoot':>10s} {'peak force':>11s}")
    for name, response in responses.items():
        unit = "N" if name.startswith("fingers") else "N m"
        print(
            f"{name:16s} {1000 * response.settling_time:7.0f} ms {100 * response.overshoot:8.1f} % "
            f"{np.abs(response.force).max():7.1f} {unit}"
        )
    if options.plot is not None:
        plot(options.plot, responses, options.step)


if __name__ == "__main__":
    run_command(main)
