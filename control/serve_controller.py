"""Run the controller at a fixed rate, and report its latency.

The same as `hrc serve`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("serve")
