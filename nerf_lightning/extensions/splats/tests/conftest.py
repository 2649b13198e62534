"""Exports of tests look around less."""

import pytest

from nerf_lightning.extensions.splats import initialize


@pytest.fixture(autouse=True)
def few_looks_around():
    """Splats begin with fewer views of the field than by default."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(initialize, "COUNT", 16)
        yield
