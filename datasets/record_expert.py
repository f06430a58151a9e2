"""Record the scripted expert on LeRobot's simulated Panda, in simulated time.

The same as `hrc record expert`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("record", "expert")
