"""Train a policy on recorded episodes."""

from robo_manip_baselines.commands import run

if __name__ == "__main__":
    run("train")
