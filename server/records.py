"""The records of a store, as they are read: what no sweep has written must not get as far as a table or an answer."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, Protocol, Self, TypeVar, get_args, get_origin, get_type_hints

from client.errors import OutputError


class _Recorded(Protocol):
    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self: ...


Result = TypeVar("Result", bound=_Recorded)


def read_record(kind: type[Result], text: str, store: Path) -> Result:
    """What `record` of that kind gave, from its JSON; raises OutputError for anything else, and for a number that is not finite."""
    try:
        result = kind.from_record(json.loads(text, parse_float=_finite, parse_constant=_finite))
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise _unreadable(store) from error
    if not _is_whole(result):
        raise _unreadable(store)
    return result


def _unreadable(store: Path) -> OutputError:
    return OutputError(f"the store {store} holds a record that is damaged, or not of gamesr-sweep: name another with --store")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not a number that a sweep writes")
    return number


def _is_whole(value: Any) -> bool:
    """Whether every field has its type, and what is in it: a dataclass takes anything."""
    for name, types, inner in _fields(value.__class__):
        found = getattr(value, name)
        if not isinstance(found, types):
            return False
        if inner:
            items = found.values() if isinstance(found, dict) else found if isinstance(found, tuple) else (found,)
            if not all(isinstance(item, inner) and (not is_dataclass(item) or _is_whole(item)) for item in items):
                return False
    return True


@cache
def _fields(kind: type[Any]) -> list[tuple[str, tuple[type, ...], tuple[type, ...]]]:
    """By name, the types of a field, and of what has to be looked into: the items of a tuple, the values of a dict, a dataclass."""
    found = []
    for name, hint in get_type_hints(kind).items():
        parts = {tuple: get_args(hint)[:1], dict: get_args(hint)[1:]}.get(get_origin(hint), (hint,) if is_dataclass(hint) else ())
        found.append((name, _types(hint), _types(*parts)))
    return found


def _types(*hints: Any) -> tuple[type, ...]:
    """For isinstance; JSON's whole numbers are floats too."""
    types: list[type] = []
    for hint in hints:
        if isinstance(hint, UnionType):
            types += _types(*get_args(hint))
        elif hint is float:
            types += [float, int]
        else:
            types.append(object if hint is Any else get_origin(hint) or hint)
    return tuple(types)
