"""Hydra's own options and values, wherever and however they are typed; what cannot be read is explained."""

import argparse
import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from support.running import done, said

from nerf_lightning.cli.arguments import options_first
from nerf_lightning.config.hydra_versions import options_parser
from nerf_lightning.config.overrides import to_type

TAKING_A_VALUE = [
    (option, (action.choices or ["x/y z"])[0])
    for action in options_parser()._actions
    if isinstance(action, argparse._StoreAction)
    for option in action.option_strings
]
SWITCHES = [
    option
    for action in options_parser()._actions
    if isinstance(action, argparse._StoreTrueAction)
    for option in action.option_strings
]


@pytest.mark.parametrize(("option", "value"), TAKING_A_VALUE)
def test_a_value_may_stand_apart(option, value):
    expected = [f"{_full(option)}={value}", "seed=1", "model=nerf"]
    assert options_first([option, value, "seed=1", "model=nerf"]) == expected
    assert options_first(["seed=1", option, value, "model=nerf"]) == expected
    assert options_first(["seed=1", "model=nerf", f"{option}={value}"]) == expected
    assert options_first(expected) == expected


@pytest.mark.parametrize("option", SWITCHES)
def test_a_switch_takes_no_value(option):
    assert options_first(["model=nerf", option, "seed=1"]) == [_full(option), "model=nerf", "seed=1"]


def _full(option):
    words = next(action.option_strings for action in options_parser()._actions if option in action.option_strings)
    return next(word for word in words if word.startswith("--"))


def test_overrides_stay_as_they_are_and_options_of_a_sweep_are_hydras(nerf):
    overrides = ["~callbacks.monitor", "+a=-1", "++b={c:[1,2]}", "seed=1,2", "outputs/bricks", "x=a b", "y="]
    assert options_first(overrides) == overrides
    result = nerf("train", "seed=0", "--multirun", "--help")
    assert result.code == 0
    assert "Examples:" in result.out


def test_options_that_hydra_does_not_know_or_that_do_not_go_together_are_one_paragraph(nerf):
    for arguments in (["--cfg", "jobb"], ["--cfg"], ["--confdir=x"], ["seed=1", "-x"]):
        said(nerf("train", *arguments), "nerf COMMAND --hydra-help")
    for arguments in (["-m", "--cfg", "job"], ["--resolve"]):
        said(nerf("train", *arguments), "--")


@pytest.mark.parametrize("words", [["--max-steps", "5"], ["--max_steps=5"]])
def test_a_setting_typed_as_an_option_is_written_out(nerf, words):
    said(nerf("train", "seed=0", *words), "settings are given without dashes, as key=value. Type trainer.max_steps=5.")


@pytest.mark.parametrize("command", ["eval", "render", "view", "report", "table", "train"])
def test_every_command_shows_its_config(nerf, command):
    result = done(nerf(command, "-c", "job", "--package", "paths"))
    assert result.out.startswith("# @package paths\nroot_dir: outputs\n")


def test_a_checkpoints_scene_and_options_go_together(nerf, finished_run):
    checkpoint = finished_run / "checkpoints" / "last.ckpt"
    shown = [nerf("eval", f"ckpt={checkpoint}", *form).out for form in (["--cfg=job"], ["--cfg", "job"])]
    assert "ball.npz" in shown[0]
    assert shown[0] == shown[1]
    page = nerf("report", finished_run, "--cfg", "job")
    assert f"run: {finished_run}" in page.out, page.err


NAMES = ["data/fox", "my fox", "fox (1)", "a,b", "it's", 'say "so"', "${HOME}", "C:\\fox", "C:\\it's", "end\\", "a=b"]


@pytest.mark.parametrize("name", NAMES)
def test_what_is_suggested_comes_back_through_shell_and_hydra(name):
    (word,) = shlex.split(to_type("scene.root", name))
    (override,) = OverridesParser.create().parse_overrides([word])
    node = OmegaConf.create({"value": override.value()})
    assert node.value == name


@pytest.mark.parametrize("name", ["fox (1)", "fox (é)"])
def test_a_value_that_hydra_cannot_read_is_written_out_with_quotes(nerf, name):
    result = nerf("doctor", "scene=colmap", f"scene.name={name}")
    assert result.code == 2
    assert result.err.strip().startswith(f"nerf: scene.name={name} cannot be read")
    assert result.err.strip().endswith(f"""Type "scene.name='{name}'".""")


@pytest.mark.parametrize("end", ["", "\r"])
def test_a_folder_needs_no_quotes_and_a_line_may_end_as_on_windows(nerf, end):
    words = ["doctor", "scene=colmap", "scene.root=新加卷/fox (1)"]
    said(nerf(*(f"{word}{end}" for word in words), *[end] * bool(end)), "The folder 新加卷/fox (1) does not exist")
