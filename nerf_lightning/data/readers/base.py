"""The contract of a reader: one class per format, `read()` returns a `Scene`."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

from nerf_lightning.nerf.types.scene import Scene


class Reader(ABC):
    """Read a capture. The constructor only keeps its arguments; every file access happens in `read`."""

    named_by: ClassVar[tuple[str, ...]] = ()
    """Extensions of files of this format that `scene=auto scene.root=FILE` may name."""

    @classmethod
    def found_in(cls, folder: Path) -> str | None:
        """Return the file by which this format is recognized; None if absent, or if the format is not searched for."""
        return None

    @abstractmethod
    def read(self) -> Scene:
        """Return the whole capture with all splits.

        Raises:
            InputError: anything is wrong with the files; the message names the file and the cure.
        """
