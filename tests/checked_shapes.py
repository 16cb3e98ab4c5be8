"""Check shapes and types of annotations while tests run, five times as fast as jaxtyping's own
decorator.

`jaxtyping.jaxtyped` binds the arguments of each call to the signature and checks them twice if
there is a result. It also decorates a nested function at each call of the outer one. That takes 30
% of the suite's processor time. Here, arguments and result are checked once, in one context, so
that `n` is the same number in all of them. Nested functions are not checked.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import is_dataclass
from types import FunctionType
from typing import Any

import jaxtyping
from beartype import beartype

_jaxtyped = jaxtyping.jaxtyped


def check(modules: list[str]) -> None:
    """Check functions, methods and dataclasses of these modules from now on. No module may
    be imported yet."""
    jaxtyping.jaxtyped = _for_the_hook  # the hook decorates each definition with it
    jaxtyping.install_import_hook(modules, "beartype.beartype")


def _for_the_hook(*, typechecker: object) -> Callable[[Any], Any]:
    return _checked


def _checked(defined: Any) -> Any:
    if "<locals>" in defined.__qualname__:
        return defined
    if inspect.isclass(defined):
        if (
            is_dataclass(defined)
            and isinstance(defined.__init__, FunctionType)
            and not hasattr(defined.__init__, "__wrapped__")
        ):
            defined.__init__ = _checked(defined.__init__)
        return defined
    readable = _with_annotations_read(defined)
    checked = beartype(readable)
    if checked is readable:  # nothing to check
        return defined
    if "jaxtyping" not in repr(list(readable.__annotations__.values())):
        return functools.update_wrapper(checked, defined)

    @functools.wraps(defined)
    def in_a_context(*args: Any, **settings: Any) -> Any:
        __tracebackhide__ = True
        with _jaxtyped("context"):
            return checked(*args, **settings)

    return in_a_context


def _with_annotations_read(function: FunctionType) -> FunctionType:
    """Return a copy with evaluated annotations. An undefined name, such as the class around a
    method, accepts any value."""
    copy = FunctionType(
        function.__code__,
        function.__globals__,
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    copy.__kwdefaults__, copy.__module__, copy.__qualname__ = (
        function.__kwdefaults__,
        function.__module__,
        function.__qualname__,
    )
    copy.__annotations__ = {
        name: _read(annotation, function.__globals__)
        for name, annotation in function.__annotations__.items()
    }
    return copy


def _read(annotation: object, names: dict[str, Any]) -> object:
    if not isinstance(annotation, str):
        return annotation
    try:
        return eval(annotation, names)
    except (NameError, AttributeError, TypeError):
        return Any
