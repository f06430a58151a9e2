"""Commands that are told to end."""

import signal
import subprocess
import sys

import pytest

PROGRAM = """
import signal, sys, time
from hrc_learn.cli._run import status_of

# As at a terminal: shells start jobs in the background deaf to it.
signal.signal(signal.SIGINT, signal.default_int_handler)

def work():
    try:
        print("at work", flush=True)
        time.sleep(60)
    finally:
        print("tidied up", flush=True)

sys.exit(status_of(work))
"""


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 1)])
def test_a_signal_ends_a_command_by_way_of_its_finally(number, status):
    command = [sys.executable, "-c", PROGRAM]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout.readline() == "at work\n"
        program.send_signal(number)
        assert program.stdout.read() == "tidied up\n"
        assert program.wait(60) == status


def test_a_second_sigterm_does_not_wait():
    slow = PROGRAM.replace('print("tidied up", flush=True)', 'print("x", flush=True), work()')
    command = [sys.executable, "-c", slow]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout.readline() == "at work\n"
        program.send_signal(signal.SIGTERM)
        assert program.stdout.readline() == "x\n"
        program.send_signal(signal.SIGTERM)
        assert program.wait(60) == -signal.SIGTERM


@pytest.mark.parametrize("lines", [2, 100_000])
def test_a_closed_output_ends_a_command_quietly(lines):
    loud = PROGRAM.replace("time.sleep(60)", f'time.sleep(0.5), print("x\\n" * {lines})')
    loud = loud.replace('print("tidied up", flush=True)', "pass")
    command = [sys.executable, "-c", loud]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **streams) as program:
        assert program.stdout.readline() == "at work\n"
        program.stdout.close()
        assert program.stderr.read() == ""
        assert program.wait(60) == 1
