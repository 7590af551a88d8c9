"""Act recorded episodes out again and compare them with what was recorded."""

from robo_manip_baselines.runs.command import parse, run_command


def main() -> int:
    """Read the command line and replay."""
    # Imported here, so that run_command can say what is wrong if MuJoCo's backend is missing.
    from robo_manip_baselines.commands.replay import (
        EXAMPLE,
        ReplayOptions,
        replay_command,
    )

    return replay_command(parse(ReplayOptions, EXAMPLE))


if __name__ == "__main__":
    run_command(main)
