"""Hydra's own options, wherever and however they are typed."""

import argparse

import pytest
from hydra._internal.utils import get_args_parser
from support.running import said

from nerf_lightning.cli.arguments import options_first

TAKING_A_VALUE = [
    (option, (action.choices or ["x/y z"])[0])
    for action in get_args_parser()._actions
    if isinstance(action, argparse._StoreAction)
    for option in action.option_strings
]
SWITCHES = [
    option
    for action in get_args_parser()._actions
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
    words = next(action.option_strings for action in get_args_parser()._actions if option in action.option_strings)
    return next(word for word in words if word.startswith("--"))


def test_overrides_stay_as_they_are():
    overrides = ["~callbacks.monitor", "+a=-1", "++b={c:[1,2]}", "seed=1,2", "outputs/bricks", "x=a b", "y="]
    assert options_first(overrides) == overrides


@pytest.mark.parametrize("arguments", [["--cfg", "jobb"], ["--cfg"], ["--confdir=x"], ["seed=1", "-x"]])
def test_an_option_that_hydra_does_not_know_is_one_paragraph(nerf, arguments):
    said(nerf("train", *arguments), "nerf COMMAND --hydra-help")


@pytest.mark.parametrize("arguments", [["-m", "--cfg", "job"], ["--resolve"]])
def test_options_that_do_not_go_together_are_one_paragraph(nerf, arguments):
    said(nerf("train", *arguments), "--")


@pytest.mark.parametrize("form", [["--cfg=job"], ["--cfg", "job"], ["-c", "job"]])
@pytest.mark.parametrize("command", ["eval", "render", "view", "report", "table", "train"])
def test_every_command_shows_its_config(nerf, command, form):
    result = nerf(command, *form, "--package", "paths")
    assert result.code == 0, result.err
    assert result.out.startswith("# @package paths\nroot_dir: outputs\n")


def test_a_checkpoints_scene_and_options_go_together(nerf, finished_run):
    checkpoint = finished_run / "checkpoints" / "last.ckpt"
    shown = [nerf("eval", f"ckpt={checkpoint}", *form).out for form in (["--cfg=job"], ["--cfg", "job"])]
    assert "ball.npz" in shown[0]
    assert shown[0] == shown[1]
    page = nerf("report", finished_run, "--cfg", "job")
    assert f"run: {finished_run}" in page.out, page.err


def test_options_of_a_sweep_are_hydras(nerf):
    result = nerf("train", "seed=0", "--multirun", "--help")
    assert result.code == 0
    assert "Examples:" in result.out
