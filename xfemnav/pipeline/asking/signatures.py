"""What functions that take flags look like to `inspect.signature`, `help()` and tab completion: every flag by name."""

from collections.abc import Callable, Iterator
from inspect import Parameter, cleandoc, signature
from textwrap import fill
from typing import Any, Literal, TypeVar, get_args

from xfemnav.pipeline.asking.settings import TABLE, Flags

Function = TypeVar("Function", bound=Callable)
TOLD = "Every flag with its default, which a scenario's own value takes the place of:"


def takes_flags(function: Function) -> Function:
    """Decorator: the `**flags` of a function are shown one by one, and told of at the end of its docstring."""
    told = signature(function)
    own = [each for each in told.parameters.values() if each.kind is not Parameter.VAR_KEYWORD]
    flags = list(_flags())
    function.__signature__ = told.replace(parameters=[*own, *(parameter for parameter, _ in flags)])
    function.__doc__ = "\n".join([cleandoc(function.__doc__), "", TOLD, "",
                                  *(fill(line, 116, initial_indent=4 * " ", subsequent_indent=8 * " ")
                                    for _, line in flags)])
    return function


def own_names(function: Callable) -> tuple[str, ...]:
    """The arguments of a function that takes flags which are none."""
    return tuple(name for name in signature(function).parameters if name not in TABLE)


def _flags() -> Iterator[tuple[Parameter, str]]:
    """Each flag as a keyword argument, and a line that tells of it."""
    for name, setting in TABLE.items():
        taken, among = get_args(Flags.__annotations__[name])[0], ""
        numbers = "; or its numbers" if any(get_args(one)[:1] in ((float,), (Any,)) for one in get_args(taken)) else ""
        if setting.choices:
            taken, among = Literal[setting.choices] | None, f" ({', '.join(setting.choices)})"
        yield (Parameter(name, Parameter.KEYWORD_ONLY, default=setting.default, annotation=taken),
               f"{name}={setting.default!r}{among}: {setting.meaning}{numbers}"
               f"{'; or a list of these' if setting.default == () else ''}")
