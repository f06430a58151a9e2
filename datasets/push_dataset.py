"""Check a LeRobot dataset and upload it to the Hugging Face Hub with a dataset card.

The same as `hrc push`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("push")
