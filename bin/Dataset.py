"""Look at and check a folder of episodes: ``python bin/Dataset.py verify dataset/FeedingEnv``."""

from __future__ import annotations

from robo_manip_baselines.commands.dataset import Command
from robo_manip_baselines.runs.command import parse, run_command


def main() -> int:
    """Run the subcommand that was asked for."""
    options = parse(
        Command,
        example="python bin/Dataset.py verify dataset/FeedingEnv",
        description="Look at and check a folder of episodes.",
    )
    text, code = options.run()
    print(text)
    return code


if __name__ == "__main__":
    run_command(main)
