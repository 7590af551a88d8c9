"""Steer the arms by hand, and record demonstrations."""

from robo_manip_baselines.commands import run

if __name__ == "__main__":
    run("teleop")
