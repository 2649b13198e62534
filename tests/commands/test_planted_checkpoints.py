"""Checkpoints from strangers: nothing in them runs, nothing is written where they say, and they fill no memory."""

import os

import pytest
import torch
import yaml
from omegaconf import OmegaConf
from support.budget import budget
from support.planted import Payload, compress, in_config, many_bytes, replace_pickle, write_checkpoint
from support.running import done, refused, said

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.checkpoints.trusted_classes import require_trusted
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import load_model
from nerf_lightning.config.scene_overrides import scene_overrides
from nerf_lightning.messages.errors import InputError

MEGABYTE = 2**20


def loaded(file):
    """Load a checkpoint's model, as the first thing that render does, and eval once it knows the scene."""
    return load_model(read_checkpoint(file))


def scene_of(file):
    """Look up a checkpoint's scene, as the first thing that eval does."""
    return scene_overrides(str(file))


def test_pickled_calls_do_not_run(nerf, capture, tmp_path):
    mark = tmp_path / "ran"
    payload = Payload(os.system, f"touch {mark}")
    file = write_checkpoint(tmp_path / "a.ckpt", lambda content: content["state_dict"].update({"model.x": payload}))
    train = ("train", "scene=npz", f"scene.path={capture}", "model=nerf_tiny", f"init_from={file}")
    for command in (("render", f"ckpt={file}"), ("eval", f"ckpt={file}"), train):
        told = nerf(*command, f"paths.output_dir={tmp_path}/out")
        said(told, "a.ckpt", "nothing from a file is executed")
    assert not mark.exists()
    assert not (tmp_path / "out").exists()


TARGETS = [
    "os.system",
    "lightning.pytorch.loggers.csv_logs.os.system",
    "nerf_lightning.nerf.models.base.torch.hub.load",
    "nerf_lightning.nerf.encoders.../../evil.Class",
    "nerf_lightning.nerf.fields.nerf_mlp.Encoder",
    "nerf_lightning.nerf.encoders.nothing.Here",
    ["os.system"],
]
PLACES = [
    lambda model, evil: model.update(evil),
    lambda model, evil: model["levels"].update(extra=evil),
    lambda model, evil: model["levels"]["fine"]["field"].update(position_encoder=evil),
    lambda model, evil: model["levels"]["fine"]["field"].update(depth=[1, {"deep": [evil]}]),
]


@pytest.mark.parametrize(
    ("target", "place"), [*(("os.system", place) for place in PLACES), *((target, PLACES[2]) for target in TARGETS[1:])]
)
def test_only_our_own_model_parts_are_built(nerf, tmp_path, target, place):
    mark, words = tmp_path / "ran", "which is not a model part of this program"
    evil = {"_target_": target, "command": f"touch {mark}"}
    file = write_checkpoint(tmp_path / "a.ckpt", in_config(lambda config: place(config["model"], evil)))
    refused(loaded, file, parts=(words,))
    if place is PLACES[0]:
        for trust in ([], ["trust=[os,builtins]"]):  # a module that is trusted has no part of a model for that
            said(nerf("render", f"ckpt={file}", f"paths.output_dir={tmp_path}/out", *trust), words)
    assert not mark.exists()
    assert not (tmp_path / "out").exists()


HYDRAS = [{"_args_": [{"x": 1}]}, {"_args_": {"x": 1}}, {"_convert_": {}}, {"_target_": []}, {"_target_": {"x": 1}}]


@pytest.mark.parametrize("setting", HYDRAS, ids=str)
def test_hydras_own_keys_are_refused_whatever_they_hold(setting):
    with pytest.raises(InputError, match=r"is not (read from files|a model part)"):
        require_trusted({"levels": {"fine": {"field": setting}}}, "a.ckpt")


def test_what_lies_beside_the_model_is_not_built(nerf, tmp_path):
    """Callbacks, loggers and the rest of a recorded config are text."""
    mark = tmp_path / "ran"
    evil = {"_target_": "os.system", "command": f"touch {mark}"}

    def plant(config):
        config |= {part: {"x": dict(evil)} for part in ("callbacks", "logger", "trainer", "path", "data", "loss")}
        config["scene"] |= evil

    file = write_checkpoint(tmp_path / "a.ckpt", in_config(plant))
    small = ("path.num_frames=1", "path.width=8", "format=frames", f"paths.output_dir={tmp_path}/out")
    done(nerf("render", f"ckpt={file}", *small))
    assert not mark.exists()


def test_the_environment_is_not_looked_up(nerf, tmp_path):
    change = in_config(lambda c: c["model"]["levels"]["fine"].update(note="a${oc.env:HOME}"))
    file = write_checkpoint(tmp_path / "a.ckpt", change)
    result = nerf("render", f"ckpt={file}", f"paths.output_dir={tmp_path}/out")
    said(result, "holds note: a${oc.env:HOME}", "which is not read from files")
    assert os.environ["HOME"] not in result.err.replace(str(tmp_path), "")


BAD_YAML = {
    "aliases": "a: &a [x, x]\nb: [*a, *a]\n",
    "merges": "- &a {x: 1}\n- &b {<<: [*a, *a]}\n",
    "depth": "model: " + "[" * 900 + "]" * 900,
    "length": "model: '" + "x" * 2_000_000 + "'",
    "python": "model: !!python/object/apply:os.system ['touch ran']",
    "date": "model: 2001-99-99",
    "set": "model: !!set {a, b}",
    "digits": "model: " + "9" * 10_000,
    "no mapping": "[1, 2]",
}


@pytest.mark.parametrize("text", BAD_YAML.values(), ids=BAD_YAML)
def test_a_config_that_is_no_config(nerf, tmp_path, text):
    file = write_checkpoint(tmp_path / "a.ckpt", lambda content: content["nerf_lightning"].update(config=text))
    for read in (loaded, scene_of):
        refused(read, file, parts=("a.ckpt",))
    if text == BAD_YAML["depth"]:
        said(nerf("render", f"ckpt={file}", f"paths.output_dir={tmp_path}/out"), "a.ckpt", "The config in")
    assert not (tmp_path / "out").exists()


def camera(**changed):
    return lambda content: content["nerf_lightning"]["scene"]["cameras"].update(changed)


def recorded(**changed):
    return lambda content: content["nerf_lightning"]["scene"].update(changed)


def state(**changed):
    return lambda content: content["nerf_lightning"].update(changed)


RECORDS = {
    "fewer": (camera(focal=torch.ones(3, 2)), "focal holds torch.float32 in the shape (3, 2), not Float in (*views 2)"),
    "NaN": (camera(focal=torch.full((6, 2), float("nan"))), "focal holds NaN"),
    "no poses": (camera(c2w=torch.zeros(6, 3, 4)), "a pose that is not a rotation"),
    "far away": (camera(center=torch.full((6, 2), 3e38)), "center has numbers beyond 1e+09"),
    "no lens": (camera(focal=torch.zeros(6, 2)), "focal is not at least 0.001"),
    "too many pixels": (camera(height=torch.full((6,), 1 << 27), width=torch.full((6,), 1 << 27)), "pixels in one"),
    "no pixels": (camera(height=torch.zeros(6, dtype=torch.int64)), "width is not above 0"),
    "no extent": (recorded(far=torch.zeros(6)), "near is not everywhere from 0"),
    "no box": (recorded(aabb=torch.zeros(2, 3)), "aabb has no inside"),
    "no frame": (recorded(to_user=torch.diag(torch.tensor([1.0, 2.0, 3.0, 1.0])).double()), "to_user is not a rot"),
    "no views": (recorded(view_names=()), "names 0 views, and there are 6 cameras"),
    "views alike": (recorded(view_names=("a",) * 6), "view_names names two views alike"),
    "a long name": (recorded(view_names=("a" * 2000, *"bcdef")), "more than 1024 characters"),
    "a terminal's name": (recorded(view_names=("a\x1b[2J", *"bcdef")), "which holds control characters"),
    "other views": (recorded(splits={"train": (0, 99)}), "splits.train names views that are not among the 6"),
    "nothing to train on": (recorded(splits={"test": (0,)}), "splits has no views to train on"),
    "an unknown key": (recorded(more=1), "more belongs to no file of this kind"),
    "an unknown word": (recorded(background="\x1b[2Jwhite"), "background is '\\x1b[2Jwhite', not white or"),
    "another format": (state(format=[[["1"]]]), "format a list"),
}


@pytest.mark.parametrize(("change", "words"), RECORDS.values(), ids=RECORDS)
def test_the_first_difference_of_a_record_is_named(nerf, tmp_path, change, words):
    file = write_checkpoint(tmp_path / "a.ckpt", change)
    for read in (loaded, scene_of):
        refused(read, file, parts=("a.ckpt", words))
    if words.startswith("background"):  # letters for a terminal
        said(nerf("render", f"ckpt={file}", f"paths.output_dir={tmp_path}/out"), "a.ckpt", "background is")
    assert not (tmp_path / "out").exists()


def test_test_views_that_were_trained_on_are_said_once(tmp_path, caplog):
    apart, overlapping = {"train": (0, 1, 2), "val": (3, 4), "test": (3, 4)}, {"train": (0, 1, 2), "test": (2, 3)}
    for _ in range(2):
        loaded(write_checkpoint(tmp_path / "a.ckpt", recorded(splits=apart)))
        loaded(write_checkpoint(tmp_path / "b.ckpt", recorded(splits=overlapping)))
    (said_once,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert "b.ckpt: 1 of 3 training views are also validation or test views (ball_2), whose scores say" in said_once


WEIGHT = "model.levels.fine.field.feature.weight"
WEIGHTS = {
    "missing": (lambda weights: weights.pop(WEIGHT), "Missing key"),
    "another shape": (lambda weights: weights.update({WEIGHT: weights[WEIGHT][:1]}), "size mismatch"),
    "infinite": (lambda weights: weights.update({WEIGHT: weights[WEIGHT] / 0}), "holds NaN or infinity"),
    "of no part": (lambda weights: weights.update({"x": torch.zeros(1)}), "belongs to no part of a run"),
}


@pytest.mark.parametrize(("change", "words"), WEIGHTS.values(), ids=WEIGHTS)
def test_weights_have_the_keys_shapes_and_dtypes_that_the_config_says(tmp_path, change, words):
    file = write_checkpoint(tmp_path / "a.ckpt", lambda content: change(content["state_dict"]))
    refused(loaded, file, parts=("a.ckpt", words))


def test_a_recorded_scene_says_neither_where_to_write_nor_what_to_fetch_nor_how_far_to_trust(
    nerf, tmp_path, monkeypatch
):
    def no_way_out(*arguments, **options):
        raise AssertionError("nothing is fetched")

    monkeypatch.setattr("urllib.request.urlopen", no_way_out)
    scene = {"cache_dir": f"{tmp_path}/planted", "download": {"url": "https://x/y", "bytes": 3, "sha256": None}}
    scene |= {"allow_outside": True, "path": f"{tmp_path}/planted/file", "root": f"{tmp_path}/none"}
    for name in ("bricks", "lego_tiny", "colmap", "transforms", "blender"):
        file = write_checkpoint(tmp_path / "a.ckpt", state(choices={"scene": name}), scene=scene)
        result = done(nerf("eval", f"ckpt={file}", "--cfg=job"))
        (found,) = [yaml.safe_load(result.out)["scene"]]
        assert "planted" not in str(found), found
        assert found.get("allow_outside") in (None, False)
        assert "https://x/y" not in str(found)
    assert not (tmp_path / "planted").exists()


def test_of_a_recorded_scene_settings_that_our_yaml_lacks_are_not_taken(tmp_path, monkeypatch, caplog):
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine.yaml").write_text(
        "_target_: mine.Reader\nroot: ???\nmasks: null\nnear: null\nof_mine: null\n"
    )
    monkeypatch.setattr("nerf_lightning.files.folders.conf_folder", lambda: tmp_path)
    scene = {"root": "data", "of_mine": 3, "not\x1b[2J in_it": 1}
    scene |= {"allow_outside": True, "masks": "../../etc", "near": float("nan")}
    file = write_checkpoint(tmp_path / "a.ckpt", state(choices={"scene": "mine"}), scene=scene)
    assert scene_of(file) == ["scene=mine", "scene.root='data'", "scene.of_mine=3"]
    assert "\x1b" not in caplog.text
    assert "scene.near" in caplog.text
    assert "scene.masks" in caplog.text
    assert "does not take them from a file. If they are yours" in caplog.text


def bombs(folder):
    """Small files that ask for much memory, each with words of its refusal."""
    write_checkpoint(folder / "deflated.ckpt", lambda content: content.update(zeros=torch.zeros(50 * MEGABYTE // 4)))
    compress(folder / "deflated.ckpt")
    write_checkpoint(folder / "bytes.ckpt")
    replace_pickle(folder / "bytes.ckpt", many_bytes(2_000 * MEGABYTE))
    write_checkpoint(folder / "wide.ckpt", in_config(lambda c: fine(c)["field"].update(width=30_000)))
    write_checkpoint(folder / "deep.ckpt", in_config(lambda c: fine(c)["field"].update(depth=10**7, skip=None)))
    repeated = {"model.x": torch.zeros(1).expand(10**9)}
    write_checkpoint(folder / "repeated.ckpt", lambda content: content["state_dict"].update(repeated))
    write_checkpoint(folder / "described.ckpt")
    replace_pickle(folder / "described.ckpt", b"\x80\x02" + b"]" * 17 * MEGABYTE + b".")
    return {
        "deflated": "holds a compressed entry",
        "bytes": "nothing from a file is executed",
        "wide": "its config describes a model of",
        "deep": "give 1 to 100 layers",
        "repeated": "repeats few numbers",
        "described": "data.pkl, several, or one that is too large",
    }


def test_bombs_are_refused(tmp_path):
    for name, words in bombs(tmp_path).items():
        refused(loaded, tmp_path / f"{name}.ckpt", parts=(f"{name}.ckpt", words))


def fine(config):
    return config["model"]["levels"]["fine"]


OCCUPANCY = {"_target_": "nerf_lightning.nerf.samplers.occupancy.OccupancySampler", "num_steps": 0}
CONFIGS = {
    "an unknown key": (lambda c: fine(c)["field"].update(unheard_of="x"), ("its model part",)),
    "a key of Hydra's": (lambda c: fine(c)["field"].update(_partial_="x"), ("its model part",)),
    "no steps": (lambda c: fine(c).update(sampler=OCCUPANCY), ("its model part cannot be built", ": give ")),
    "no width": (lambda c: fine(c)["field"].update(width=1), ("its model part cannot be built", ": give ")),
    "NaN": (lambda c: fine(c)["field"].update(density_bias=float("nan")), ("its model part holds the number",)),
    "a huge number": (lambda c: fine(c)["field"].update(density_bias=1e30), ("its model part holds the number",)),
    "no level": (lambda c: c["model"].update(levels={}), ("has no level (model.levels is empty)",)),
    "too many samples": (
        lambda c: fine(c)["sampler"].update(num_samples=10**7),
        ("samples along a ray", "add budgets.samples_per_ray=1000"),
    ),
}


@pytest.mark.parametrize(("change", "words"), CONFIGS.values(), ids=CONFIGS)
def test_settings_that_no_model_has_are_named(tmp_path, change, words):
    def changed(content):
        in_config(change)(content)
        if "levels is empty" in words[0]:
            content["state_dict"] = {}

    refused(loaded, write_checkpoint(tmp_path / "a.ckpt", changed), parts=("a.ckpt", *words))


def test_wider_layers_than_agreed_are_not_taken(tmp_path):
    def wide(content):
        change = in_config(lambda c: c["model"]["levels"]["fine"]["field"].update(width=300))
        change(content)
        parts = build(OmegaConf.create(yaml.safe_load(content["nerf_lightning"]["config"])).model)
        content["state_dict"] = {f"model.{name}": tensor for name, tensor in parts.state_dict().items()}

    file = write_checkpoint(tmp_path / "a.ckpt", wide)
    loaded(file)
    with budget(layer_width=256):
        refused(loaded, file, parts=("a.ckpt", "features of one point", "add budgets.layer_width=3"))


@pytest.mark.parametrize("path", ["x" * 5000, "a\0b"], ids=["long", "nul"])
def test_a_recorded_place_that_no_file_can_have_is_not_taken(tmp_path, path):
    file = write_checkpoint(tmp_path / "a.ckpt", state(choices={"scene": "lego_tiny"}), scene={"path": path})
    assert not [line for line in scene_of(str(file)) if line.startswith("scene.path=")]
