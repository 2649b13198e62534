"""Shared by all tests: a tiny scene, a tiny model, rays to look along, and float64 on demand."""

import atexit
import gc
import logging
import os
import sys

# Workers side by side have one thread each, and so has what they start; torch reads it while it is loaded.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
# As cli.py: threads that wait busily would take the time of others.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import pytest
from _pytest import runner
from support import fork_server, type_checks
from support.large_frame import in_large_frame

# Here: the conftest.py of commands, and that of extensions, import our package before anything is configured.
type_checks.install()
MOST_THREADS = 1 if "PYTEST_XDIST_WORKER" in os.environ else 2


def pytest_configure(config):
    """Prepare what the tests import, but for a process that only hands them to workers."""
    if hasattr(config, "workerinput") or config.getoption("dist", "no") == "no":
        from support import quick_composition

        quick_composition.install()


@pytest.hookimpl(wrapper=True)
def pytest_sessionfinish(session):
    """Note with which code to end."""
    result = yield
    _exit_code.append(int(session.exitstatus))
    return result


_exit_code = []


def _leave():
    """Leave out what takes a process of tests seconds, too: to take apart all that was loaded."""
    if _exit_code:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_exit_code[-1])


# Here, so that what is registered later, such as removing old folders of tests, is done before.
atexit.register(_leave)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """Import the tests, and all that they import, as quickly as the commands import what they need."""
    from nerf_lightning.cli.process import quick_imports

    with quick_imports():
        collected = yield
    gc.freeze()  # what is there for good need not be looked through again and again
    return collected


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    """Run a test as pytest does, but with room for its frames."""
    return in_large_frame(runner.pytest_runtest_protocol, item, nextitem)


@pytest.fixture(autouse=True)
def _quiet_threads():
    """Two threads at most: more would only wait for each other on a small machine."""
    import torch

    torch.set_num_threads(min(MOST_THREADS, torch.get_num_threads()))


@pytest.fixture(autouse=True)
def _no_handlers_of_logs_are_left():
    """Those that Hydra installs write to what one test has captured, which is closed when it ends."""
    before = logging.root.handlers[:]
    yield
    for handler in set(logging.root.handlers).difference(before):
        logging.root.removeHandler(handler)


@pytest.fixture(scope="session", autouse=True)
def _no_server_is_left():
    yield
    fork_server.stop()


@pytest.fixture(autouse=True)
def _the_same_numbers_whatever_ran_before():
    import torch

    torch.manual_seed(0)


@pytest.fixture
def generator():
    import torch

    return torch.Generator().manual_seed(20260101)
