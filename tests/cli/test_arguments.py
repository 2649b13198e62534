"""Words of a command line that are no settings."""

import pytest
from support.running import refused

from nerf_lightning.cli.arguments import require_settings


@pytest.mark.parametrize("typed", ["scene.root= data/x", "scene = bricks", "scene.root data/x", "scene =bricks"])
def test_spaces_around_the_equals_sign_are_told_in_one_paragraph(typed):
    told = "settings are key=value without spaces: scene.root=data/x"
    refused(require_settings, ["seed=1", *typed.split()], False, parts=(told,))


@pytest.mark.parametrize("typed", ["runs = out", "runs= out", "runs =out"])
def test_so_are_they_where_a_path_may_stand_alone(typed):
    refused(require_settings, typed.split(), True, parts=("without spaces",))


@pytest.mark.parametrize("or_paths", [False, True])
def test_options_removals_and_empty_values_pass(or_paths):
    require_settings([], or_paths)
    require_settings(["--multirun", "~callbacks.film", "logger.name=", "a=b=c", *["out"] * or_paths], or_paths)
