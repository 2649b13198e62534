"""Every yaml of conf/ composes and builds."""

import inspect

import pytest
from configs import composed, loaded, options
from hydra.utils import get_class, get_method
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.commands.build import build
from nerf_lightning.export.base import Export
from nerf_lightning.geometry.paths.keyframes import Keyframe, write_keyframes

BUILT = {
    "encoder": "encoder",
    "field": "field",
    "model": "model",
    "loss": "loss",
    "scheduler": "scheduler",
    "callbacks": "callbacks",
    "viewer": "viewer",
    "path": "path",
    "evaluation": "evaluation",
    "optimizer": "optimizer",
}


@pytest.mark.parametrize(("group", "option"), [(g, o) for g in BUILT for o in options(g)])
def test_every_component_builds(group, option, tmp_path):
    config = composed("train", f"{group}={option}")[BUILT[group]]
    if OmegaConf.is_missing(config, "file"):
        write_keyframes(tmp_path / "keys.yaml", [Keyframe((x, 0.0, 0.0), look_at=(0.0, 1.0, 0.0)) for x in (0.0, 1.0)])
        config.file = str(tmp_path / "keys.yaml")
    assert build(config) is not None


@pytest.mark.parametrize("option", options("experiment"))
def test_every_experiment_composes_and_its_model_builds(option):
    config = composed("train", f"experiment={option}")
    if OmegaConf.is_missing(config.scene, "root"):
        config.scene.root = "somewhere"
    assert build(config.model).points_per_ray(training=True) > 0
    assert OmegaConf.to_container(config, resolve=True, throw_on_missing=True)


@pytest.mark.parametrize("option", options("scene"))
def test_every_scene_reader_builds(option):
    keys = [key for key in loaded("scene", option) if OmegaConf.is_missing(loaded("scene", option), key)]
    assert build(composed("train", f"scene={option}", *[f"scene.{key}=somewhere" for key in keys]).scene) is not None


@pytest.mark.parametrize("option", [o for o in options("trainer") if o not in ("gpu", "mps", "tpu")])
def test_every_trainer_builds(option):
    assert build(composed("train", f"trainer={option}").trainer).max_steps > 0


@pytest.mark.parametrize("option", options("what"))
def test_every_export_builds(option):
    assert isinstance(build(composed("export", f"what={option}").what), Export)


@pytest.mark.parametrize("command", ["train", "eval", "render", "bench", "export", "view", "selftest"])
def test_every_command_composes(command):
    assert "trainer" in composed(command)


def targets(node, path=""):
    if isinstance(node, DictConfig):
        if "_target_" in node:
            yield path, node
        for key in node:
            if not OmegaConf.is_missing(node, key) and not OmegaConf.is_interpolation(node, key):
                yield from targets(node[key], f"{path}.{key}")


@pytest.mark.parametrize(
    "group", ["encoder", "field", "sampler", "loss", "scheduler", "scene", "path", "evaluation", "trainer", "what"]
)
def test_a_yaml_names_its_constructors_arguments_and_all_of_them(group):
    """The signature is the schema: a setting that exists can be seen in the yaml, and no key is read by nobody."""
    for option in options(group):
        config = loaded(group, option)
        if "_target_" not in config:
            continue
        target = config["_target_"]
        try:
            signature = inspect.signature(get_class(target))
        except ValueError:
            signature = inspect.signature(get_method(target))
        assert set(config) - {"_target_", "_partial_", "defaults"} == set(signature.parameters) - {"args", "kwargs"}, (
            f"{group}/{option}"
        )
