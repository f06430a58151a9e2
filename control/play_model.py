"""Write the motion of a fitted model to a goal: path, joints, film and episode.

The same as `hrc play`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("play")
