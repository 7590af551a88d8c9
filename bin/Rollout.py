"""Record demonstrations of a scripted expert, or evaluate a trained policy."""

from robo_manip_baselines.commands import run

if __name__ == "__main__":
    run("rollout")
