"""List the registered tasks, and draw one picture of all of them."""

from robo_manip_baselines.commands import run

if __name__ == "__main__":
    run("tasks")
