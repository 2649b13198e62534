"""Marks of tests for what some systems lack."""

import os

import pytest

POSIX = pytest.mark.skipif(os.name != "posix", reason="forks, FIFOs, links and most signals are posix's")
