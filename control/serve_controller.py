"""Run the controller at a fixed rate on the simulated arm, and report how fast it answers.

The same as `hrc serve`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("serve")
