"""Let an expert act and record demonstrations, or a trained policy and see how well it does."""

from robo_manip_baselines.runs.command import parse, run_command


def main() -> None:
    """Read the command line and roll out."""
    # Imported here, so that run_command can say what is wrong if MuJoCo's backend is missing.
    from robo_manip_baselines.commands.rollout import EXAMPLE, RolloutOptions, rollout

    rollout(parse(RolloutOptions, EXAMPLE))


if __name__ == "__main__":
    run_command(main)
