"""Values on the command line: what is suggested can be typed, and what cannot be read is explained."""

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from support.running import said

from nerf_lightning.config.overrides import to_type

NAMES = [
    "data/fox",
    "my fox",
    "fox (1)",
    "a,b",
    "it's",
    'say "so"',
    "${HOME}",
    "C:\\fox",
    "C:\\it's",
    "end\\",
    "a=b",
    "50%",
]


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


def test_spaces_around_the_equals_sign_are_told(nerf):
    said(nerf("eval", "ckpt=", "data/x"), "settings are key=value without spaces: scene.root=data/x")
