"""Whoever adds a setting, an option or a group says what it is: in its constructor's docstring, or beside it."""

import inspect

import pytest
from hydra.utils import get_object
from support.configs import composed, groups, yaml_files

from nerf_lightning.cli.main import find_commands
from nerf_lightning.config.overrides import flatten
from nerf_lightning.files.folders import conf_file, option_names
from nerf_lightning.manual.catalogue import command_named
from nerf_lightning.manual.commented_yaml import read_commented
from nerf_lightning.manual.constructors import constructor
from nerf_lightning.manual.pages import command_page, page_of, said

COMMANDS = sorted(find_commands())
# How Hydra and its loggers are wired, in hydra/nerf.yaml and the hydra sections of commands: nobody changes them.
WIRING = {"hydra"}
# An argument of Lightning's Trainer, which its own documents explain.
OF_LIGHTNING = {"trainer.lightning.profiler"}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_setting_of_every_yaml_has_its_sentence(command):
    asked = command_named(command)
    lacking = [
        (option and f"{option.group}={option.name}", setting.key)
        for option, setting in asked.settings
        if len(setting.meaning) < 4 or not said(setting).endswith(".")
    ]
    assert lacking == []


@pytest.mark.parametrize("command", COMMANDS)
def test_every_key_of_the_composed_config_is_known(command):
    asked = command_named(command)
    known = {setting.key for _, setting in asked.settings if not setting.is_section}
    keys = {key for key in flatten(composed(command)) if not any(word.startswith("_") for word in key.split("."))}
    # A table that is one setting, such as scene.skip.
    assert {key for key in keys if not {key, key.rpartition(".")[0]} & known} - {"viewer", "logger", "scene"} == set()


@pytest.mark.parametrize("command", COMMANDS)
def test_the_default_that_is_told_is_that_of_the_composed_config(command):
    asked = command_named(command)
    values = flatten(composed(command))
    told = {key: asked.default(key) for key in values if any(setting.key == key for _, setting in asked.settings)}
    numbers = {key: value for key, value in values.items() if key in told and isinstance(value, int | float)}
    assert {key: float(told[key]) for key, value in numbers.items() if not isinstance(value, bool)} == {
        key: float(value) for key, value in numbers.items() if not isinstance(value, bool)
    }
    texts = {
        key: value
        for key, value in values.items()
        if key in told and isinstance(value, str) and value and "$" not in value
    }
    assert {key: told[key] for key in texts} == texts


@pytest.mark.parametrize("command", COMMANDS)
def test_what_an_option_sets_of_other_groups_is_there(command):
    asked = command_named(command)
    known = {setting.key for _, setting in asked.settings}
    for group in asked.groups:
        for option in (each for each in group.options if each.file.is_global):
            assert {
                setting.key for setting in option.settings if not setting.is_section
            } <= known | WIRING | OF_LIGHTNING, f"{group.typed}={option.name}"


@pytest.mark.parametrize("group", groups())
def test_every_option_has_a_line_of_its_own(group):
    asked = [found for name in COMMANDS for each in (command_named(name),) for found in (*each.groups, *each.brought)]
    groups = [each for each in asked if each.name == group] or [None]
    lines = [option.summary for option in groups[0].options] if groups[0] else ["of Hydra alone"]
    assert len(lines) == len(set(lines)), lines
    assert all(len(line) > 8 for line in lines), lines


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_lists_the_groups_that_it_has_and_no_others(command):
    page = command_page(command_named(command), 100)
    listed = {
        line.split()[0]
        for line in page.partition("Groups and their options:\n")[2].partition("\n\n")[0].splitlines()
        if line[2:3].strip()
    }
    chosen = {name.partition("@")[0] for name, _ in read_commented(conf_file(command)).defaults}
    assert {name.partition("@")[0] for name in listed} == {name for name in chosen if len(option_names(name)) > 1}


@pytest.mark.parametrize("command", COMMANDS)
def test_the_short_help_is_filled_in_and_fits_its_width(command):
    page = command_page(command_named(command), 120)
    assert "$" not in page
    assert [line for line in page.splitlines() if len(line) > 120] == []
    assert "Examples:" in page
    assert len(page.splitlines()) < 110


@pytest.mark.parametrize("command", COMMANDS)
def test_every_setting_and_every_option_has_a_page(command):
    asked = command_named(command)
    for key in {setting.key for _, setting in asked.settings}:
        assert key in (page_of(asked, key, 100) or ""), key
    for group in asked.groups:
        for option in group.options:
            assert f"{group.typed}={option.name}" in page_of(asked, f"{group.typed}={option.name}", 100)


def targets():
    """Return what yamls of ours build, by its dotted name."""
    files = [read_commented(file).root for file in yaml_files()]
    found = set()
    while files:
        entry = files.pop()
        files += entry.below.values()
        if "_target_" in entry.below:
            found.add(entry.below["_target_"].value)
    return sorted(target for target in found if target.startswith("nerf_lightning."))


@pytest.mark.parametrize("target", targets())
def test_what_is_read_from_the_source_is_what_python_sees(target):
    made = constructor(target)
    seen = inspect.signature(get_object(target)).parameters
    assert set(made.arguments) == set(seen) - {"args", "kwargs"}
    for name, argument in made.arguments.items():
        default = seen[name].default
        if isinstance(default, bool):
            assert {"true", "false"} <= set(argument.kind.choices), name
        elif isinstance(default, str) and argument.kind.choices and "text" not in argument.kind.words:
            assert default in argument.kind.choices, name
        elif default is None:
            assert "null" in argument.kind.choices, name
