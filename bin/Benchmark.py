"""Train and evaluate every arm of a benchmark on common seeds, then write tables and a report."""

from robo_manip_baselines.runs.command import parse, run_command


def main() -> int:
    """Read the command line and carry the benchmark out."""
    # Imported here, so that run_command can say what is wrong if something is missing.
    from robo_manip_baselines.training.requirements import prepare_pytorch

    prepare_pytorch()
    from robo_manip_baselines.commands.benchmark import EXAMPLE, BenchmarkOptions, benchmark

    return benchmark(parse(BenchmarkOptions, EXAMPLE))


if __name__ == "__main__":
    run_command(main)
