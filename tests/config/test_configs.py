"""Every yaml of conf/ composes and builds."""

import inspect
from dataclasses import asdict

import pytest
import torch
import yaml
from hydra.errors import HydraException, InstantiationException
from hydra.utils import get_class, get_method
from omegaconf import DictConfig, ListConfig, OmegaConf
from support.configs import composed, loaded, options

from nerf_lightning.checkpoints.trusted_classes import names_of
from nerf_lightning.cli.main import find_commands
from nerf_lightning.config.hydra_versions import IS_1_3, instantiate
from nerf_lightning.config.instantiate import build, require_kinds
from nerf_lightning.export.base import Export
from nerf_lightning.files.budgets import Budgets
from nerf_lightning.messages.errors import InputError
from nerf_lightning.video.paths.keyframes import Keyframe, write_keyframes

BUILT = (
    *("encoder", "field", "model", "loss", "refinement", "scheduler", "callbacks", "viewer", "path", "evaluation"),
    *("optimizer", "correction"),
)


# What a run has whatever its model is made of: an option of each is composed at a time.
BESIDE_THE_MODEL = [group for group in BUILT if group not in ("encoder", "field", "model")]


def picks(group, option):
    """Return overrides that pick an option of a group, and what may be picked with it."""
    if group in BESIDE_THE_MODEL:
        number = options(group).index(option)
        return [f"{each}={(offered := options(each))[number % len(offered)]}" for each in BESIDE_THE_MODEL]
    # An MLP needs the encoder of its model.
    return [*(["model=nerf"] if option.startswith("nerf_mlp") else []), f"{group}={option}"]


@pytest.mark.parametrize(("group", "option"), [(g, o) for g in BUILT for o in options(g)])
def test_every_component_builds(group, option, tmp_path):
    config = composed("train", *picks(group, option))[group]
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


@pytest.mark.parametrize("model", options("model"))
def test_a_model_writes_no_size_into_the_parts_that_it_chose(model):
    """Else whoever chooses another part is told of a setting that it does not have."""
    yaml = OmegaConf.to_container(loaded("model", model))
    assert not {"encoder", "direction_encoder", "field"} & yaml.keys()
    for level in yaml.get("model", {}).get("levels", {}).values():
        assert level.keys() <= {"_target_", "field", "learn_every", "gradient_scaling_distance"}
        assert level.get("field", "${field}") == "${field}"


@pytest.mark.parametrize("model", options("model"))
def test_every_model_builds_without_memory(model):
    """As a checkpoint's model is built first, to compare its sizes."""
    config = composed("train", f"model={model}").model
    with torch.device("meta"):
        assert all(weight.is_meta for weight in build(config).parameters())


@pytest.mark.parametrize("model", options("model"))
@pytest.mark.parametrize("part", ["encoder=frequency_small", "encoder@direction_encoder=frequency_directions_small"])
def test_every_model_takes_another_encoder(model, part):
    assert build(composed("train", f"model={model}", part).model).points_per_ray(training=True) > 0


@pytest.mark.parametrize(
    ("model", "parts"),
    [
        ("nerf", ["field=ngp", "encoder=hash_grid"]),
        ("nerf_tiny", ["field=ngp", "encoder=hash_grid_small"]),
        ("nerf_occupancy", ["field=ngp"]),
        ("fast", ["field=nerf_mlp_small", "encoder=frequency"]),
        ("fast_proposal", ["field=nerf_mlp_tiny", "encoder=frequency_small"]),
    ],
)
def test_models_take_another_field(model, parts):
    assert build(composed("train", f"model={model}", *parts).model).points_per_ray(training=True) > 0


@pytest.mark.parametrize(
    ("model", "level", "sampler"),
    [("nerf", "coarse", "occupancy"), ("fast", "fine", "stratified"), ("fast_dense", "fine", "importance")],
)
def test_a_level_refuses_a_sampler_of_another_kind_in_words(model, level, sampler):
    config = composed("train", f"model={model}", f"sampler@model.levels.{level}.sampler={sampler}")
    with pytest.raises(HydraException) as refused:
        build(config.model)
    assert "choose another sampler, or a model with another level" in str(refused.value.__cause__)


PARTS = ("encoder", "encoder@direction_encoder", "field")
SAMPLED = {"nerf": ("coarse", "fine"), "fast_proposal": ("proposal", "fine")}


def builds_or_is_refused_in_words(*overrides):
    """Build a model, or be told by one of its parts, in a sentence, what does not fit."""
    config = composed("train", *overrides)
    try:
        reason = None if build(config.model).points_per_ray(training=True) > 0 else "no points"
    except HydraException as error:
        reason = error.__cause__
    assert reason is None or (isinstance(reason, ValueError) and " " in str(reason)), overrides


def choices(group):
    return options(group.partition("@")[0])


@pytest.mark.slow
@pytest.mark.exhaustive
@pytest.mark.parametrize("model", options("model"))
def test_every_part_of_every_model_builds_or_is_refused_in_words(model):
    for group in PARTS:
        for option in choices(group):
            builds_or_is_refused_in_words(f"model={model}", f"{group}={option}")
    for level in SAMPLED.get(model.partition("_")[0] if model not in SAMPLED else model, ("fine",)):
        if level in composed("train", f"model={model}").model.get("levels", {}):
            for option in options("sampler"):
                builds_or_is_refused_in_words(f"model={model}", f"sampler@model.levels.{level}.sampler={option}")


@pytest.mark.parametrize("option", options("scene"))
def test_every_scene_reader_builds(option):
    keys = [key for key in loaded("scene", option) if OmegaConf.is_missing(loaded("scene", option), key)]
    assert build(composed("train", f"scene={option}", *[f"scene.{key}=somewhere" for key in keys]).scene) is not None


@pytest.mark.parametrize("option", [o for o in options("trainer") if o not in ("gpu", "mps", "tpu")])
def test_every_trainer_builds(option):
    assert build(composed("train", f"trainer={option}").trainer).published_steps > 0


@pytest.mark.parametrize("option", options("what"))
def test_every_export_builds(option):
    assert isinstance(build(composed("export", f"what={option}").what), Export)


@pytest.mark.parametrize("command", sorted(find_commands()))
def test_every_command_composes(command):
    assert composed(command).budgets == asdict(Budgets())


def targets(node, path=""):
    if isinstance(node, DictConfig):
        if "_target_" in node:
            yield path, node
        for key in node:
            if not OmegaConf.is_missing(node, key) and not OmegaConf.is_interpolation(node, key):
                yield from targets(node[key], f"{path}.{key}")


@pytest.mark.parametrize(
    "group",
    [
        *("encoder", "field", "sampler", "loss", "correction", "scheduler", "scene", "path", "evaluation", "trainer"),
        *("what", "callbacks"),
    ],
)
def test_a_yaml_names_its_constructors_arguments_and_all_of_them(group):
    """The signature is the schema: a setting that exists can be seen in the yaml, and no key is read by nobody."""
    for option in options(group):
        file = loaded(group, option)
        for config in file.values() if group == "callbacks" else [file]:
            if "_target_" not in config:
                continue
            target = config["_target_"]
            try:
                signature = inspect.signature(get_class(target))
            except ValueError:
                signature = inspect.signature(get_method(target))
            # What its own defaults list chooses, by the key that it goes to.
            listed = [each for each in config.get("defaults", []) if isinstance(each, DictConfig)]
            chosen = {key.partition("@")[2] for each in listed for key in each}
            named = (set(config) | chosen) - {"_target_", "_partial_", "defaults"}
            assert named == set(signature.parameters) - {"args", "kwargs"}, f"{group}/{option}"


def test_classes_have_the_defaults_of_the_yaml_of_their_name():
    compared = 0
    for group in ("encoder", "field", "sampler", "loss", "correction", "scheduler", "path", "what", "optimizer"):
        for option in options(group):
            target = (file := loaded(group, option)).get("_target_", "")
            if target.split(".")[-2:-1] != [option]:
                continue
            for name, parameter in inspect.signature(get_class(target)).parameters.items():
                value = None if OmegaConf.is_interpolation(file, name) else file.get(name)
                value = tuple(value) if isinstance(value, ListConfig) else value
                if value is not None and parameter.default is not parameter.empty:
                    assert value == parameter.default, f"{group}/{option}: {name}"
                    compared += 1
    assert compared > 20


@pytest.mark.parametrize(
    ("command", "override", "kind"),
    [
        ("doctor", "json=3", "true or false"),
        ("train", "seed=null", "a number"),
        ("poses", "max_image_size=true", "a number"),
    ],
)
def test_a_commands_own_numbers_and_switches_take_no_other_kind(command, override, kind):
    key, _, value = override.partition("=")
    config = composed(command)
    OmegaConf.update(config, key, yaml.safe_load(value))
    with pytest.raises(InputError, match=f"^{key}=\\w+ is not valid: it must be {kind}"):
        require_kinds(config, command)


ENCODER = {"_target_": "nerf_lightning.nerf.encoders.frequency.FrequencyEncoder", "num_frequencies": 2}
LINEAR = {"_target_": "torch.nn.Linear", "in_features": 1, "out_features": 2}  # defined in another module


@pytest.mark.skipif(IS_1_3, reason="Hydra 1.3 has no whitelist")
def test_hydra_builds_from_a_file_only_what_lies_below_trusted_names():
    assert instantiate(ENCODER, names_of([])).out_dim == instantiate(ENCODER).out_dim
    assert isinstance(instantiate(LINEAR, names_of(["torch.nn"])), torch.nn.Linear)
    with pytest.raises(InstantiationException, match="whitelist"):
        instantiate(LINEAR, names_of(["mine"]))


def test_a_config_of_ones_own_may_name_anything():
    assert isinstance(instantiate(LINEAR), torch.nn.Linear)
