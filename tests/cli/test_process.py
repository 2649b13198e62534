"""A process of `nerf` ends as any does, but for the time that Python takes to tear down what it has loaded."""

import os
import signal
import subprocess
import sys

import pytest
from support.running import REPOSITORY

BEGIN = """
import atexit, sys, threading, time
from nerf_lightning.cli.process import quick_end

class Loaded:
    def __del__(self):
        print("taken apart")

loaded = Loaded()
with quick_end():
    """

INTERRUPTED = """
import ctypes, signal
from nerf_lightning.cli import main as command_line, process

signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it

@command_line.explained("train")
def answer():
    {}
    print("went on")

command_line.main = answer
process.main()
"""
LIBRARY = "try: signal.raise_signal(signal.SIGINT)\n    except BaseException: {}"


def ended(block: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", BEGIN + block], cwd=REPOSITORY, capture_output=True, text=True)


@pytest.mark.parametrize(("block", "code", "told"), [("sys.exit(-2)", 254, ""), ("sys.exit('no')", 1, "no\n")])
def test_it_ends_with_its_code_or_a_word_and_takes_nothing_apart(block, code, told):
    done = ended(block)
    assert (done.returncode, done.stderr) == (code, told)
    assert "taken apart" not in done.stdout


def test_threads_and_what_is_registered_for_the_end_come_first():
    done = ended(
        "atexit.register(print, 'registered')\n"
        "    threading.Thread(target=lambda: time.sleep(0.1) or print('thread')).start()\n"
        "    print('block')"
    )
    assert (done.returncode, done.stdout.split()) == (0, ["block", "thread", "registered"])


def test_names_that_the_encoding_of_a_pipe_lacks_are_written_as_in_python():
    code = """
import subprocess, sys
from nerf_lightning.cli.process import write_any_name
from nerf_lightning.messages.console import StdoutConsole, say

write_any_name()
say("\u65b0.png")
StdoutConsole().print("\u65b0.png")
subprocess.run([sys.executable, "-c", "print('\u65b0.png')"], check=True)
"""
    env = os.environ | {"PYTHONIOENCODING": "cp1252"}
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, env=env)
    assert done.stdout.split() == [b"\\u65b0.png"] * 3, done.stderr.decode()


def test_ctrl_c_at_the_end_ends_it_at_once_and_without_a_word():
    heard = "import os, signal; signal.signal(signal.SIGINT, signal.default_int_handler)"  # not so in the background
    done = ended(f"{heard}; atexit.register(os.kill, os.getpid(), signal.SIGINT)")
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


@pytest.mark.parametrize(
    ("block", "code"),
    [
        (LIBRARY.format("raise AttributeError from None"), 130),
        (LIBRARY.format("signal.raise_signal(signal.SIGINT)"), -signal.SIGINT),
        ("ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()", -signal.SIGINT),
    ],
)
def test_ctrl_c_ends_it_whatever_a_library_makes_of_the_first_one(block, code):
    script = INTERRUPTED.format(block)
    done = subprocess.run([sys.executable, "-c", script], cwd=REPOSITORY, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (code, "", "")


def test_memory_that_a_library_does_not_get_ends_it_even_where_the_library_goes_on():
    script = INTERRUPTED.format("ctypes.CFUNCTYPE(None)(lambda: [0] * (1 << 60))()")
    done = subprocess.run([sys.executable, "-c", script], cwd=REPOSITORY, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("nerf: Not enough memory")


@pytest.mark.parametrize("block", ["1 / 0", "atexit.register(sys.stdout.close)"])
def test_what_went_wrong_is_told_by_python(block):
    done = ended(block)
    plain = subprocess.run(
        [sys.executable, "-c", BEGIN.replace("quick_end()", "__import__('contextlib').nullcontext()") + block],
        cwd=REPOSITORY, capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (plain.returncode, plain.stdout)
