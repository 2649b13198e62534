"""The contract of a reader: one class per format, `read()` returns a `Scene`."""

from abc import ABC, abstractmethod

from nerf_lightning.nerf.types.scene import Scene


class Reader(ABC):
    """Read a capture. The constructor only keeps its arguments; every file access happens in `read`."""

    @abstractmethod
    def read(self) -> Scene:
        """Return the whole capture, all splits.

        Raises:
            InputError: anything wrong with the files, with the file's name and the cure.
        """
