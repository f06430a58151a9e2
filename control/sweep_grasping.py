"""Thousands of simulated grasps as batches: how often, how fast and how safely.

The same as `hrc sweep`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("sweep")
