"""Paths are read as they were typed, or pasted from what a sweep has said; words that are no settings are told."""

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from support.running import refused

from nerf_lightning.cli.arguments import quoted_paths, require_settings, unquoted
from nerf_lightning.cli.prepare import sweep_arguments

PATHS = ["a=b,c", "my fox (1)", "[2024] fox", "新加卷/数据 1", "fox é", "2024", "1e3", "it's", "C:\\my fox", "~/fox"]
KEYS = ["scene.root", "images", "+scene.images", "paths.output_dir", "x.depth_file", "checkpoint", "ckpt", "run"]


def read(word, sweep=False):
    (override,) = OverridesParser.create().parse_overrides(quoted_paths([word], sweep))
    if override.is_sweep_override():
        return [str(part).strip("'") for part in override.sweep_string_iterator()]
    return override.value()


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("key", KEYS)
def test_settings_with_the_name_of_a_path_take_any(key, path):
    assert read(f"{key}={path}") == path


@pytest.mark.parametrize("sweep", [False, True])
@pytest.mark.parametrize("path", ["a=b,c", "my fox (1)", "choice(a,b)", "新加卷/数据 1"])
@pytest.mark.parametrize("key", ["scene.path", "scene.root"])
def test_what_exists_is_one_path(tmp_path, monkeypatch, key, path, sweep):
    monkeypatch.chdir(tmp_path)
    (tmp_path / path).mkdir(parents=True)
    assert read(f"{key}={path}", sweep) == path
    assert key not in sweep_arguments(["-m", *quoted_paths([f"{key}={path}"], True)])[-1]


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("scene.root=fox,data/my fox", ["fox", "data/my fox"]),
        ("ckpt=out/0_seed=0, out/1_seed=1", ["out/0_seed=0", "out/1_seed=1"]),
        ("scene.root='a,b',c", ["a,b", "c"]),
        ("scene.root=choice(a,b)", ["a", "b"]),
        ("final.video=true,false", ["True", "False"]),
        ("seed=0,1", ["0", "1"]),
        ("paths.output_dir=out/lr=1,b", "out/lr=1,b"),
    ],
)
def test_a_sweep_lists_values_by_commas(word, value):
    assert read(word, sweep=True) == value


@pytest.mark.parametrize(
    "word",
    [
        *("ckpt='a=b'", "ckpt=a\\=b", "scene.root=[a,b]", "scene.root=${x} y", "scene.root=", "scene.root=data/fox"),
        *("final.video=true", "scene.cache_dir=null", "scene.name=my fox", "seed=0", "--cfg=job", "~x.root=a b"),
    ],
)
def test_what_hydra_shall_read_itself_stays(word):
    assert quoted_paths([word], sweep=False) == [word]


@pytest.mark.parametrize(("there", "word"), [("0_scene.root=a,b", "0_scene.root=a,b"), ("0", "seed=0")])
def test_a_path_alone_stays_and_a_number_of_something_else(tmp_path, monkeypatch, there, word):
    monkeypatch.chdir(tmp_path)
    (tmp_path / there).mkdir()
    assert quoted_paths([word], sweep=False) == [word]


def test_quotes_come_off_again():
    words = quoted_paths([f"run={path}" for path in PATHS], sweep=False)
    assert [unquoted(word.removeprefix("run=")) for word in words] == PATHS


@pytest.mark.parametrize("typed", ["scene.root= data/x", "scene = bricks", "scene.root data/x", "scene =bricks"])
def test_spaces_around_the_equals_sign_are_told_in_one_paragraph_and_options_and_empty_values_pass(typed):
    require_settings(["--multirun", "~callbacks.film", "logger.name=", "a=b=c"], False)
    require_settings(["--multirun", "out"], True)
    told = "Settings are key=value without spaces, such as scene.root=data/x"
    refused(require_settings, ["seed=1", *typed.split()], False, parts=(told,))
    if "=" in typed:  # where a path may stand alone, too
        refused(require_settings, typed.split(), True, parts=("without spaces",))
