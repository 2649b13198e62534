"""Payloads in files: each would leave a mark if anything in it ran, or fill the memory if it were believed."""

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf
from support.configs import composed
from support.scenes import ball_scene

from nerf_lightning.checkpoints.record import make_record
from nerf_lightning.config.instantiate import build

Change = Callable[[dict[str, Any]], object]


class Payload:
    """Calls something when it is unpickled."""

    def __init__(self, function: Callable, *arguments: object):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def write_checkpoint(path: Path, change: Change = lambda content: None, scene: dict[str, Any] | None = None) -> Path:
    """Write a sound checkpoint of a tiny model, and then change what it holds."""
    config = composed("train", "model=nerf_tiny")
    plain = OmegaConf.to_container(config, resolve=True)
    plain["scene"] |= scene or {}
    record = make_record(
        ball_scene(), yaml.safe_dump(plain, sort_keys=False), {"scene": "bricks", "model": "nerf_tiny"}
    )
    weights = {f"model.{name}": tensor for name, tensor in build(config.model).state_dict().items()}
    run = {"precision": "32-true", "tile_points": 4096}
    content = {"state_dict": weights, "global_step": 7, "nerf_lightning": record | run}
    change(content)
    torch.save(content, path)
    return path


def in_config(change: Change) -> Change:
    """Return a change of a checkpoint that is one of its config."""

    def changed(content: dict[str, Any]) -> None:
        record = content["nerf_lightning"]
        config = yaml.safe_load(record["config"])
        change(config)
        record["config"] = yaml.safe_dump(config)

    return changed


def compress(path: Path) -> None:
    """Write an archive anew with all of its entries deflated."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)


def replace_pickle(path: Path, content: bytes) -> None:
    """Put other instructions into a checkpoint."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in entries.items():
            archive.writestr(name, content if name.endswith("data.pkl") else data)


def many_bytes(count: int) -> bytes:
    """Return a pickle of a few bytes that asks for many."""
    return pickle.dumps(Payload(bytearray, count), protocol=2).replace(b"__builtin__", b"builtins")
