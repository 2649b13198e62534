"""The fixtures of commands, for tests of extensions."""

from collections.abc import Iterator

import pytest
from support.command_fixtures import *  # noqa: F403

from nerf_lightning.extensions.splats import initialize


@pytest.fixture(autouse=True)
def few_looks_around() -> Iterator[None]:
    """Splats begin with fewer views of the field than by default."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initialize, "COUNT", 16)
        yield
