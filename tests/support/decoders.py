"""Machines that lack a decoder of pictures."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from nerf_lightning.data.pixels.formats import decoders


@contextmanager
def without_heic() -> Iterator[None]:
    """Let pillow-heif be absent within the block."""
    decoders.cache_clear()
    with patch.dict(sys.modules, {"pi_heif": None, "pillow_heif": None}):
        yield
    decoders.cache_clear()
