"""What a check says, and what it may look at."""

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
"""`look`: may be meant so, have a look; `wrong`: training will not work or will be much worse than it could be;
`not judged`: there is too little evidence to tell."""


@dataclass(frozen=True)
class Check:
    """The outcome of one check; its name is given by the table of checks."""

    name: str
    verdict: Verdict
    message: str
    """What was found, in numbers."""
    cure: str = ""
    """What to do about it, or what it would need to judge; empty where all is well."""
    proofs: tuple[Proof, ...] = field(default=(), compare=False, repr=False)
    """What can be shown for it, in a picture."""


@dataclass(frozen=True)
class Given:
    """What the capture says of itself, before any pixel is asked."""

    scene: Scene

    def named(self, views: Iterable[int]) -> str:
        """Return the names of views, the first few of them."""
        return listed((self.scene.view_names[view] for view in views), cap=5)


@dataclass(frozen=True)
class Evidence(Given):
    """All that checks look at."""

    looks: Looks
    """What each photograph looks like."""
    matches: Matches
    """Places that photographs have in common, found without their poses."""
    agrees: Bool[Tensor, "matches"]
    """Which of them lie where the cameras say."""
    corners: Mapping[int, Corners]
    """What was found in each view that was looked at, for pairs that were not compared."""

    @property
    def agreement(self) -> float:
        """Share of the matches that agree; 0 where there are none."""
        return float(self.agrees.float().mean()) if len(self.agrees) else 0.0


CheckFn = Callable[[Evidence], Check]
ok, look, wrong = partial(Check, "", "ok"), partial(Check, "", "look"), partial(Check, "", "wrong")
not_judged = partial(Check, "", "not judged")
"""What checks return: `ok(message)`, `look(message, cure)`, `wrong(message, cure, proofs)`; where the evidence is too
thin, `not_judged(message, needs)`."""
MORE_DETAILS = "It needs details that several photographs show: take larger, sharper or more of them."


def rows_at_once(columns: int) -> int:
    """Return how many rows of a table of pairs, with so many columns, are computed at once."""
    return max(1, PAIRS_AT_ONCE // columns)
