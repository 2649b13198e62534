"""Places for the checks of the self-test, with no command line behind them."""

from pathlib import Path

import torch

from nerf_lightning.checkpoints.reading import read_checkpoint
from nerf_lightning.config.load_model import load_model
from nerf_lightning.selftest.check import Row, carried_out
from nerf_lightning.selftest.place import Place
from nerf_lightning.selftest.runs import Runs


class Finished(Runs):
    """Runs that are there already."""

    def __init__(self, folder: Path):
        self.folder = folder

    def whole(self) -> Path:
        return self.folder / "whole"

    def resumed(self) -> Path:
        return self.folder / "resumed"

    def film(self) -> Path:
        return self.folder / "film" / "video"

    def close(self) -> None:
        pass


def a_place(folder: Path = Path("nowhere"), device: str = "cpu", **changes) -> Place:
    settings = {"products": ("float32", "bfloat16"), "chosen": "float32", "compiles": False} | changes
    return Place(
        device=torch.device(device),
        runs=Finished(folder),
        read_model=lambda path: load_model(read_checkpoint(path)),
        **settings,
    )


def rows_of(checks, *words: str) -> list[Row]:
    """Carry out the checks in whose names one of the words stands."""
    chosen = [check for check in checks if any(word in check.name for word in words)]
    assert chosen
    return [carried_out(check) for check in chosen]
