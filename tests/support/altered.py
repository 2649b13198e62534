"""Nested content of files, altered in one place: what a stranger, or a failing disk, would leave."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import torch
from hypothesis import strategies as st

Path = tuple[Any, ...]
EXTREME = [
    None, True, False, -1, 0, 1, 3, 10**6, 10**10, 2**63, -(2**70), 10**400, 0.5, -0.0, 1e-300, 1e308,
    float("nan"), float("inf"), float("-inf"), "", "x", "\x1b[2J", "\udc80", "a\nb", "\x00", "../../x", "x" * 10**6,
    "<script>", "=1+1", "${oc.env:HOME}", b"x", [], {}, (), [1], (1, 2), {"x": 1}, [[[[[[[[[[1]]]]]]]]]],
]  # fmt: skip
TENSORS = [
    torch.zeros(0), torch.zeros(1), torch.zeros(()), torch.zeros(3, 4), torch.full((3,), float("nan")),
    torch.full((2, 2), float("inf")), torch.full((7,), 3e38), torch.zeros(2, dtype=torch.complex64),
    torch.zeros(2, dtype=torch.int8), torch.zeros(5, dtype=torch.float16), torch.full((4,), -(2**62)),
    torch.zeros(1).expand(10**9), torch.eye(3).to_sparse(),
]  # fmt: skip


def places(content: Any, path: Path = ()) -> Iterator[Path]:
    """Yield the keys that lead to each value within nested dictionaries and sequences."""
    for key, child in _children(content):
        yield (*path, key)
        yield from places(child, (*path, key))


def at(content: Any, path: Path) -> Any:
    """Return the value at a place."""
    for key in path:
        content = content[key]
    return content


def replaced(content: Any, path: Path, value: Any) -> Any:
    """Return the content with another value at a place; what is not on the way there is shared."""
    if not path:
        return value
    key, *rest = path
    new = replaced(content[key], tuple(rest), value)
    if isinstance(content, dict):
        return {**content, key: new}
    return type(content)([*content[:key], new, *content[key + 1 :]])


def without(content: Any, path: Path) -> Any:
    """Return the content without the value at a place."""
    parent, key = at(content, path[:-1]), path[-1]
    if isinstance(parent, dict):
        left: Any = {name: value for name, value in parent.items() if name != key}
    else:
        left = type(parent)([*parent[:key], *parent[key + 1 :]])
    return replaced(content, path[:-1], left)


class Altered:
    """Content that differs in one place, which is all that is shown of it."""

    def __init__(self, what: str, content: Any):
        self.what, self.content = what, content

    @cached_property
    def places(self) -> list[Path]:
        """Where it can be altered."""
        return list(places(self.content))

    def __repr__(self) -> str:
        return self.what


@st.composite
def alterations(draw: st.DrawFn, of: Altered) -> Altered:
    """Draw content that differs in one place: a value that is missing, added, of another kind, or extreme."""
    content = of.content
    path = of.places[draw(st.integers(0, len(of.places) - 1))]
    old = at(content, path)
    kinds = ["replace", "remove"] + ["add"] * isinstance(old, dict) + ["tensor"] * 3 * isinstance(old, torch.Tensor)
    kind = draw(st.sampled_from(kinds))
    if kind == "remove":
        return Altered(f"without {path}", without(content, path))
    if kind == "add":
        key = draw(st.sampled_from(["more", "_target_", "", 3, None]))
        value = draw(st.sampled_from(EXTREME))
        return Altered(f"{key!r}: {str(value)[:60]} in {path}", replaced(content, path, {**old, key: value}))
    new = draw(st.sampled_from(EXTREME + TENSORS)) if kind == "replace" else draw(_other_tensors(old))
    return Altered(f"{path} = {str(new)[:60]}", replaced(content, path, new))


@st.composite
def _other_tensors(draw: st.DrawFn, tensor: torch.Tensor) -> torch.Tensor:
    """Draw a tensor that differs from one in shape, type, or a single number."""
    kind = draw(st.sampled_from(["shape", "type", "number", "all"]))
    if kind == "shape":
        return draw(
            st.sampled_from([tensor[None], tensor.flatten()[:-1], tensor.flatten(), torch.stack([tensor, tensor])])
        )
    if kind == "type":
        return tensor.to(
            draw(st.sampled_from([torch.float64, torch.float16, torch.int32, torch.complex64, torch.bool]))
        )
    new = tensor.clone()
    value = draw(st.sampled_from([float("nan"), float("inf"), -1.0, 0.0, 1e30, -1e30, 1e-40, 255.0]))
    if not new.is_floating_point():
        value = draw(st.sampled_from([-(2**62), -1, 0, 1, 255, 2**62]))
        value = value if new.dtype == torch.int64 else value % 2
    if kind == "all" or not new.numel():
        return new.fill_(value)
    new.view(-1)[draw(st.integers(0, new.numel() - 1))] = value
    return new


def _children(content: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(content, dict):
        yield from content.items()
    elif isinstance(content, (list, tuple)):
        yield from enumerate(content)
