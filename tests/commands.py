"""The command `hrc` run in the process of the tests, which has its imports already."""

import io
import sys
import warnings
from contextlib import ExitStack, redirect_stderr, redirect_stdout
from typing import NamedTuple
from unittest.mock import patch

import torch

from hrc_learn import cli


class Outcome(NamedTuple):
    """How a command ended."""

    status: object
    output: str
    error: str


def hrc(*words: object) -> Outcome:
    """Run `hrc` with these words. What commands set for the process is set back."""
    output, error = io.StringIO(), io.StringIO()
    threads, interval = torch.get_num_threads(), sys.getswitchinterval()
    status: object = None
    with ExitStack() as stack:
        stack.enter_context(patch.object(sys, "argv", ["hrc", *map(str, words)]))
        stack.enter_context(patch.object(warnings, "formatwarning", warnings.formatwarning))
        stack.enter_context(redirect_stdout(output))
        stack.enter_context(redirect_stderr(error))
        stack.callback(torch.set_num_threads, threads)
        stack.callback(sys.setswitchinterval, interval)
        try:
            cli.main()
        except SystemExit as ended:
            status = ended.code
    return Outcome(status, output.getvalue(), error.getvalue())


def done(*words: object, status: int = 0) -> Outcome:
    """The same, where the exit status is known."""
    outcome = hrc(*words)
    assert outcome.status == status, outcome.output + outcome.error
    return outcome
