"""Many captures as one scene, for a model of many scenes: a folder of captures, or models of the bricks family."""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from nerf_lightning.data.captures.scene import Spaces
from nerf_lightning.data.readers.auto import AutoReader
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.extensions.many_scenes.brick_models import BrickModelReader
from nerf_lightning.extensions.many_scenes.joined import joined
from nerf_lightning.files.regular import what_is
from nerf_lightning.messages.console import tracked
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import Scene

MOST_VARIANTS = 10_000
OF_BRICKS = ("resolution", "num_train", "num_val", "num_test", "gain", "gamma", "background", "cache_dir")
OF_FOLDERS = ("downscale", "hold_every", "space", "background", "cache_dir", "allow_outside")
"""Settings that are passed to the readers of bricks models, and of folders."""


@dataclass
class ManyReader(Reader):
    """Read several captures, each in its own frame, and join them into one scene.

    Args:
        root: a folder of captures, each read like scene=auto; null: bricks models.
        variants: numbers of bricks models for training, such as 1-50 or "1-8 12" (scene=brick_model scene.variant=N).
        unseen: captures held out from training, on which the model is then evaluated: names or patterns of * and ? in a
            folder, separated by spaces; numbers of bricks models, written like `variants`. null: the model is evaluated
            on held-out views of each capture.
        resolution: of bricks models: width and height of every picture in pixels.
        num_train: of bricks models: number of training views of each.
        num_val: of bricks models: number of validation views of each.
        num_test: of bricks models: number of test views of each.
        gain: of bricks models: every color c is photographed as gain * c^gamma.
        gamma: of bricks models: see gain.
        downscale: of a folder: integer factor by which photographs are shrunk.
        hold_every: of a folder: the first and every k-th view after it are held out, if the format names no split.
        space: of a folder: bounded, contracted, or auto, which must choose the same for all captures.
        background: the background of transparent pixels: white, black, random or none.
        cache_dir: where rendered and decoded images are kept; null: the user's cache folder.
        allow_outside: of a folder: follow names and links that lead out of a capture.
        name: the scene's name in reports.
    """

    root: str | None = None
    variants: str | int | None = None
    unseen: str | int | None = None
    resolution: int = 64
    num_train: int = 24
    num_val: int = 2
    num_test: int = 4
    gain: float = 1.0
    gamma: float = 1.0
    downscale: int = 1
    hold_every: int = 8
    space: Spaces = "auto"
    background: str = "white"
    cache_dir: str | None = None
    allow_outside: bool = False
    name: str = "many"

    def read(self) -> Scene:
        """Return all captures as one scene.

        Raises:
            InputError: there are no captures, they cannot be joined, or anything is wrong with one of them.
        """
        nothing = self.root is None and self.variants is None and self.unseen is None
        if nothing or (self.root is not None and self.variants is not None):
            raise InputError(
                "scene=many needs a folder of captures (scene.root=DIR), or numbers of bricks models to learn from "
                "(scene.variants=1-50), and not both."
            )
        readers, unseen = self._of_bricks() if self.root is None else self._in_folder(Path(self.root).expanduser())
        scenes = {name: readers[name].read() for name in tracked(list(readers), "reading captures")}
        return joined(scenes, unseen, self.name)

    def _of_bricks(self) -> tuple[dict[str, Reader], set[str]]:
        seen, unseen = numbers_in(self.variants, "scene.variants"), numbers_in(self.unseen, "scene.unseen")
        both = sorted(set(seen) & set(unseen))
        if both:
            raise InputError(
                f"scene.unseen={self.unseen} names the bricks models {listed(map(str, both), 5)}, which "
                f"scene.variants={self.variants} trains on. Leave them out of one of the two."
            )
        settings: dict[str, Any] = {name: getattr(self, name) for name in OF_BRICKS}
        readers: dict[str, Reader] = {f"bricks_{n}": BrickModelReader(variant=n, **settings) for n in [*seen, *unseen]}
        return readers, {f"bricks_{number}" for number in unseen}

    def _in_folder(self, root: Path) -> tuple[dict[str, Reader], set[str]]:
        if not os.path.isdir(root):
            raise InputError(f"The folder {root} {what_is(root)}. Set scene.root to a folder of captures.")
        found = [each for each in sorted(root.iterdir()) if each.is_dir() and AutoReader.known_format(each)]
        if not found:
            raise InputError(
                f"None of the folders in {root} is a capture that scene=auto reads. Set scene.root to a folder of "
                "captures, or read a single one with scene=auto."
            )
        names = [each.name for each in found]
        patterns = str(self.unseen).split() if self.unseen is not None else []
        for pattern in patterns:
            if not any(fnmatch(name, pattern) for name in names):
                raise InputError(f"scene.unseen: no capture in {root} is called {pattern}; there are {listed(names)}.")
        unseen = {name for name in names if any(fnmatch(name, pattern) for pattern in patterns)}
        settings: dict[str, Any] = {name: getattr(self, name) for name in OF_FOLDERS}
        readers: dict[str, Reader] = {each.name: AutoReader(str(each), name=each.name, **settings) for each in found}
        return readers, unseen


def numbers_in(text: str | int | None, setting: str) -> list[int]:
    """Return the numbers that a text names, in order, each once.

    >>> numbers_in("1-3 8", "scene.variants"), numbers_in(7, "scene.variants"), numbers_in(None, "scene.variants")
    ([1, 2, 3, 8], [7], [])

    Raises:
        InputError: it names no numbers, or too many.
    """
    if text is None:
        return []
    return list(dict.fromkeys(_expanded(str(text).split(), f"{setting}={text}")))


def _expanded(words: list[str], where: str) -> Iterable[int]:
    for word in words:
        first, _, last = word.partition("-")
        if not (first.isdecimal() and (last or first).isdecimal() and int(first) <= int(last or first)):
            raise InputError(f"{where}: give numbers and ranges of them with spaces between, such as 1-50 or '1-8 12'.")
        if int(last or first) >= int(first) + MOST_VARIANTS:
            raise InputError(f"{where} names more than {MOST_VARIANTS} models. Give fewer.")
        yield from range(int(first), int(last or first) + 1)
