"""Ways to damage a file, from a seed: bytes, JSON values, arrays of an npz, words of a text."""

import io
import json
import re
from collections.abc import Callable
from typing import Any

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]
ODD = (
    None, True, -1, 0, 10**18, 10**40, 1e300, -1e300, float("nan"), float("inf"), "", "x", "\ud800", "x" * 5000,
    "../../x", "a\0b", [], {}, [[]], [{}], {"a": 1}, [None], [1, "a", None],
)  # fmt: skip
"""Values of another kind than any file expects."""
WORDS = ("nan", "-inf", "1e999", "-1", "0", "9" * 5000, "x", "", '"', "]]", "}", "\x00", "<", "é", "1e40", "[[[[")


def damaged_bytes(raw: bytes, random: np.random.Generator) -> bytes:
    """Cut, changed, zeroed, doubled, lost or added bytes somewhere."""
    start, length = int(random.integers(0, len(raw) + 1)), int(random.integers(1, 40))
    noise = random.integers(0, 256, length, dtype=np.uint8).tobytes()
    kinds = (
        raw[:start],
        raw[:start] + noise + raw[start + length :],
        raw[:start] + bytes([raw[start - 1] ^ 1 << int(random.integers(8))]) + raw[start + 1 :],
        raw[:start] + bytes(length) + raw[start + length :],
        raw[:start] + raw[start : start + length] * 2 + raw[start + length :],
        raw[:start] + raw[start + length :],
        raw[:start] + noise + raw[start:],
        raw[start:],
    )
    return kinds[random.integers(len(kinds))]


def damaged_words(raw: bytes, random: np.random.Generator) -> bytes:
    """A text in which a number or word is another one."""
    text = raw.decode()
    places = list(re.finditer(r"[+-]?[0-9.]+(?:e[+-]?[0-9]+)?|\w+", text))
    place = places[random.integers(len(places))]
    return (text[: place.start()] + WORDS[random.integers(len(WORDS))] + text[place.end() :]).encode()


def damaged_json(raw: bytes, random: np.random.Generator) -> bytes:
    """JSON in which one value is of another kind, twice or gone."""
    content = json.loads(raw)
    places: list[tuple[Any, Any]] = []
    level: list[Any] = [content]
    while level:
        container = level.pop()
        keys = list(container) if isinstance(container, dict) else range(len(container))
        places += [(container, key) for key in keys]
        level += [container[key] for key in keys if isinstance(container[key], dict | list) and container[key]]
    container, key = places[random.integers(len(places))]
    odd = int(random.integers(len(ODD) + 2))
    if odd < len(ODD):
        container[key] = ODD[odd]
    elif odd == len(ODD) and isinstance(container, dict):
        del container[key]
    elif isinstance(container, dict):
        container["unknown"] = container[key]
    else:
        container.append(container[key])
    return json.dumps(content).encode()


def damaged_arrays(raw: bytes, random: np.random.Generator) -> bytes:
    """An npz in which one array has another type, shape or value, or is gone."""
    with np.load(io.BytesIO(raw)) as stored:
        arrays = dict(stored)
    name = sorted(arrays)[random.integers(len(arrays))]
    array = arrays.pop(name)
    flat = np.array(array).ravel()
    if flat.size and flat.dtype.kind in "fiu":
        values = (np.nan, np.inf, 1e300, -1.0, 0.0) if flat.dtype.kind == "f" else (-1, 0, 2**31 - 1)
        with np.errstate(over="ignore"):
            flat[random.integers(flat.size)] = np.array(values[random.integers(len(values))]).astype(flat.dtype)
    kinds: tuple[Any, ...] = (
        flat.reshape(array.shape), flat.reshape(array.shape), array[None], flat, array.astype(str),
        np.zeros((0, *array.shape[1:]), array.dtype), np.zeros(()), np.array(None), array.astype(complex),
        array[:1] if array.ndim else array, None,
    ) if array.dtype.kind in "fiub" else (np.zeros(3), None, np.array(["x", "y"]))  # fmt: skip
    changed = kinds[random.integers(len(kinds))]
    buffer = io.BytesIO()
    np.savez(buffer, **arrays, **({} if changed is None else {name: changed}))
    return buffer.getvalue()
