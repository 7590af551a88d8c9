"""Act recorded episodes out again and compare them with what was recorded."""

from robo_manip_baselines.command import parse, run_command
from robo_manip_baselines.evaluation.replay_command import EXAMPLE, ReplayOptions, replay_command


def main() -> int:
    """Read the command line and replay."""
    return replay_command(parse(ReplayOptions, EXAMPLE))


if __name__ == "__main__":
    run_command(main)
