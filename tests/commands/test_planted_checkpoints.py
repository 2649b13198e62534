"""Checkpoints from strangers: nothing in them runs, nothing is written where they say, and they fill no memory."""

import os
import sys

import pytest
import torch
import yaml
from omegaconf import OmegaConf
from support.budget import budget
from support.planted import Payload, compress, in_config, many_bytes, peak_of, replace_pickle, write_checkpoint
from support.running import refused, said

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.instantiate import build
from nerf_lightning.config.load_model import load_model
from nerf_lightning.config.scene_overrides import scene_overrides

MEGABYTE = 2**20


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return write_checkpoint(tmp_path_factory.mktemp("sound") / "last.ckpt")


def commands(file, tmp_path, capture):
    """Every way by which a checkpoint is read."""
    out = f"paths.output_dir={tmp_path}/out"
    yield "render", f"ckpt={file}", out
    yield "eval", f"ckpt={file}", out
    yield "eval", f"ckpt={file}", "scene=npz", f"scene.path={capture}", out
    yield "train", "scene=npz", f"scene.path={capture}", "model=nerf_tiny", f"init_from={file}", out


def loaded(file):
    """Load a checkpoint's model, as the first thing that render does, and eval once it knows the scene."""
    return load_model(read_checkpoint(file))


def scene_of(file):
    """Look up a checkpoint's scene, as the first thing that eval does."""
    return scene_overrides(str(file))


def test_a_sound_one_is_rendered(nerf, sound, tmp_path):
    result = nerf(
        "render", f"ckpt={sound}", "path.num_frames=1", "path.width=8", "format=frames", f"paths.output_dir={tmp_path}"
    )
    assert result.code == 0, result.err


PICKLED = [
    lambda content, payload: content.update(more=payload),
    lambda content, payload: content["state_dict"].update({"model.x": payload}),
    lambda content, payload: content["nerf_lightning"].update(config=payload),
    lambda content, payload: content["nerf_lightning"]["scene"].update(name=payload),
]


@pytest.mark.parametrize("place", PICKLED)
def test_pickled_calls_do_not_run(nerf, capture, tmp_path, place):
    mark = tmp_path / "ran"
    file = write_checkpoint(tmp_path / "a.ckpt", lambda content: place(content, Payload(os.system, f"touch {mark}")))
    words = ("a.ckpt", "nothing from a file is executed")
    refused(loaded, file, parts=words)
    for command in commands(file, tmp_path, capture) if place is PICKLED[0] else ():
        said(nerf(*command), *words)
    assert not mark.exists()
    assert not (tmp_path / "out").exists()


def test_a_file_of_lpips_weights_does_not_run(nerf, sound, capture, tmp_path):
    mark, weights = tmp_path / "ran", tmp_path / "weights.pth"
    for legacy in (False, True):
        torch.save(
            {"features.0.weight": Payload(os.system, f"touch {mark}")},
            weights,
            _use_new_zipfile_serialization=not legacy,
        )
        result = nerf("eval", f"ckpt={sound}", "scene=npz", f"scene.path={capture}",
                      f"evaluation.lpips_weights={weights}", f"paths.output_dir={tmp_path}/out")  # fmt: skip
        said(result, "this is not a file of weights")
    assert not mark.exists()


TARGETS = [
    "builtins.exec",
    "torch.hub.load",
    "lightning.pytorch.loggers.csv_logs.os.system",
    "hydra.utils.instantiate",
    "nerf_lightning.nerf.models.base.torch.hub.load",
    "nerf_lightning.nerf.encoders.../../evil.Class",
    "nerf_lightning.commands.train.run",
    ["os.system"],
    {"_target_": "os.system"},
]


PLACES = [
    lambda model, evil: model.update(evil),
    lambda model, evil: model["levels"].update(extra=evil),
    lambda model, evil: model["levels"]["fine"]["field"].update(position_encoder=evil),
    lambda model, evil: model["levels"]["fine"]["field"].update(depth=[1, {"deep": [evil]}]),
]


@pytest.mark.parametrize(
    ("target", "place"), [*(("os.system", place) for place in PLACES), *((target, PLACES[2]) for target in TARGETS)]
)
def test_only_our_own_model_parts_are_built(nerf, tmp_path, target, place):
    mark, words = tmp_path / "ran", "which is not a model part of this program"
    evil = {"_target_": target, "command": f"touch {mark}"}
    file = write_checkpoint(tmp_path / "a.ckpt", in_config(lambda config: place(config["model"], evil)))
    refused(loaded, file, parts=(words,))
    if target == "os.system":
        for trust in ([], ["trust=[os,builtins]"]):  # a module that is trusted has no part of a model for that
            said(nerf("render", f"ckpt={file}", f"paths.output_dir={tmp_path}/out", *trust), words)
    assert not mark.exists()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", PLACES[:3])
def test_a_model_setting_that_no_part_has_is_refused(tmp_path, place):
    file = write_checkpoint(tmp_path / "a.ckpt", in_config(lambda c: place(c["model"], {"unheard_of": "/tmp/evil"})))
    refused(loaded, file, parts=("a.ckpt", "its model part"))


def test_what_lies_beside_the_model_is_not_built(nerf, tmp_path):
    """Callbacks, loggers and the rest of a recorded config are text."""
    mark = tmp_path / "ran"
    evil = {"_target_": "os.system", "command": f"touch {mark}"}

    def plant(config):
        config |= {part: {"x": dict(evil)} for part in ("callbacks", "logger", "trainer", "path", "data", "loss")}
        config["scene"] |= evil

    file = write_checkpoint(tmp_path / "a.ckpt", in_config(plant))
    result = nerf(
        "render",
        f"ckpt={file}",
        "path.num_frames=1",
        "path.width=8",
        "format=frames",
        f"paths.output_dir={tmp_path}/out",
    )
    assert result.code == 0, result.err
    assert not mark.exists()


@pytest.mark.parametrize("value", ["${oc.env:HOME}", "a${oc.env:HOME}", "${oc.create:{}}", "\\${x}"])
def test_the_environment_is_not_looked_up(nerf, tmp_path, value):
    file = write_checkpoint(tmp_path / "a.ckpt", in_config(lambda c: c["model"]["levels"]["fine"].update(note=value)))
    words = ("holds an interpolation", "which is not read from files")
    paragraph = refused(loaded, file, parts=words)
    assert os.environ["HOME"] not in paragraph.replace(str(tmp_path), "")
    if value == "${oc.env:HOME}":
        result = nerf("render", f"ckpt={file}", f"paths.output_dir={tmp_path}/out")
        said(result, *words)
        assert os.environ["HOME"] not in result.err.replace(str(tmp_path), "")


BAD_YAML = {
    "aliases": "a: &a [x, x]\n"
    + "".join(f"{n}: &{n} [*{p}, *{p}]\n" for p, n in zip("abcdefgh", "bcdefghi", strict=True)),
    "depth": "model: " + "[" * 900 + "]" * 900,
    "length": "model: '" + "x" * 2_000_000 + "'",
    "python": "model: !!python/object/apply:os.system ['touch ran']",
    "date": "model: 2001-99-99",
    "number": "model: !!int ''",
    "digits": "model: " + "9" * 10_000,
    "no mapping": "[1, 2]",
    "not yaml": "model: [",
}


@pytest.mark.parametrize("text", BAD_YAML.values(), ids=BAD_YAML)
@pytest.mark.parametrize(("command", "read"), [("render", loaded), ("eval", scene_of)])
def test_a_config_that_is_no_config(nerf, tmp_path, command, read, text):
    file = write_checkpoint(tmp_path / "a.ckpt", lambda content: content["nerf_lightning"].update(config=text))
    words = "it holds references" if "&a" in text else "The config in" if "model" in text else "damaged"
    words = "nerf_lightning.config has" if len(text) > 1_000_000 else words
    refused(read, file, parts=("a.ckpt", words))
    if text == BAD_YAML["depth"]:
        said(nerf(command, f"ckpt={file}", f"paths.output_dir={tmp_path}/out"), "a.ckpt", words)
    assert not (tmp_path / "out").exists()


def camera(**changed):
    return lambda content: content["nerf_lightning"]["scene"]["cameras"].update(changed)


def recorded(**changed):
    return lambda content: content["nerf_lightning"]["scene"].update(changed)


def state(**changed):
    return lambda content: content["nerf_lightning"].update(changed)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (camera(c2w=torch.zeros(3, 4)), "c2w"),
        (camera(width=torch.full((6,), 1 << 40)), "width"),
        (camera(height=torch.full((6,), 1 << 27), width=torch.full((6,), 1 << 27)), "pixels"),
        (camera(focal=torch.full((6, 2), float("nan"))), "focal holds NaN"),
        (camera(lens="pinhole"), "lens"),
        (camera(c2w=torch.zeros(6, 3, 4)), "a pose that is not a rotation"),
        (camera(c2w=torch.zeros(6, 3, 4, dtype=torch.float16)), "c2w holds float16, not float32"),
        (camera(focal=torch.zeros(6, 2)), "focal has numbers from 0 to 0, not 0.001 to"),
        (recorded(far=torch.full((6,), 3e38)), "far has numbers from 3e+38"),
        (recorded(near=torch.full((6,), 9.0), far=torch.full((6,), 8.0)), "near is not everywhere less than far"),
        (recorded(aabb=torch.tensor([[1.0] * 3, [-1.0] * 3])), "a lower corner that is not below the upper one"),
        (recorded(aabb=torch.zeros(2, 3)), "a lower corner that is not below the upper one"),
        (recorded(to_user=torch.zeros(4, 4)), "to_user is singular"),
        (recorded(to_user=torch.diag(torch.tensor([1.0, 2.0, 3.0, 1.0]))), "to_user is not a rotation, a scale"),
        (recorded(view_names=()), "view_names has 0 entries"),
        (recorded(view_names=("a\x00", *"bcdef")), r"a\x00', which holds control characters"),
        (recorded(view_names=("a\udc80", *"bcdef")), r"a\udc80', which holds control characters or is not UTF-8"),
        (recorded(view_names=("a" * 2000, *"bcdef")), "view_names[0] has 2,000 characters"),
        (recorded(more=1), "holds 'more', which no file of this program does"),
        (recorded(near=1.0), "near"),
        (recorded(aabb=torch.zeros(3)), "aabb"),
        (recorded(background="\x1b[2Jwhite"), "background"),
        (recorded(space="hyper"), "space"),
        (recorded(view_names=tuple("abc")), "view_names has 3 entries"),
        (recorded(splits={"train": (0, 99)}), "splits"),
        (recorded(splits=[1]), "splits"),
        (recorded(splits={"test": (0,)}), "splits lacks train"),
        (recorded(splits={"train": (), "test": (0,)}), "splits.train has 0 entries"),
        (recorded(splits={"train": (0, 1, 0)}), "splits.train names a view twice"),
        (recorded(view_names=("a",) * 6), "view_names names two views alike"),
        (state(precision="transformer-engine"), "precision"),
        (state(tile_points=-1), "tile_points"),
        (state(choices=["scene"]), "choices"),
        (state(config=3), "config"),
        (state(format=[[["1"]]]), "format a list"),
        (state(format=torch.zeros(2)), "format a tensor"),
    ],
)
def test_a_garbled_record_is_named(nerf, tmp_path, change, words):
    file = write_checkpoint(tmp_path / "a.ckpt", change)
    for command, read in (("render", loaded), ("eval", scene_of)):
        refused(read, file, parts=("a.ckpt", words))
        if words.startswith(("background", "format")):  # letters for a terminal, and one of those that nest themselves
            said(nerf(command, f"ckpt={file}", f"paths.output_dir={tmp_path}/out"), "a.ckpt", words)
    assert not (tmp_path / "out").exists()


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
        result = nerf("eval", f"ckpt={file}", "--cfg=job")
        assert result.code == 0, result.err
        (found,) = [yaml.safe_load(result.out)["scene"]]
        assert "planted" not in str(found), found
        assert found.get("allow_outside") in (None, False)
        assert "https://x/y" not in str(found)
    assert not (tmp_path / "planted").exists()


def test_of_a_recorded_scene_settings_that_nobody_decided_about_are_not_taken(tmp_path, monkeypatch, caplog):
    """Whether the yaml of this name has them, or not."""
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "mine.yaml").write_text("_target_: mine.Reader\nroot: ???\nunheard_of: null\n")
    monkeypatch.setattr("nerf_lightning.files.folders.conf_folder", lambda: tmp_path)
    scene = {"root": "data", "unheard_of": "/tmp/evil", "not\x1b[2J in_it": 1, "allow_outside": True}
    file = write_checkpoint(tmp_path / "a.ckpt", state(choices={"scene": "mine"}), scene=scene)
    assert scene_of(file) == ["scene=mine", "scene.root='data'"]
    (said_once,) = [record.getMessage() for record in caplog.records]
    assert "scene.unheard_of" in said_once
    assert "scene.not\\x1b[2J in_it" in said_once
    assert "are not taken from a file. Give them by hand" in said_once
    assert "allow_outside" not in said_once


def test_links_beside_a_checkpoint_do_not_lead_out(nerf, sound, tmp_path):
    outside, run = tmp_path / "outside", tmp_path / "run"
    outside.mkdir()
    (run / "checkpoints").mkdir(parents=True)
    file = run / "checkpoints" / "last.ckpt"
    file.write_bytes(sound.read_bytes())
    short = ("path.num_frames=1", "path.width=8", "format=frames")
    (run / "render").symlink_to(outside)
    said(nerf("render", f"ckpt={file}", *short), "render is a symbolic link to", "paths.output_dir=DIR")
    (run / "render").unlink()
    (run / "render").mkdir()
    (run / "render" / "video").symlink_to(outside)
    said(nerf("render", f"ckpt={file}", *short), "video is a symbolic link to", "paths.output_dir=DIR")
    assert list(outside.iterdir()) == []


def bombs(folder):
    """Small files that ask for much memory, each with words of its refusal."""
    write_checkpoint(folder / "deflated.ckpt", lambda content: content.update(zeros=torch.zeros(50 * MEGABYTE // 4)))
    compress(folder / "deflated.ckpt")
    write_checkpoint(folder / "bytes.ckpt")
    replace_pickle(folder / "bytes.ckpt", many_bytes(2_000 * MEGABYTE))
    write_checkpoint(
        folder / "wide.ckpt", in_config(lambda c: c["model"]["levels"]["fine"]["field"].update(width=30_000))
    )
    write_checkpoint(
        folder / "deep.ckpt", in_config(lambda c: c["model"]["levels"]["fine"]["field"].update(depth=10**7, skip=None))
    )
    write_checkpoint(
        folder / "repeated.ckpt",
        lambda content: content["state_dict"].update({"model.x": torch.zeros(1).expand(10**9)}),
    )
    write_checkpoint(folder / "described.ckpt")
    replace_pickle(folder / "described.ckpt", b"\x80\x02" + b"]" * 17 * MEGABYTE + b".")
    return {
        "deflated": "was made to fill the memory",
        "bytes": "nothing from a file is executed",
        "wide": "its config describes a model of",
        "deep": "give 1 to 100 layers",
        "repeated": "repeats few numbers",
        "described": "bytes beside its numbers",
    }


@pytest.mark.skipif(sys.platform != "linux", reason="the peak of the resident memory is read from /proc")
@pytest.mark.slow
def test_bombs_stay_small(tmp_path):
    expected = bombs(tmp_path)
    code = (
        "from nerf_lightning.checkpoints.reading import read_checkpoint\n"
        "from nerf_lightning.config.load_model import load_model\n"
        "from nerf_lightning.messages.errors import InputError\n"
        "load_model(read_checkpoint(sys.argv[1]))\n"
        "# begin\n"
        "for path in sys.argv[2:]:\n"
        "    try:\n"
        "        load_model(read_checkpoint(path))\n"
        "    except InputError as error:\n"
        "        print(path.rpartition('/')[2], error)\n"
    )
    sound = write_checkpoint(tmp_path / "sound.ckpt")
    grown, lines = peak_of(code, sound, *[tmp_path / f"{name}.ckpt" for name in expected])
    for name, words in expected.items():
        assert [line for line in lines if line.startswith(f"{name}.ckpt") and words in line], (name, lines)
    assert grown < 100 * MEGABYTE, grown


@pytest.mark.parametrize("level", ["coarse", "fine"])
def test_more_samples_than_agreed_are_not_taken(tmp_path, level):
    def many(config):
        config["model"]["levels"][level]["sampler"]["num_samples"] = 10**7

    file = write_checkpoint(tmp_path / "a.ckpt", in_config(many))
    refused(loaded, file, parts=("a.ckpt", "samples along a ray", "add budgets.samples_per_ray=1000"))
    with budget(samples_per_ray=10**8):
        loaded(file)


SAMPLER = "nerf_lightning.nerf.samplers.occupancy.OccupancySampler"
FREQUENCY = "nerf_lightning.nerf.encoders.frequency.FrequencyEncoder"
GRID = "nerf_lightning.nerf.encoders.hash_grid.HashGridEncoder"
FIELD = "nerf_lightning.nerf.fields.hash_field.HashField"
IMPOSSIBLE = [
    *({"sampler": {"_target_": SAMPLER, key: value}} for key, value in (
        ("num_steps", 0), ("num_steps", -1), ("num_cascades", 0), ("num_cascades", 60), ("cone_angle", -1e-3),
        ("cone_angle", 1e9), ("update_every", 0), ("warmup_steps", -1), ("prune_after", -1), ("decay", 2.0),
        ("decay", -1.0), ("min_alpha", -1.0), ("opaque_below", -1.0), ("opaque_below", 2.0), ("capacity", 0),
    )),
    {"sampler": {"_target_": "nerf_lightning.nerf.samplers.importance.ImportanceSampler", "num_samples": -1}},
    {"field": {"position_encoder": {"_target_": FREQUENCY, "num_frequencies": 10_000}}},
    {"field": {"position_encoder": {"_target_": FREQUENCY, "num_frequencies": -1}}},
    {"field": {"position_encoder": {"_target_": GRID, "max_resolution": 1 << 40}}},
    {"field": {"_target_": FIELD, "feature_dim": 0}},
    {"field": {"_target_": FIELD, "width": 0}},
    {"field": {"width": 1}},
]  # fmt: skip


@pytest.mark.parametrize("part", IMPOSSIBLE, ids=lambda part: str(part)[-60:])
def test_settings_that_no_model_has_are_named(tmp_path, part):
    def change(config):
        level = config["model"]["levels"]["fine"]
        level["sampler"] |= {"num_samples": 3}
        for name, settings in part.items():
            if "_target_" in settings:
                encoders = {key: value for key, value in level[name].items() if key.endswith("_encoder")}
                level[name] = encoders | settings
            else:
                level[name] |= settings

    file = write_checkpoint(tmp_path / "a.ckpt", in_config(change))
    refused(loaded, file, parts=("a.ckpt: its model part cannot be built", ": give "))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30, -(10**30)], ids=lambda value: str(value)[:9])
@pytest.mark.parametrize("key", ["density_bias", "note"])
def test_numbers_that_no_model_has_are_named(tmp_path, key, value):
    change = in_config(lambda c: c["model"]["levels"]["fine"]["field"].update({key: value}))
    file = write_checkpoint(tmp_path / "a.ckpt", change)
    refused(loaded, file, parts=("a.ckpt", "its model part holds the number"))


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


YAML_NUMBER = {"hex": "0x" + "f" * 5000, "clock": ":".join(["1"] * 3000)}
YAML_PLAIN = {
    "a day": "[2001-01-01]",
    "a set": "!!set {a, b}",
    "keys of two kinds": "{1: 1, b: 2}",
    "a day as key": "{2001-01-01: 1}",
    "bytes": "!!binary aGk=",
}


@pytest.mark.parametrize("value", [*YAML_NUMBER.values(), *YAML_PLAIN.values()], ids=[*YAML_NUMBER, *YAML_PLAIN])
def test_values_that_no_config_of_ours_holds_are_refused(tmp_path, value):
    """They would be found out only where they are written: in the hash of a measurement's settings."""

    def change(content):
        content["nerf_lightning"]["config"] += f"\nmore: [{value}]\n"

    file = write_checkpoint(tmp_path / "a.ckpt", change)
    refused(loaded, file, parts=("The config in", "a.ckpt", "holds a value that cannot be read"))


@pytest.mark.parametrize("path", ["x" * 5000, "a\0b"], ids=["long", "nul"])
def test_a_recorded_place_that_no_file_can_have_is_not_taken(tmp_path, path):
    file = write_checkpoint(tmp_path / "a.ckpt", state(choices={"scene": "lego_tiny"}), scene={"path": path})
    assert not [line for line in scene_of(str(file)) if line.startswith("scene.path=")]


def test_a_model_without_a_level_is_refused(tmp_path):
    file = write_checkpoint(tmp_path / "a.ckpt", in_config(lambda c: c["model"].update(levels={})))
    content = torch.load(file, weights_only=True)
    content["state_dict"] = {}
    torch.save(content, file)
    refused(load_model, read_checkpoint(file), parts=("has no level (model.levels is empty)",))
