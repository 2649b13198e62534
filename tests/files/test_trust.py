"""The rule for untrusted files: the first difference is named, and whatever else is raised names the file."""

import struct
from typing import Annotated, Any, Literal

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float
from support.running import refused
from torch import Tensor

from nerf_lightning.files.trust import Mismatch, for_message, reading, require_fit
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.types.progress import Progress

TEMPLATE = {"w": torch.empty(2, 3, device="meta"), "n": [1, {"on": True}], "rate": 0.5, "none": None}
SOUND = {"w": torch.ones(2, 3), "n": [7, {"on": False}], "rate": 2.0, "none": None}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"more": 1}, "file.more belongs to no file of this kind"),
        ({"w": torch.ones(3, 2)}, r"file.w holds torch.float32 in the shape \(3, 2\), not torch.float32 in \(2, 3\)"),
        ({"n": [1]}, "file.n has 1 entries, not 2"),
        ({"none": 0}, "file.none is 0"),
    ],
    ids=lambda each: str(each)[:30],
)
def test_the_first_difference_from_a_template_is_named(change, words):
    require_fit(SOUND, TEMPLATE, "file")
    with pytest.raises(Mismatch, match=words):
        require_fit(SOUND | change, TEMPLATE, "file")
    with pytest.raises(Mismatch, match="is missing"):
        require_fit({key: value for key, value in SOUND.items() if key not in change}, SOUND | change, "file")


KINDS: list[tuple[Any, list, list]] = [
    (int, [0, 1 << 53], [-1, 1 << 54, True, 1.0, "1"]),
    (float, [0, 1.5], [float("nan"), 10**400, True, "x"]),
    (str, ["x"], [b"x", None]),
    (bool | None, [None, True], [0]),
    (Literal["a", "b"], ["b"], ["c", ["a"], torch.zeros(2)]),
    (Annotated[int, 1, 9], [1, 9], [0, 10, 1.0]),
    (list[int], [[], [1]], [(1,), ["x"]]),
    (tuple[str, ...], [("a",)], [["a"]]),
    (dict[str, float], [{"a": 1.0}], [{1: 1.0}, {"a": "x"}, []]),
    (Tensor, [torch.zeros(2)], [torch.full((2,), float("nan")), 1]),
    (Float[Tensor, "n 2"], [torch.zeros(3, 2)], [torch.zeros(2), torch.zeros(3, 2).half(), torch.zeros(3, 2).long()]),
    (Progress, [{}, {"step": 1}], [{"advance": 1}, {"step": "x"}, None]),
    ({"a": int}, [{"a": 1}], [{}, {"a": 1, "b": 1}]),
]


@pytest.mark.parametrize(("kind", "taken", "refused"), KINDS, ids=lambda each: str(each)[:20])
def test_what_fits_its_annotation_passes_and_nothing_else(kind, taken, refused):
    for value in taken:
        require_fit(value, kind, "place")
    for value in refused:
        with pytest.raises(Mismatch, match="place"):
            require_fit(value, kind, "place")


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner) | st.tuples(inner, inner) | st.dictionaries(st.text() | st.integers(), inner),
    max_leaves=8,
)


@given(ANYTHING, st.sampled_from([kind for kind, _, _ in KINDS]))
def test_nothing_but_a_mismatch_comes_of_anything(value: object, kind: Any):
    for check in (lambda: require_fit(value, kind, "place"), lambda: require_fit(value, TEMPLATE, "place")):
        message = ""
        try:
            check()
        except Mismatch as problem:
            message = str(problem)
        assert len(message) < 3000
        assert not message or message.isprintable()
    assert len(for_message(value)) < 300


@pytest.mark.parametrize(
    "error", [KeyError("a"), TypeError("b"), struct.error("c\nd"), MemoryError(), RecursionError(), AttributeError("e")]
)
def test_whatever_a_broken_file_raises_names_the_file(error):
    def read():
        with reading("a.file", "Use another."):
            raise error

    refused(read, parts=(f"a.file cannot be read ({type(error).__name__}", "Use another."))


def test_what_is_said_already_is_not_said_again():
    with pytest.raises(InputError, match=r"^mine$"), reading("a.file"):
        raise InputError("mine")
