"""Forks of the test server are processes like others."""

import os
import signal
import sys

import pytest
from support.fork_server import Forked, fits_a_fork

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere tests start processes of their own")


def told(code, *arguments, **options):
    process = Forked("-c", code, *arguments, **options)
    output, _ = process.communicate(timeout=60)
    return process.returncode, output


def test_it_has_its_own_folder_environment_arguments_and_session(tmp_path, monkeypatch):
    monkeypatch.setenv("THIS_IS_HERE", "now")
    code = "import os, sys; print(os.getcwd(), os.environ.get('THIS_IS_HERE'), os.environ.get('HOME'), sys.argv)"
    assert told(code, 1, "two", cwd=tmp_path) == (0, f"{tmp_path} now {os.environ.get('HOME')} ['-c', '1', 'two']\n")
    assert told(code, cwd=tmp_path, env={}) == (0, f"{tmp_path} None None ['-c']\n")
    code = "import os; print(os.getsid(0) == os.getpid() == os.getpgid(0))"
    assert told(code, start_new_session=True) == (0, "True\n")
    assert told(code) == (0, "False\n")


@pytest.mark.parametrize(
    ("code", "expected", "words"),
    [
        ("import sys; sys.exit(3)", 3, ""),
        ("import sys; sys.exit('no')", 1, "no\n"),
        ("1 / 0", 1, "ZeroDivisionError"),
        ("raise KeyboardInterrupt", -signal.SIGINT, "KeyboardInterrupt"),
        ("import os; os.kill(os.getpid(), 9)", -9, ""),
        ("import atexit; atexit.register(print, 'at the end')", 0, "at the end\n"),
        ("import threading; threading.Timer(0.2, print, ['late']).start()", 0, "late\n"),
    ],
)
def test_it_ends_as_any_process(code, expected, words):
    number, output = told(code)
    assert (number, words in output) == (expected, True), output


def test_what_is_read_at_import_needs_a_process_of_its_own_and_a_call_of_nerf_in_this_one_changes_nothing(monkeypatch):
    assert fits_a_fork(os.environ)
    assert fits_a_fork(os.environ | {"PATH": "/elsewhere"})
    assert not fits_a_fork(os.environ | {"OMP_NUM_THREADS": "13"})
    assert not fits_a_fork(os.environ | {"PYTHONHASHSEED": "13"})
    assert not fits_a_fork(os.environ | {"SLURM_CPUS_PER_TASK": "1"})
    assert not fits_a_fork(os.environ | {"GOMP_SPINCOUNT": "13"})
    monkeypatch.setenv("GOMP_SPINCOUNT", "1000")
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    assert fits_a_fork(os.environ)
    assert told("import sys; print(sys.stdout.write_through)") == (0, "True\n")
    monkeypatch.setenv("PYTHONUNBUFFERED", "")
    assert told("import sys; print(sys.stdout.write_through)") == (0, "False\n")
