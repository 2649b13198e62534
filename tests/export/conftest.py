"""Exports of tests look around less."""

from support.command_fixtures import few_looks_around  # noqa: F401
