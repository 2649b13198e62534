"""The fixtures of commands, for tests of extensions."""

from support.command_fixtures import *  # noqa: F403
