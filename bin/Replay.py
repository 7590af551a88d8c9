"""Replay recorded episodes and compare every state with the recorded one."""

from robo_manip_baselines.commands import run

if __name__ == "__main__":
    run("replay")
