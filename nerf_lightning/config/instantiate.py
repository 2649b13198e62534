"""The constructor's signature is the schema: values of the wrong type are reported before anything is built."""

import inspect
import types
from functools import cache
from pathlib import Path
from pydoc import locate
from typing import Any, Literal, Union, get_args, get_origin

from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.hydra_versions import instantiate
from nerf_lightning.files.folders import conf_file
from nerf_lightning.messages.errors import InputError

OURS = "nerf_lightning."
PLAIN = (bool, int, float, str, type(None))


def require_fitting_values(node: Any, path: str = "") -> None:
    """Check a config against the signatures of the classes that it names, including nested ones."""
    if OmegaConf.is_config(node):
        node = OmegaConf.to_container(node, resolve=True)
    if isinstance(node, list):
        for index, child in enumerate(node):
            require_fitting_values(child, f"{path}[{index}]")
    elif isinstance(node, dict):
        parameters = _parameters(node.get("_target_"), path)
        for key, value in node.items():
            here = f"{path}.{key}" if path else str(key)
            if key in parameters:
                require_fitting(value, parameters[key].annotation, here)
            require_fitting_values(value, here)


def required_path(key: str, value: object) -> str:
    """Return a setting that names a file or folder."""
    if not isinstance(value, str) or not value:
        raise InputError(f"{key}={value} is not valid: it must be a path.")
    return value


def require_kinds(config: DictConfig, command: str) -> None:
    """Refuse values of another kind than in the command's own YAML: a word in place of a section, switch or number."""
    for key, default in _own_settings(conf_file(command)).items():
        if key not in config or OmegaConf.is_missing(config, key):
            continue
        if isinstance(default, dict) and not isinstance(config[key], DictConfig):
            raise InputError(
                f"{key}={config[key]} is not valid: it holds settings, such as {key}.{next(iter(default))}=VALUE."
            )
        if isinstance(default, bool | int | float):
            require_fitting(config[key], bool if isinstance(default, bool) else float, key)


@cache
def _own_settings(file: Path) -> dict[str, Any]:
    """Return the content of one of our YAMLs."""
    sections = OmegaConf.to_container(OmegaConf.load(file), resolve=False)
    assert isinstance(sections, dict)
    return {str(key): section for key, section in sections.items()}


def _parameters(target: object, path: str) -> dict[str, inspect.Parameter]:
    # Only our own: annotations of others promise less.
    if not isinstance(target, str) or not target.startswith(OURS):
        return {}
    found = locate(target)
    if not callable(found):
        raise InputError(f"{path}._target_={target}: nerf_lightning has no such class or function.")
    return dict(inspect.signature(found).parameters)


def require_fitting(value: Any, annotation: Any, path: str) -> None:
    """Check a value against an annotation, if that consists of plain types and our own classes."""
    options = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    known = [option for option in options if option in PLAIN or get_origin(option) in (Literal, list)]
    ours = [option for option in options if inspect.isclass(option) and option.__module__.startswith(OURS)]
    if ours and len(known) + len(ours) == len(options) and not isinstance(value, dict):
        if any(_fits(value, option) for option in known):
            return
        shown = str(value)[:80]
        raise InputError(f"{path}={shown} is not valid: it must be a {ours[0].__name__}, chosen by its group.")
    if len(known) < len(options) or any(_fits(value, option) for option in options):
        return
    raise InputError(f"{path}={value} is not valid: it must be {' or '.join(map(_words, options))}.")


def _fits(value: Any, option: Any) -> bool:
    if get_origin(option) is Literal:
        return value in get_args(option)
    if get_origin(option) is list:
        (each,) = get_args(option)
        return isinstance(value, list) or (isinstance(value, str) and str in get_args(each))  # one name is a list, too
    if option is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if option is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, option)


def _words(option: Any) -> str:
    if get_origin(option) is Literal:
        return ", ".join(str(choice) for choice in get_args(option))
    if get_origin(option) is list:
        return "a list"
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", type(None): "null"}
    return names[option]


def build(node: DictConfig) -> Any:
    """Build one node of the user's own config."""
    require_fitting_values(node, node._get_full_key(None))
    return instantiate(node)
