"""Configurations: nested frozen dataclasses to JSON and back, and `--set key=value`.

A configuration may hold None, booleans, numbers, text, paths, `Literal`s, tuples, other dataclasses and unions of
these. Where a field may be one of several dataclasses, the stored dictionary names its class under the key "kind".

Why no library does this: both that were tried on the cases of `tests/test_config.py` need as much code around them.
cattrs 26.2 reads true as 1, 1.5 as 1, "7" as 7 and NaN as a number unless every scalar has a hook of its own, knows no
union of dataclasses with plain values, and gives a tree of exceptions that has to be searched for the path, the value
and what would be allowed: 86 lines in place of 84. dacite 1.9 cannot choose a union's class by its "kind" (it takes the
first that fits), and names a union's whole dictionary instead of the setting that is wrong.
"""

import ast
import contextlib
import dataclasses
import difflib
import functools
import inspect
import itertools
import re
import sys
import textwrap
import types
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from twofold.errors import TwofoldError
from twofold.inputs import shown

T = TypeVar("T")
MAX_FLOAT = sys.float_info.max
KIND = "kind"
MAX_SEED = 2**32 - 1
"""Seeds are 0 to this: what every generator takes, and a sine of it still tells neighbours apart."""


def to_dict(config: object) -> dict[str, Any]:
    """The configuration as JSON can hold it; `from_dict` gives an equal one back.

    >>> @dataclasses.dataclass(frozen=True)
    ... class Training:
    ...     steps: int = 200
    ...     milestones: tuple[int, ...] = (100, 150)
    >>> to_dict(Training())
    {'steps': 200, 'milestones': [100, 150]}
    """
    hints = get_type_hints(type(config))
    return {f.name: _to_json(getattr(config, f.name), hints[f.name]) for f in _fields(config)}


def from_dict(cls: type[T], data: object, where: str) -> T:
    """A configuration of class `cls` from what `to_dict` gave.

    A key that is absent takes its field's default, if it has one, so an older file still reads.

    Args:
        cls: a dataclass.
        data: the dictionary, as read from JSON.
        where: what the data is called in an error, a file's name for instance.

    Raises:
        TwofoldError: a key is unknown or missing, or a value is not what its field holds.
    """
    return cast(T, _read(cls, data, "", where))


def with_overrides(config: T, overrides: Sequence[str]) -> T:
    """The configuration with `dotted.key=value` settings applied in order.

    Values are read by the type of their field: none or null, true or false, numbers, a `Literal`'s choices, tuples as
    1,2,3, and for a field that may be one of several dataclasses the name of the class, which then has its defaults.

    >>> @dataclasses.dataclass(frozen=True)
    ... class Training:
    ...     steps: int = 200
    >>> with_overrides(Training(), ["steps=50"])
    Training(steps=50)

    Raises:
        TwofoldError: a key does not exist, or its value is not allowed.
    """
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals or not key.strip():
            raise TwofoldError(
                f"--set expects key=value, it got {override!r}; a key is for example {_an_example(config)}."
            )
        config = cast(T, _replaced(config, key.strip(), text.strip(), config))
    return config


def list_settings(config: object) -> list[tuple[str, str, str]]:
    """Every setting as its key, its value as `--set` takes it, and its documentation where there is some."""
    return [(key, _shown(value), text or "") for key, value, text in _leaves(config)]


def describe(config: object) -> list[str]:
    """One line `key = value` for every setting, with its documentation where there is some."""
    rows = [(f"{key} = {_shown(value)}", text) for key, value, text in _leaves(config)]
    width = max((len(left) for left, text in rows if text), default=0)
    return [f"{left:<{width}}  {text}" if text else left for left, text in rows]


def require(holds: bool, wanted: str) -> None:
    """Says what was wanted where it does not hold.

    Raises:
        ValueError: it does not.
    """
    if not holds:
        raise ValueError(wanted)


def require_within(config: object, **limits: tuple[int | float, int | float]) -> None:
    """Refuses settings outside their limits (minimum, maximum); None passes, each element of a list is checked.

    >>> @dataclasses.dataclass(frozen=True)
    ... class Training:
    ...     steps: int = 200
    ...     def __post_init__(self) -> None:
    ...         require_within(self, steps=(1, 1000))
    >>> Training(0)
    Traceback (most recent call last):
    ValueError: steps=0 should be 1 to 1000

    Raises:
        ValueError: one or several are outside; all are named.
    """
    wrong = []
    for name, (low, high) in limits.items():
        value = getattr(config, name)
        numbers = value if isinstance(value, tuple) else () if value is None else (value,)
        if not all(low <= number <= high for number in cast(tuple[int | float, ...], numbers)):
            text = _shown(value)
            given = text if len(text) <= 40 else f"{text[:30]}..."
            wrong.append(f"{name}={given} should be {_plain(low)} to {_plain(high)}")
    if wrong:
        raise ValueError("; ".join(wrong))


def _plain(number: int | float) -> str:
    return str(int(number)) if number == int(number) else f"{number:g}"


def _to_json(value: object, annotation: object) -> object:
    if _is_config(value):
        several = sum(dataclasses.is_dataclass(c) for c in _choices(annotation)) > 1
        return ({KIND: type(value).__name__} if several else {}) | to_dict(value)
    if isinstance(value, tuple):
        items = cast(tuple[object, ...], value)
        element = _elements(annotation, len(items)) or (object,) * len(items)
        return [_to_json(v, a) for v, a in zip(items, element, strict=True)]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a configuration cannot hold {type(value).__name__}")


def _read(annotation: object, data: object, path: str, where: str) -> object:
    """`data` as a value of `annotation`, or an error that names `path` and what is allowed."""
    configs = [c for c in _choices(annotation) if dataclasses.is_dataclass(c)]
    if isinstance(data, dict) and configs:
        return _read_config(cast(list[type], configs), cast(dict[str, object], data), path, where)
    for choice in _choices(annotation):
        if _fits(choice, data):
            return _converted(choice, data, path, where)
    raise TwofoldError(f"{path or 'The content'} in {where} should be {_allowed(annotation)}; it is {shown(data)}.")


def _read_config(classes: list[type], data: dict[str, object], path: str, where: str) -> object:
    names = {c.__name__: c for c in classes}
    cls = classes[0]
    if len(classes) > 1:
        kind = data.get(KIND)
        if not isinstance(kind, str) or kind not in names:
            problem = f"lacks {KIND!r}" if kind is None else f"has the unknown kind {shown(kind)}"
            raise TwofoldError(
                f"{path} in {where} {problem}; it may be {_either(names)}.{_suggestion(str(kind), names)}"
            )
        cls = names[kind]
        data = {key: value for key, value in data.items() if key != KIND}
    known = [f.name for f in _fields(cls)]
    prefix = f"{path}." if path else ""
    for key in data:
        if key not in known:
            hint = _suggestion(key, known)
            raise TwofoldError(f"{prefix}{key} in {where} is not a setting; known are {', '.join(known)}.{hint}")
    required = [f.name for f in _fields(cls) if f.default is f.default_factory is dataclasses.MISSING]
    missing = [prefix + name for name in required if name not in data]
    if missing:
        raise TwofoldError(f"{where} lacks {', '.join(missing)}; add it.")
    hints = get_type_hints(cls)
    values = {key: _read(hints[key], value, prefix + key, where) for key, value in data.items()}
    return _built(cls, values, f"{path or cls.__name__} in {where}")


def _fits(choice: object, data: object) -> bool:
    """Whether JSON data is of this one type, a union's member; tuples are checked element by element later."""
    if get_origin(choice) is Literal:
        return any(data == allowed and type(data) is type(allowed) for allowed in get_args(choice))
    if choice is types.NoneType:
        return data is None
    if choice is float:
        return isinstance(data, int | float) and not isinstance(data, bool) and -MAX_FLOAT <= data <= MAX_FLOAT
    if choice is int:
        return isinstance(data, int) and not isinstance(data, bool)
    if choice is bool:
        return isinstance(data, bool)
    if choice is str or choice is Path:
        return isinstance(data, str)
    return get_origin(choice) is tuple and isinstance(data, list)


def _converted(choice: object, data: object, path: str, where: str) -> object:
    if choice is float:
        return float(cast(float, data))
    if choice is Path:
        return Path(cast(str, data))
    if get_origin(choice) is not tuple:
        return data
    items = cast(list[object], data)
    elements = _elements(choice, len(items))
    if elements is None:
        raise TwofoldError(f"{path} in {where} should be {_allowed(choice)}; it has {len(items)} values.")
    return tuple(_read(e, v, f"{path}[{i}]", where) for i, (e, v) in enumerate(zip(elements, items, strict=True)))


def _replaced(config: object, key: str, text: str, whole: object, parents: str = "") -> object:
    """`config` with the setting `key`, dotted and relative to it, read from `text`; `whole` is for suggestions."""
    name, dot, rest = key.partition(".")
    path = parents + name
    if name not in {f.name for f in _fields(config)}:
        keys = [k for k, _, _ in _leaves(whole)]
        hint = _suggestion(parents + key, keys)
        known = hint or f" Known are {', '.join(keys)}."
        raise TwofoldError(f"There is no setting {parents + key!r}.{known}")
    annotation, value = get_type_hints(type(config))[name], getattr(config, name)
    if dot and not _is_config(value):
        classes = [c.__name__ for c in _choices(annotation) if isinstance(c, type) and dataclasses.is_dataclass(c)]
        first = f"; set {path}={classes[0]} first" if classes else ""
        raise TwofoldError(f"{path} is {_shown(value)} and has no setting {rest!r}{first}.")
    new = _replaced(value, rest, text, whole, f"{path}.") if dot else _parsed(annotation, text, path)
    values = {f.name: new if f.name == name else getattr(config, f.name) for f in _fields(config)}
    return _built(type(config), values, path)


def _parsed(annotation: object, text: str, path: str) -> object:
    """The value that `text` means for a field; the first type of a union that can read it wins, text last."""
    for choice in sorted(_choices(annotation), key=lambda c: c is str):
        for data in _candidates(choice, text):
            if _fits(choice, data):
                return _converted(choice, data, path, "--set")
        if isinstance(choice, type) and dataclasses.is_dataclass(choice) and choice.__name__ == text:
            return _built(choice, {}, path)
    choices = [str(c) for t in _choices(annotation) if get_origin(t) is Literal for c in get_args(t)]
    hint = _suggestion(text, choices)
    raise TwofoldError(f"{path} should be {_allowed(annotation)}; it was set to {text!r}.{hint}")


def _candidates(choice: object, text: str) -> Iterator[object]:
    """What `text` could stand for as data of one type."""
    if get_origin(choice) is Literal:
        yield from (allowed for allowed in get_args(choice) if str(allowed).lower() == text.lower())
    elif choice is types.NoneType and text.lower() in ("none", "null"):
        yield None
    elif choice is bool and text.lower() in ("true", "false"):
        yield text.lower() == "true"
    elif choice is int or choice is float:
        for kind in (int, float):  # through float alone, a whole number above 2**53 would lose digits
            with contextlib.suppress(ValueError):
                number = kind(text)
                yield int(number) if choice is int and number == number // 1 else number
    elif choice is str or choice is Path:
        yield text
    elif get_origin(choice) is tuple:
        inside = text.strip("()[] ")
        parts = [p.strip() for p in inside.split(",") if p.strip()]
        elements = _elements(choice, len(parts)) or (str,) * len(parts)
        found = [
            next((d for c in _choices(e) for d in _candidates(c, p)), p) for e, p in zip(elements, parts, strict=True)
        ]
        yield found


def _built(cls: type, values: dict[str, object], path: str) -> object:
    try:
        return cls(**values)
    except (ValueError, TypeError) as error:
        raise TwofoldError(f"{path} is not possible: {error}.") from error


def _leaves(config: object, prefix: str = "", text: str = "") -> Iterator[tuple[str, object, str]]:
    """(dotted key, value, documentation) of every setting that is no dataclass itself."""
    documented = _documentation(type(config))
    for f in _fields(config):
        value = getattr(config, f.name)
        if _is_config(value):
            yield from _leaves(value, f"{prefix}{f.name}.")
        else:
            yield prefix + f.name, value, documented.get(f.name, text)


@functools.cache
def _documentation(cls: type) -> dict[str, str]:
    """What a docstring says under "Attributes:", or the text below a field, each as one line."""
    section = (inspect.getdoc(cls) or "").partition("Attributes:")[2]
    texts: dict[str, str] = dict(re.findall(r"^ {4}(\w+): *(.+(?:\n {5,}.+)*)", section, re.MULTILINE))
    with contextlib.suppress(OSError):  # the source is not always there
        definition = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0]
        for field, below in itertools.pairwise(cast(ast.ClassDef, definition).body):
            if isinstance(field, ast.AnnAssign) and isinstance(below, ast.Expr):
                texts[ast.unparse(field.target)] = str(ast.literal_eval(below.value))
    return {name: " ".join(text.split()) for name, text in texts.items()}


def _fields(config: object) -> tuple["dataclasses.Field[Any]", ...]:
    return dataclasses.fields(cast(Any, config))


def _is_config(value: object) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _choices(annotation: object) -> tuple[object, ...]:
    """The members of a union, or the one type."""
    return get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)


def _elements(annotation: object, count: int) -> tuple[object, ...] | None:
    """The types of a tuple's elements, or None where a tuple of `count` is not allowed."""
    inside = next((get_args(c) for c in _choices(annotation) if get_origin(c) is tuple), ())
    if len(inside) == 2 and inside[1] is Ellipsis:
        return (inside[0],) * count
    return inside if len(inside) == count else None


def _allowed(annotation: object) -> str:
    """What a field may be, in words."""
    words: list[str] = []
    for choice in _choices(annotation):
        inside = get_args(choice)
        if get_origin(choice) is Literal:
            words += [str(c) for c in inside]
        elif get_origin(choice) is tuple and Ellipsis in inside:
            words.append(f"a list whose elements are each {_allowed(inside[0])}")
        elif get_origin(choice) is tuple:
            words.append(f"a list of {len(inside)} ({', '.join(_allowed(e) for e in inside)})")
        elif dataclasses.is_dataclass(choice):
            words.append(getattr(choice, "__name__", str(choice)))
        else:
            plain = {types.NoneType: "none", bool: "true or false", int: "a whole number", float: "a number",
                     str: "text", Path: "a path"}  # fmt: skip
            words.append(plain.get(cast(type, choice), str(choice)))
    return _either(words)


def _either(words: Sequence[str] | dict[str, Any]) -> str:
    """'a, b or c'."""
    listed = list(words)
    return listed[0] if len(listed) == 1 else f"{', '.join(listed[:-1])} or {listed[-1]}"


def _suggestion(word: str, known: Sequence[str] | dict[str, Any]) -> str:
    """' Did you mean ...?' where something known is spelt nearly so, or ends in the same name."""
    names = list(known)
    ends = [name for name in names if name.rpartition(".")[2] == word.rpartition(".")[2]]
    near = ends or difflib.get_close_matches(word, names, n=1, cutoff=0.6)
    return f" Did you mean {_either(near)}?" if near else ""


def _shown(value: object) -> str:
    """A value as `--set` takes it."""
    if isinstance(value, tuple):
        return ",".join(_shown(v) for v in cast(tuple[object, ...], value))
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _an_example(config: object) -> str:
    return next((f"{key}={_shown(value)}" for key, value, _ in _leaves(config)), "steps=200")
