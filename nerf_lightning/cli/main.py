"""The console command: `nerf COMMAND ...` hands its arguments to one Hydra application per command; `nerf --help`.

Nothing heavy is imported here, so that `nerf --help` answers at once.
"""

import ast
import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from types import ModuleType
from typing import TYPE_CHECKING, Any

from nerf_lightning.cli.arguments import quoted_paths
from nerf_lightning.cli.prepare import is_sweep, prepared, sweep_arguments
from nerf_lightning.cli.process import (
    announce_start,
    ends_quietly,
    quick_imports,
    require_no_settings_here,
    was_interrupted,
)
from nerf_lightning.config.help.catalogue import command_named
from nerf_lightning.files.budgets import Budgets, allow_as_typed, set_limits
from nerf_lightning.files.folders import PACKAGE, conf_file, conf_folder
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import for_terminal, terminal_width
from nerf_lightning.messages.exit_codes import BAD_INPUT, INTERRUPTED
from nerf_lightning.messages.suggestions import did_you_mean

if TYPE_CHECKING:
    from omegaconf import DictConfig

OF_ITSELF = {
    "completion": "Print the shell completion script for bash, zsh or fish: nerf completion bash.",
    "help": "Explain a setting, a group or an option, or search: nerf help scene=colmap.",
}
"""Commands that explain the others."""
VERBOSE = ("-v", "--verbose")
DETAILS = "hydra.verbose=[nerf_lightning]"
"""What they stand for: the details that our own modules log."""
JSON, AS_JSON = "--json", "json=true"
"""Of commands that print a table, and what it stands for."""
HELP = """nerf: train radiance fields from photographs and render new views.

usage: nerf COMMAND [-m] [-v] [key=value ...]          -m: sweep, -v: details
       nerf COMMAND --json         print the table of a command as JSON

{}

nerf COMMAND --help lists the groups, the settings and examples of a command.
nerf help NAME explains a setting, group or option: nerf help trainer.max_steps.
nerf help WORDS searches: nerf help blurry, nerf help learning rate.
python -m nerf_lightning is the same."""
MOST_LETTERS = 5000


def main() -> None:
    """Run the command line."""
    with explained("COMMAND"):
        # In a script that was edited on Windows, lines, and thus arguments, end with a CR.
        _answer([word.rstrip("\r") for word in sys.argv[1:] if word != "\r"])


def _answer(arguments: list[str]) -> None:
    commands = find_commands()
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_help(commands))
        return
    if arguments[0] in ("-V", "--version"):
        from nerf_lightning import __version__

        print(__version__)
        return
    command, rest = arguments[0], arguments[1:]
    if command == "help":
        from nerf_lightning.cli.help import help_on_anything

        print(help_on_anything(rest, list(commands)) if rest else _help(commands))
        return
    if command == "completion":
        from nerf_lightning.cli.help import completion

        print(completion(rest, [*commands, *OF_ITSELF]))
        return
    if command not in commands:
        raise InputError(
            f"There is no command '{command}'.{did_you_mean(command, [*commands, *OF_ITSELF])} See nerf --help."
        )
    if {"-h", "--help"} & set(rest):
        from nerf_lightning.cli.help import help_on

        print(help_on(command, rest))
        return
    _run(command, rest)


def find_commands() -> dict[str, str]:
    """Return each command with its one-line description, without importing any."""
    return {name: _summary(file) for name, file in sorted(_command_files().items())}


def command_module(name: str) -> ModuleType:
    """Import the module whose `run(config)` does a command's work."""
    file = _command_files()[name].relative_to(PACKAGE.parent)
    return importlib.import_module(".".join(file.with_suffix("").parts))


def _command_files() -> dict[str, Path]:
    """Return the files in commands/, ours and those of extensions; each has a YAML of the same name in conf/."""
    files = [*PACKAGE.glob("extensions/*/commands/*.py"), *PACKAGE.glob("commands/*.py")]
    return {file.stem: file for file in files if conf_file(file.stem).is_file()}


def _summary(file: Path) -> str:
    # Read, not imported: an import would take seconds.
    docstring = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n")[0]


def _help(commands: dict[str, str]) -> str:
    width = max(map(len, [*commands, *OF_ITSELF]))
    columns, indent = min(terminal_width(120), 120), " " * (width + 4)
    rows = [f"  {name:<{width}}  {summary}" for name, summary in (commands | OF_ITSELF).items()]
    lines = [fill(row, columns, subsequent_indent=indent) for row in rows]
    return HELP.format("\n".join(lines))


def _run(command: str, arguments: list[str]) -> None:
    """Run one Hydra application; bad input ends with one paragraph and exit code 2, never a traceback."""
    require_no_settings_here()
    announce_start(command, arguments)
    # Otherwise, torch's threads spin for some milliseconds after each operation and block the kernels' threads. GNU's
    # OpenMP reads this when torch is loaded.
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    # By default, Hydra prints its own short traceback and exits with 1; we want the exceptions.
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    def task(config: "DictConfig") -> Any:
        # torch and Lightning take seconds, and --help needs neither.
        with explained(command), quick_imports():
            module = command_module(command)
        # A job of a sweep may run in another process than the one that read the command line.
        set_limits(Budgets(**config.budgets))
        if HydraConfig.get().mode == RunMode.MULTIRUN:
            from nerf_lightning.runs.sweep_job import run_job

            return run_job(ends_quietly()(module.run), config, command)
        # Caught inside the job as well: Hydra would print the overrides first.
        with explained(command):
            from nerf_lightning.config.instantiate import require_kinds

            require_kinds(config, command)
            return module.run(config)

    with explained(command):
        from nerf_lightning.cli.arguments import options_first, require_settings
        from nerf_lightning.cli.process import compose_once
        from nerf_lightning.config.hydra_versions import hydra_main
        from nerf_lightning.config.search_path import search_extensions

        if JSON in arguments:
            _require_table(command)
        arguments = options_first([_setting_of(word) for word in arguments], command)
        known = command_named(command)
        require_settings(arguments, or_paths=known is not None and known.path_setting is not None)
        allow_as_typed(arguments)
        arguments = quoted_paths(arguments, is_sweep(arguments))
        sys.argv = [f"nerf {command}", *options_first(prepared(command, sweep_arguments(arguments)))]
        compose_once()
        search_extensions()
        run = hydra_main(config_path=str(conf_folder()), config_name=command)(task)
        if is_sweep(arguments):
            from nerf_lightning.runs.sweep import watched

            watched(run)
        else:
            run()


def _require_table(command: str) -> None:
    from nerf_lightning.config.help.catalogue import command_named, known_names

    asked = command_named(command)
    if asked is None or "json" not in known_names(asked):
        raise InputError(f"nerf {command} prints no table: {JSON} is for commands that do, such as nerf doctor.")


def _setting_of(word: str) -> str:
    return DETAILS if word in VERBOSE else AS_JSON if word == JSON else word


@contextmanager
def explained(command: str) -> Iterator[None]:
    """Turn bad input into one paragraph and exit code 2; exit quietly if the reader of the output has left."""
    try:
        with ends_quietly():
            yield
    except (KeyboardInterrupt, Exception) as error:
        if isinstance(error, KeyboardInterrupt) or was_interrupted():
            sys.exit(INTERRUPTED)
        from nerf_lightning.config.error_messages import paragraph

        message = paragraph(error, command)
        if message is None:
            raise
        _complain(message)


def _complain(message: str) -> None:
    # Names from files may contain anything: none of their escape sequences reaches the terminal, and none of their
    # lines looks like ours. Some messages of libraries have several lines.
    print(f"nerf: {for_terminal(message.replace(chr(10), ' '), MOST_LETTERS)}", file=sys.stderr)
    sys.exit(BAD_INPUT)
