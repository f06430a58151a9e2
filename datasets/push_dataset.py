"""Check a LeRobot dataset and bring it to the Hugging Face Hub, with a card.

The same as `hrc push`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("push")
