"""What somebody may have meant who mistyped a name."""

import difflib
from collections.abc import Iterable

ALIKE, AS_ALIKE = 0.6, 0.05
"""How alike a name must be to be offered, and how much less than the most alike one."""


def near(word: str, known: Iterable[str]) -> list[str]:
    """Return the known names that are most alike, at most three.

    >>> near("trainer.max_stpes", ["trainer.max_steps", "trainer.max_epochs", "seed"])
    ['trainer.max_steps']
    """
    close = difflib.get_close_matches(word, list(known), n=3, cutoff=ALIKE)
    alike = [difflib.SequenceMatcher(None, each, word).ratio() for each in close]
    return [each for each, ratio in zip(close, alike, strict=True) if ratio >= max(alike) - AS_ALIKE]


def did_you_mean(word: str, known: Iterable[str], before: str = "") -> str:
    """Return the question that follows a complaint, empty where nothing is alike.

    >>> did_you_mean("fats", ["fast", "nerf"], "model=")
    ' Did you mean model=fast?'
    """
    close = near(word, known)
    return f" Did you mean {' or '.join(f'{before}{each}' for each in close)}?" if close else ""
