"""Suggestions for a mistyped name."""

from collections.abc import Iterable
from difflib import SequenceMatcher, get_close_matches


def near(word: str, names: Iterable[str]) -> list[str]:
    """Return the most similar names: at most three, all nearly as similar as the first.

    >>> near("trainer.max_stpes", ["trainer.max_steps", "trainer.max_epochs", "seed"])
    ['trainer.max_steps']
    """
    close = {each: SequenceMatcher(None, each, word).ratio() for each in get_close_matches(word, list(names))}
    return [each for each, ratio in close.items() if ratio >= max(close.values()) - 0.05]


def did_you_mean(word: str, names: Iterable[str], before: str = "") -> str:
    """Return the question that follows a complaint; empty if nothing is similar.

    >>> did_you_mean("fats", ["fast", "nerf"], "model=")
    ' Did you mean model=fast?'
    """
    close = near(word, names)
    return f" Did you mean {' or '.join(f'{before}{each}' for each in close)}?" if close else ""
