"""Unusable parts of a capture: they are left out and logged once. Only too few remaining views are refused."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

FEWEST_VIEWS = 3
"""Minimum number that must remain once a view is left out."""
MAX_LISTED = 3
ALL_CAMERAS = "To use them, let their cameras be found: scene=photos scene.root=FOLDER, their folder."
"""The advice where more photographs lack a pose than have one."""

log = logging.getLogger(__name__)


@dataclass
class LeftOut:
    """The views of a capture that cannot be used, with what is wrong with each, and photographs without a pose."""

    source: str
    """The file that lists the views, for messages."""
    faults: dict[str, str] = field(default_factory=dict)
    without_pose: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all that is left out."""
        return tuple(dict.fromkeys((*self.without_pose, *self.faults)))

    @contextmanager
    def unless_usable(self, name: str) -> Iterator[None]:
        """Leave the view `name` out if the block raises `InputError`."""
        try:
            yield
        except InputError as error:
            self.faults[name] = str(error)

    def require_enough(self, remaining: int) -> None:
        """Refuse a capture if too few views remain.

        Raises:
            InputError: fewer than three remain; the message says what is wrong with the first one left out.
        """
        if not self.faults or remaining >= FEWEST_VIEWS:
            return
        first, total = next(iter(self.faults.values())), remaining + len(self.faults)
        if len(self.faults) == 1 and not remaining:
            raise InputError(first)
        raise InputError(
            f"{first} {len(self.faults)} of the {total} views of {self.source} cannot be used "
            f"({listed(self.faults, MAX_LISTED)}), and {FEWEST_VIEWS} must remain."
        )

    def say(self, remaining: int) -> None:
        """Log once what is left out, and why the first view is."""
        if self.faults:
            log.warning(
                "%s: %d of %d views are left out: %s. The first: %s",
                *(self.source, len(self.faults), remaining + len(self.faults), listed(self.faults, MAX_LISTED)),
                next(iter(self.faults.values())),
            )
        if self.without_pose:
            cure = f" {ALL_CAMERAS}" if len(self.without_pose) > remaining else ""
            log.warning(
                "%d photographs have no pose and are left out: %s.%s",
                *(len(self.without_pose), listed(self.without_pose, 5), cure),
            )
