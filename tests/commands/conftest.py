"""The fixtures of commands."""

from support.command_fixtures import *  # noqa: F403
