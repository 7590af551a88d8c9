"""Inspect and verify a folder of episodes."""

from robo_manip_baselines.commands import run

if __name__ == "__main__":
    run("dataset")
