"""Types and shapes checked at each call of our functions: what jaxtyping's import hook puts on them, made quicker.

jaxtyping's own decorator binds each call's arguments twice and checks them twice, and it, beartype and Python's
compiler take a quarter of the time of many tests. Here a function is prepared when it is first called, its arguments
and its result are checked once by beartype, and axes have their sizes within one call, as ever.
"""

import collections.abc
import dataclasses
import functools
import inspect
import threading
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype
from jaxtyping import AbstractArray

CONF = BeartypeConf(violation_type=jaxtyping.TypeCheckError)

slowly_checked = jaxtyping.jaxtyped


def install() -> None:
    """Let jaxtyping's import hook decorate so; our package must not have been imported yet."""
    jaxtyping.jaxtyped = checked  # type: ignore[assignment]


def checked(given: Any = None, *, typechecker: Any = None) -> Any:
    """Decorate a function, or the `__init__` of a dataclass, so that its calls are checked; a class stays as it is."""
    if given is None:
        return functools.partial(checked, typechecker=typechecker)
    if given == "context":  # of a `with`
        return slowly_checked(given)
    if not inspect.isclass(given):
        return _function(given, typechecker)
    if dataclasses.is_dataclass(given) and "__init__" in vars(given):
        given.__init__ = _function(given.__init__, typechecker)
    return given


def _function(function: Any, typechecker: Any) -> Any:
    if not isinstance(function, types.FunctionType):
        return slowly_checked(function, typechecker=typechecker)
    hints = function.__annotations__.values()
    # Of a kernel nothing is checked, and triton 3.6 reads its source with the names of what is around it.
    if getattr(function, "__no_type_check__", False) or all(_is_tritons(hint) for hint in hints):
        return function
    prepared: list[Callable] = []

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        if not prepared:
            prepared.append(_inner(function, typechecker) if _is_inner(function) else _prepared(function, typechecker))
        return prepared[0](*arguments, **named)

    return call


def _is_tritons(hint: Any) -> bool:
    return getattr(hint, "__module__", "").startswith("triton.")


def _is_inner(function: types.FunctionType) -> bool:
    """Whether it is made anew with each call of another, and takes nothing but arguments with a name and no default."""
    code = function.__code__
    unusual = (
        function.__defaults__ or code.co_kwonlyargcount or code.co_flags & (inspect.CO_VARARGS | inspect.CO_VARKEYWORDS)
    )
    return function.__closure__ is not None and not unusual


_inner_checks: dict[tuple, Callable] = {}


def _inner(function: types.FunctionType, typechecker: Any) -> Callable:
    """Return it checked by what has been prepared for the first one of this code and these types."""
    code, hints = function.__code__, function.__annotations__
    key = (code, *map(repr, hints.values()))
    if key not in _inner_checks:
        taken = ", ".join(code.co_varnames[: code.co_argcount])
        named: dict[str, Any] = {}
        exec(f"def check(function_, {taken}): return function_({taken})", function.__globals__, named)
        check = named["check"]
        check.__name__, check.__qualname__ = function.__name__, function.__qualname__
        check.__annotations__ = hints
        _inner_checks[key] = _prepared(check, typechecker)
    return functools.partial(_inner_checks[key], function)


def _prepared(function: types.FunctionType, typechecker: Any) -> Callable:
    hints = {name: _hint(hint, function) for name, hint in function.__annotations__.items()}
    arrays = [part for hint in hints.values() for part in _parts(hint) if _is_array(part)]
    # Axes that are named by arguments; and what beartype would look at only when the first value is taken.
    if any("{" in array.dim_str for array in arrays) or inspect.isgeneratorfunction(function):
        return slowly_checked(function, typechecker=typechecker)
    backend = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__, function.__closure__
    )
    backend.__kwdefaults__, backend.__module__ = function.__kwdefaults__, function.__module__
    backend.__qualname__, backend.__annotations__ = function.__qualname__, hints
    if not arrays:
        return beartype(backend, conf=CONF)
    if all(map(_follows_from_shapes, hints.values())):
        return _once_for_shapes(backend)
    quick = beartype(backend, conf=CONF)

    def within(*arguments: Any, **named: Any) -> Any:
        with slowly_checked("context"):
            return quick(*arguments, **named)

    return within


def _once_for_shapes(function: types.FunctionType) -> Callable:
    """Return it with its arguments and its result checked, unless others of these types and shapes have passed."""
    passed: set[tuple] = set()
    computed = threading.local()

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        # A result that is there already is only to be checked.
        result = vars(computed).pop("result", computed)
        return function(*arguments, **named) if result is computed else result

    call.__annotations__ = function.__annotations__  # from 3.14 on, wraps takes over what would make them anew
    quick = beartype(call, conf=CONF)

    def within(*arguments: Any, **named: Any) -> Any:
        given = (*map(_shapes, arguments), *[(name, _shapes(value)) for name, value in named.items()])
        known = given in passed
        if known:
            computed.result = result = function(*arguments, **named)
            if (given, _shapes(result)) in passed:
                del computed.result
                return result
        with slowly_checked("context"):
            result = quick(*arguments, **named)
        passed.update((given, (given, _shapes(result))))
        return result

    return within


def _shapes(value: Any) -> Any:
    """Return all that decides whether a value passes, where `_follows_from_shapes` of what is asked of it."""
    kind = type(value)
    if kind is tuple or kind is list:
        return (kind, *map(_shapes, value))
    if kind is dict:
        return (kind, *[(name, _shapes(each)) for name, each in value.items()])
    if kind is str:  # of a Literal, the words
        return value
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    return kind if shape is None or dtype is None else (kind, dtype, shape)


def _follows_from_shapes(hint: Any) -> bool:
    """Whether it asks for nothing but classes, shapes, types of elements and words, of a value and of its parts."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return all(isinstance(word, str) for word in parts)
    if origin is collections.abc.Callable:  # beartype asks for no more than that it can be called
        return True
    if origin in (typing.Union, types.UnionType, tuple, list, dict):
        return all(_follows_from_shapes(part) for part in parts if part is not ...)
    if hint is Any or hint is None or _is_array(hint):
        return True
    return isinstance(hint, type) and origin is None and not getattr(hint, "_is_protocol", False)


def _hint(hint: Any, function: types.FunctionType) -> Any:
    """Return what an annotation means; one that cannot be known here, as of a local class, allows anything."""
    holder = types.SimpleNamespace(__annotations__={"it": hint})
    try:
        return typing.get_type_hints(holder, function.__globals__, include_extras=True)["it"]
    except Exception:
        return Any


def _parts(hint: Any) -> Iterator[Any]:
    yield hint
    for part in typing.get_args(hint):
        # The arguments of a Callable stand in a list of their own.
        for each in part if isinstance(part, list) else [part]:
            yield from _parts(each)


def _is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, AbstractArray)
