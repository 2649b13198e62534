"""Descriptions of what a value must be: what each takes, what it refuses, and what it says."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerf_lightning.files.schema import (
    Choice,
    Description,
    Flag,
    Many,
    Maybe,
    Named,
    Number,
    Numbers,
    Plain,
    Record,
    Text,
    Unfit,
    Whole,
    like,
    shown,
)

NAN = float("nan")
TAKEN = [
    (Flag(), [True, False]),
    (Whole(1, 3), [1, 3]),
    (Number(0.0, 1.0), [0, 1, 0.5]),
    (Number(), [-1e308, 10**300]),
    (Text(3), ["", "abc"]),
    (Text(9, r"\d+"), ["12"]),
    (Choice(("a", 2)), ["a", 2]),
    (Maybe(Whole()), [None, 0]),
    (Many(Whole(), 2), [[], [1, 2]]),
    (Many(Whole(), 2, tuple, least=1), [(1,)]),
    (Record({"a": Whole()}, {"b": Flag()}), [{"a": 1}, {"a": 1, "b": True}]),
    (Named(Text(1), Whole(), 2), [{}, {"a": 1, "b": 2}]),
    (Named(Whole(), Whole(), 2), [{0: 1}]),
    (Numbers((2, "n"), low=0.0), [torch.zeros(2, 5), torch.ones(2, 0)]),
    (Plain(depth=1), [1, [1], {"a": None}]),
]
REFUSED = [
    (Flag(), [1, "true", None]),
    (Whole(1, 3), [0, 4, True, 1.0, "1", 10**400]),
    (Number(0.0, 1.0), [NAN, math.inf, -0.1, True, "1", None]),
    (Number(), [10**400, -math.inf]),
    (Text(3), ["abcd", 1, b"a", None]),
    (Text(9, r"\d+"), ["1a", "1\n"]),
    (Choice(("a", 2)), ["b", 2.0, True, None, ["a"]]),
    (Maybe(Whole()), [-1, ""]),
    (Many(Whole(), 2), [(1,), [1, 2, 3], [-1], None, "ab", {}]),
    (Many(Whole(), 2, tuple, least=1), [()]),
    (Record({"a": Whole()}), [{}, {"a": 1, "c": 1}, {"a": "x"}, [], {"a": 1, 3: 1}]),
    (Named(Text(1), Whole(), 2), [{"ab": 1}, {3: 1}, {"a": 1, "b": 2, "c": 3}, []]),
    (Numbers((2, 5)), [torch.zeros(2, 4), torch.zeros(10), torch.full((2, 5), NAN), [1.0], torch.zeros(2, 5).double()]),
    (Numbers((2,), low=0.0), [torch.tensor([-1.0, 1.0]), torch.eye(2).to_sparse()]),
    (Plain(depth=1), [[[1]], object(), torch.zeros(1), b"x"]),
]


@pytest.mark.parametrize(("description", "value"), [(kind, value) for kind, values in TAKEN for value in values])
def test_it_takes(description, value):
    description.require(value, "place", {})


@pytest.mark.parametrize(("description", "value"), [(kind, value) for kind, values in REFUSED for value in values])
def test_it_refuses_with_the_place(description, value):
    with pytest.raises(Unfit, match="place"):
        description.require(value, "place", {})


def test_sides_of_one_name_are_of_one_length():
    views = Record({"names": Many(Text(9), 9, size="views"), "near": Numbers(("views",)), "far": Numbers(("views",))})
    sound = {"names": ["a", "b"], "near": torch.zeros(2), "far": torch.zeros(2)}
    views.require(sound, "", {})
    for key, value in (("names", ["a"]), ("far", torch.zeros(3)), ("near", torch.zeros(2, 1))):
        with pytest.raises(Unfit):
            views.require(sound | {key: value}, "", {})


def test_an_example_of_counts_describes_its_likes():
    example = {"total": {"ready": 3, "completed": 0}, "is_last": True, "none": {}}
    like(example).require({"total": {"ready": 9, "completed": 1}, "is_last": False, "none": {}}, "", {})
    for other in ({}, example | {"is_last": 1}, example | {"total": {"ready": 1}}, example | {"none": {"a": 1}}):
        with pytest.raises(Unfit):
            like(example).require(other, "", {})


ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.binary()),
    lambda inner: st.one_of(
        st.lists(inner), st.tuples(inner, inner), st.dictionaries(st.one_of(st.text(), st.integers()), inner)
    ),
    max_leaves=8,
)


@given(ANYTHING, st.sampled_from([kind for kind, _ in TAKEN + REFUSED]))
def test_nothing_but_unfit_comes_of_anything(value: object, description: Description):
    try:
        description.require(value, "place", {})
    except Unfit as problem:
        message = str(problem)
        assert len(message) < 400
        assert message.isprintable()


@given(ANYTHING)
def test_what_is_shown_is_short_and_printable(value):
    assert len(shown(value)) < 300
    assert shown(value).isprintable()
