"""The outcome of a check, and the data that it judges."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

from jaxtyping import Bool
from torch import Tensor

from nerf_lightning.doctor.features import Corners, Looks
from nerf_lightning.doctor.matches import Matches, Proof
from nerf_lightning.messages.escaping import listed
from nerf_lightning.nerf.types.scene import Scene

PAIRS_AT_ONCE = 1 << 24  # a capture may have 200,000 views
Verdict = Literal["ok", "look", "wrong", "not judged"]
"""`look`: may be intended, have a look; `wrong`: training will not work or will be much worse than it could be;
`not judged`: there is too little evidence."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check; its name is given by the table of checks."""

    name: str
    verdict: Verdict
    message: str
    """The findings, in numbers."""
    cure: str = ""
    """What to do about it, or what is needed to judge; empty if all is well."""
    proofs: tuple[Proof, ...] = field(default=(), compare=False, repr=False)
    """Evidence that can be shown in a picture."""


@dataclass(frozen=True)
class CaptureData:
    """The capture's own data, before any pixel is read."""

    scene: Scene

    def named(self, views: Iterable[int]) -> str:
        """Return the names of the first few of the views."""
        return listed((self.scene.view_names[view] for view in views), cap=5)


@dataclass(frozen=True)
class Analysis(CaptureData):
    """Everything that checks use."""

    looks: Looks
    """What each photograph looks like."""
    matches: Matches
    """Places that photographs share, found without their poses."""
    agrees: Bool[Tensor, "matches"]
    """Which of them agree with the cameras."""
    corners: Mapping[int, Corners]
    """Corners of each examined view, for pairs that were not compared."""

    @property
    def agreement(self) -> float:
        """Share of the matches that agree; 0 if there are none."""
        return float(self.agrees.float().mean()) if len(self.agrees) else 0.0


CheckFn = Callable[[Analysis], Check]
ok, look, wrong = partial(Check, "", "ok"), partial(Check, "", "look"), partial(Check, "", "wrong")
not_judged = partial(Check, "", "not judged")
"""Results of checks: `ok(message)`, `look(message, cure)`, `wrong(message, cure, proofs)`, or, with too little
evidence, `not_judged(message, needs)`."""
MORE_DETAILS = "It needs details that several photographs show: take larger, sharper or more of them."


def rows_at_once(columns: int) -> int:
    """Return how many rows of a table of pairs with `columns` columns are computed at once."""
    return max(1, PAIRS_AT_ONCE // columns)
