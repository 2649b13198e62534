"""One table says what each setting means; what it does not list is taken from nobody but the person who types."""

import inspect
import re
from collections import Counter
from collections.abc import Sequence
from functools import cache
from types import UnionType
from typing import Union, get_args, get_origin

from hydra.utils import get_object
from omegaconf import DictConfig, OmegaConf
from support.configs import composed, groups, loaded, options

from nerf_lightning.cli.main import find_commands
from nerf_lightning.config.overrides import flatten
from nerf_lightning.config.setting_rules import CHOSEN_GROUPS, ROWS, Trust, meaning_of, names_a_class, row_of
from nerf_lightning.files.folders import conf_file, conf_folder

ELSEWHERE = {"sampler": "model.levels.fine.sampler"}
"""Where the options of a group go that has no section of its own."""
OF_A_KEY = re.compile(r"[a-z]\w*(\.[a-z]\w*)*(\.\*\*?)?")


@cache
def keys_of_conf():
    """Return each key of each command's config, and of each option of each group, with its values.

    Commands of extensions make no run, and nothing of them is taken from a file.
    """
    parts = [composed(command) for command in find_commands() if conf_file(command).parent == conf_folder()]
    for group in set(groups()) - {"hydra"}:
        for option in options(group):
            content = loaded(group, option)
            content.pop("defaults", None)
            is_global = "@package _global_" in conf_file(f"{group}/{option}").read_text()
            section = ELSEWHERE.get(group, group)
            parts.append(content if is_global else nested(section, content))
    found = {}
    for part in filter(None, parts):
        for key, value in flatten(part).items():
            found.setdefault(key, []).append(value)
    return found


def nested(section, content):
    for word in reversed(section.split(".")):
        content = {word: content}
    nested_config = OmegaConf.create(content)
    assert isinstance(nested_config, DictConfig)
    return nested_config


def test_no_entry_stands_twice_and_each_is_of_a_key():
    entries = Counter(key for _, keys in ROWS for key in keys.split())
    assert [key for key, count in entries.items() if count > 1] == []
    assert [key for key in entries if not OF_A_KEY.fullmatch(key)] == []
    used = {row_of(key) for key in keys_of_conf()}
    # What a constructor has and its yaml leaves out, or Lightning's Trainer has.
    unseen = {"model", "scene", "trainer.lightning.fast_dev_run", "callbacks.checkpoints.monitor"}
    assert {key for key in entries if not key.startswith("hydra.")} - used - unseen == set()


def test_every_setting_and_every_group_is_decided_about():
    settings = {key for key in flatten(composed("train")) if not names_a_class(key)}
    assert [key for key in settings if row_of(key) is None] == []
    others = {"hydra", "logger", "folders", "budgets", "viewer", "what"}
    assert {*CHOSEN_GROUPS} | others == {*groups(), "hydra"} - {"final"}  # of which nothing is chosen
    for group in others:
        assert meaning_of(group).trust in (Trust.ONE_START, Trust.NOTHING), group


def test_a_room_that_is_trusted_as_a_whole_has_no_texts_but_words():
    """Else one of its settings may be a path, and deserves a line of its own."""
    for key, values in keys_of_conf().items():
        if meaning_of(key).trust is Trust.WORDS:
            texts = [value for value in values if isinstance(value, str) and not value.startswith("${")]
            assert [text for text in texts if not Trust.WORDS.takes(text)] == [], key
    for group in set(groups()) - {"hydra"}:
        for option in options(group):
            target = loaded(group, option).get("_target_", "")
            for name, parameter in inspect.signature(get_object(target)).parameters.items() if target else ():
                if str in texts_in(parameter.annotation):
                    assert meaning_of(f"{ELSEWHERE.get(group, group)}.{name}").trust is not Trust.WORDS, (target, name)


def texts_in(annotation):
    """Return the kinds of plain values and of lists of them that an annotation allows."""
    if get_origin(annotation) in (Union, UnionType, list, Sequence):
        return [kind for each in get_args(annotation) for kind in texts_in(each)]
    return [annotation]


def test_what_is_new_has_the_row_of_its_group_and_of_the_name_of_a_class_nothing_is_taken():
    assert meaning_of("scene.of_a_new_reader").trust is Trust.PLAIN
    assert meaning_of("scene.of_a_new_reader").learnt
    for key in ("field.of_a_new_field", "loss.terms.of_a_new_loss", "callbacks.mine.port", "trainer.unheard_of"):
        assert meaning_of(key).trust in (Trust.WORDS, Trust.PLAIN)
    for key in ("unheard_of", "model._target_", "scene._target_", "model.levels.fine._args_", "_target_.x"):
        assert meaning_of(key).trust is Trust.NOTHING
