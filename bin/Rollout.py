"""Let an expert act in an environment and record its episodes."""

from robo_manip_baselines.command import parse, run_command
from robo_manip_baselines.expert.rollout_command import EXAMPLE, RolloutOptions, rollout


def main() -> None:
    """Read the command line and roll out."""
    rollout(parse(RolloutOptions, EXAMPLE))


if __name__ == "__main__":
    run_command(main)
