"""Train a policy on recorded episodes."""

import sys

from robo_manip_baselines.runs.command import run_command


def main() -> int:
    """Read the command line and train."""
    # Imported here, so that run_command can say what is wrong if something is missing.
    from robo_manip_baselines.training.requirements import prepare_pytorch

    prepare_pytorch()
    from robo_manip_baselines.commands.train import train

    return train(sys.argv[1:])


if __name__ == "__main__":
    run_command(main)
