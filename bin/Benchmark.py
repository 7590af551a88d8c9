"""Train and evaluate every condition of a benchmark, then write tables and a report."""

from robo_manip_baselines.commands import run

if __name__ == "__main__":
    run("benchmark")
