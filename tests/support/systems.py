"""Marks of tests for what some systems lack."""

import os
import sys

import pytest

POSIX = pytest.mark.skipif(os.name != "posix", reason="forks, FIFOs, links and most signals are posix's")
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, or limits memory, as Linux does")
