"""Inspect, verify, draw, compare, merge and split episodes."""

from robo_manip_baselines.commands import run

if __name__ == "__main__":
    run("dataset")
