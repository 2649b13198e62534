"""Values on the command line: what is suggested can be typed, and what cannot be read is explained."""

import shlex

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

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
def test_a_folder_that_hydra_cannot_read_is_written_out_with_quotes(nerf, name):
    result = nerf("doctor", "scene=colmap", f"scene.root={name}")
    assert result.code == 2
    assert result.err.strip().startswith(f"nerf: scene.root={name} cannot be read")
    assert result.err.strip().endswith(f"""Type "scene.root='{name}'".""")
