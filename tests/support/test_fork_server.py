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


def test_it_has_its_own_folder_environment_and_arguments_and_its_end_is_that_of_any_process(tmp_path):
    code = (
        "import atexit, os, sys; atexit.register(print, 'end'); print(os.getcwd(), dict(os.environ), sys.argv); 1 / 0"
    )
    number, output = told(code, "two", cwd=tmp_path, env={})
    expected = {f"{tmp_path} {{}} ['-c', 'two']", "ZeroDivisionError: division by zero", "end"}
    assert (number, expected - set(output.splitlines())) == (1, set()), output
    assert told("raise KeyboardInterrupt")[0] == -signal.SIGINT


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
