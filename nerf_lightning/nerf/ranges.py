"""Check the ranges of settings where they are used: a model's may come from a file, and are not checked later."""

from collections.abc import Mapping


def require_ranges(settings: Mapping[str, object], ranges: Mapping[str, tuple[int | float, int | float]]) -> None:
    """Refuse settings outside their ranges; None, which leaves the choice to the class, is in every range.

    Args:
        settings: values by name; those without a range are ignored.
        ranges: minimum and maximum by name.

    Raises:
        ValueError: names the first that is outside its range.
    """
    for name, (least, greatest) in ranges.items():
        value = settings[name]
        if value is not None and not least <= value <= greatest:  # type: ignore[operator]
            raise ValueError(f"{name}={value}: give {least} to {greatest}")
