"""What functions that take flags look like to `inspect.signature`, `help()` and tab completion: every flag by name."""

from collections.abc import Callable, Iterator
from inspect import Parameter, cleandoc, signature
from textwrap import fill
from typing import Any, Literal, TypeVar, get_args, get_origin

from xfemnav.pipeline.flags import TABLE, Flags, Own
from xfemnav.pipeline.scenario import field_at

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
    for name, place in TABLE.items():
        kind, chosen = get_args(Flags.__annotations__[name])[0], ()
        default, meaning = place if isinstance(place, Own) else (field_at(place).default, field_at(place).description)
        if isinstance(place, str) and (chosen := choices(field_at(place).annotation)):
            kind = Literal[chosen] | None
        among = f" ({', '.join(chosen)})" if chosen else ""
        yield (Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind),
               f"{name}={default!r}{among}: {meaning}")


def choices(annotation: Any) -> tuple[str, ...]:
    """The texts that a key takes, empty where it takes others too."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return next(filter(None, map(choices, get_args(annotation))), ())
