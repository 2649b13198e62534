"""Whoever adds a setting, an option or a group says what it is: in its constructor's docstring, or beside it."""

import inspect

import pytest
from hydra.utils import get_object
from support.configs import composed, groups, yaml_files

from nerf_lightning.cli.main import find_commands
from nerf_lightning.config.help.catalogue import command_named
from nerf_lightning.config.help.docstrings import constructor
from nerf_lightning.config.help.pages import brief, command_page, page_of
from nerf_lightning.config.help.yaml_comments import read_commented
from nerf_lightning.config.overrides import flatten
from nerf_lightning.files.folders import option_names

COMMANDS = {name: command_named(name) for name in sorted(find_commands())}
every_command = pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)


@every_command
def test_every_setting_of_every_yaml_has_its_sentence(command):
    own = [each for each in command.settings if each.is_own]
    assert [each for each in own if len(each.meaning) < 5 or not each.meaning.endswith((".", "?"))] == []
    of_others = {each.key for each in command.settings if each.text and not each.is_own}
    assert of_others - {each.key for each in own} <= {"trainer.lightning.profiler"}


@every_command
def test_every_key_of_the_composed_config_is_known_with_its_default(command):
    known = {setting.key for setting in command.settings if setting.text}
    values = {
        key: value
        for key, value in flatten(composed(command.name)).items()
        if not any(word.startswith("_") for word in key.split("."))
    }
    # A table that is one setting, such as scene.skip.
    assert {key for key in values if not {key, key.rpartition(".")[0]} & known} <= {"viewer", "logger", "scene"}
    for key, value in values.items():
        if key in known and isinstance(value, int | float) and not isinstance(value, bool):
            assert float(command.default(key)) == value, key
        elif key in known and isinstance(value, str) and value not in ("", "???") and "$" not in value:
            assert command.default(key) == value, key


@pytest.mark.parametrize("group", groups())
def test_every_option_has_a_line_of_its_own(group):
    named = [each for command in COMMANDS.values() for each in command.options.items() if each[0] == group]
    lines = [brief(option.about) for _, options in named[:1] for option in options]
    assert len(lines) == len(set(lines)), lines
    assert all(len(line) > 8 for line in lines), lines


@every_command
def test_the_short_help_lists_its_groups_and_fits_its_width(command):
    page = command_page(command, 80)
    assert "$" not in page
    assert "Examples:" in page
    assert len(page.splitlines()) < 170
    assert [line for line in page.splitlines() if len(line) > 80] == []
    lines = page.partition("Groups and their options:\n")[2].partition("\n\n")[0].splitlines()
    listed = {line.split()[0] for line in lines if line[2:3].strip()}
    assert listed == {group for group in command.groups if len(option_names(group)) > 1}


@every_command
def test_every_setting_and_every_option_has_a_page(command):
    for key in {setting.key for setting in command.settings}:
        assert key in (page_of(command, key, 100) or ""), key
    for option in (each for group in command.groups for each in command.options[group]):
        assert option.typed in page_of(command, option.typed, 100)


def targets():
    """Return what yamls of ours build, by its dotted name."""
    entries = [entry for file in yaml_files() for entry in read_commented(file).entries.items()]
    named = {entry.text for key, entry in entries if key.endswith("_target_")}
    return sorted(target for target in named if target.startswith("nerf_lightning."))


@pytest.mark.parametrize("target", targets())
def test_what_is_read_from_the_source_is_what_python_sees(target):
    made = constructor(target)
    seen = inspect.signature(get_object(target)).parameters
    assert set(made.arguments) == set(seen) - {"args", "kwargs"}
    for name, argument in made.arguments.items():
        default = seen[name].default
        if isinstance(default, str) and "str" not in argument.takes:
            assert f"'{default}'" in argument.takes, name
        elif isinstance(default, bool) or default is None:
            assert ("null" if default is None else "bool") in argument.takes, name
