"""Evaluate fitted movement primitives or an image Jacobian on held-out demonstrations.

The same as `hrc evaluate`.
"""

from hrc_learn import cli

if __name__ == "__main__":
    cli.main("evaluate")
