"""The constructor's signature is the schema: values of the wrong kind are named before anything is built."""

import inspect
import types
from typing import Any, Literal, Union, get_args, get_origin

from hydra.utils import get_object
from omegaconf import OmegaConf

from nerf_lightning.errors import InputError

PLAIN = (bool, int, float, str, type(None))


def require_fitting_values(node: Any, path: str = "") -> None:
    """Hold a config against the signatures of the classes that it names, nested ones included.

    Raises:
        InputError: a number, word or switch where the signature wants another.
    """
    if OmegaConf.is_config(node):
        node = OmegaConf.to_container(node, resolve=True)
    if isinstance(node, list):
        for index, child in enumerate(node):
            require_fitting_values(child, f"{path}[{index}]")
    elif isinstance(node, dict):
        parameters = _parameters(node.get("_target_"))
        for key, value in node.items():
            here = f"{path}.{key}" if path else str(key)
            if key in parameters:
                _require(value, parameters[key].annotation, here)
            require_fitting_values(value, here)


def _parameters(target: str | None) -> dict[str, inspect.Parameter]:
    # Only our own: other people's annotations promise less.
    if target is None or not target.startswith("nerf_lightning."):
        return {}
    return dict(inspect.signature(get_object(target)).parameters)


def _require(value: Any, annotation: Any, path: str) -> None:
    options = get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)
    known = [option for option in options if option in PLAIN or get_origin(option) is Literal]
    if len(known) < len(options) or any(_fits(value, option) for option in options):
        return
    raise InputError(f"{path}={value} does not fit: it must be {' or '.join(map(_words, options))}.")


def _fits(value: Any, option: Any) -> bool:
    if get_origin(option) is Literal:
        return value in get_args(option)
    if option is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if option is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, option)


def _words(option: Any) -> str:
    if get_origin(option) is Literal:
        return ", ".join(str(choice) for choice in get_args(option))
    names = {bool: "true or false", int: "a whole number", float: "a number", str: "text", type(None): "null"}
    return names[option]
