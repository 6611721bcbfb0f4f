"""What a made person wears and looks like, drawn from a seed."""

from dataclasses import dataclass

import numpy as np

Color = tuple[float, float, float]
"""sRGB, 0..1."""

SHIRTS = ("stripes", "checks", "emblem", "buttons", "blocks")
HAIRS = ("crop", "quiff", "bob", "bun", "ponytail", "curls", "beanie")

_SKINS: tuple[Color, ...] = (
    (0.95, 0.78, 0.68), (0.88, 0.68, 0.55), (0.78, 0.57, 0.42),
    (0.62, 0.43, 0.31), (0.47, 0.31, 0.22), (0.36, 0.24, 0.18),
)  # fmt: skip
_HAIR_COLORS: tuple[Color, ...] = (
    (0.10, 0.08, 0.07), (0.24, 0.15, 0.10), (0.40, 0.25, 0.14),
    (0.62, 0.44, 0.24), (0.48, 0.20, 0.10), (0.52, 0.50, 0.49),
)  # fmt: skip
_EYE_COLORS: tuple[Color, ...] = ((0.25, 0.14, 0.08), (0.33, 0.48, 0.62), (0.35, 0.45, 0.28), (0.45, 0.32, 0.15))
_CLOTHS: tuple[tuple[Color, Color, Color], ...] = (
    ((0.80, 0.22, 0.20), (0.95, 0.92, 0.86), (0.20, 0.26, 0.42)),
    ((0.16, 0.36, 0.60), (0.95, 0.80, 0.30), (0.42, 0.40, 0.38)),
    ((0.93, 0.91, 0.86), (0.14, 0.22, 0.40), (0.55, 0.43, 0.30)),
    ((0.20, 0.50, 0.44), (0.95, 0.93, 0.85), (0.22, 0.22, 0.25)),
    ((0.93, 0.68, 0.22), (0.30, 0.20, 0.35), (0.26, 0.36, 0.52)),
    ((0.50, 0.28, 0.52), (0.90, 0.80, 0.86), (0.60, 0.58, 0.52)),
    ((0.88, 0.50, 0.36), (0.18, 0.30, 0.36), (0.36, 0.42, 0.30)),
    ((0.62, 0.78, 0.86), (0.84, 0.30, 0.28), (0.18, 0.20, 0.28)),
)
_SHOES: tuple[tuple[Color, Color], ...] = (
    ((0.90, 0.89, 0.86), (0.78, 0.74, 0.68)), ((0.72, 0.18, 0.16), (0.93, 0.92, 0.90)),
    ((0.18, 0.19, 0.22), (0.88, 0.87, 0.84)), ((0.22, 0.36, 0.60), (0.93, 0.92, 0.90)),
    ((0.45, 0.30, 0.20), (0.24, 0.18, 0.14)),
)  # fmt: skip


@dataclass(frozen=True)
class Look:
    """One person's clothes, hair and colours.

    Attributes:
        shirt: pattern, one of `SHIRTS`.
        sleeve: how far the sleeves reach; 1 is the elbow, 2 the wrist.
        trouser: how far the trousers reach; 1 is the knee, 2 the ankle.
        hair: style, one of `HAIRS`.
        beard: whether the jaw is dark with stubble.
        emblem: which chest emblem, 0..2.
        number: two digits on the back.
        shirt_color, second_color, trouser_color, shoe_color, sole_color, skin_color, hair_color, eye_color: sRGB, 0..1.
    """

    shirt: str
    sleeve: float
    trouser: float
    hair: str
    beard: bool
    emblem: int
    number: int
    shirt_color: Color
    second_color: Color
    trouser_color: Color
    shoe_color: Color
    sole_color: Color
    skin_color: Color
    hair_color: Color
    eye_color: Color


def sample_look(seed: int) -> Look:
    """The look of person `seed`; neighbouring seeds differ in shirt and hair style."""
    random = np.random.default_rng([seed, 1])
    shirt = SHIRTS[seed % len(SHIRTS)]
    first, second, third = _CLOTHS[(seed * 3 + int(random.integers(2))) % len(_CLOTHS)]
    shoe, sole = _SHOES[int(random.integers(len(_SHOES)))]
    long_sleeve = shirt == "buttons" or random.random() < 0.3
    hair = HAIRS[(seed * 3 + int(random.integers(3))) % len(HAIRS)]
    return Look(
        shirt=shirt,
        sleeve=float(random.uniform(1.72, 1.86) if long_sleeve else random.uniform(0.58, 0.72)),
        trouser=float(random.uniform(1.80, 1.88) if random.random() < 0.65 else random.uniform(0.80, 0.90)),
        hair=hair,
        beard=bool(random.random() < 0.45) and hair not in ("bob", "bun", "ponytail"),
        emblem=int(random.integers(3)),
        number=int(random.integers(10, 100)),
        shirt_color=first,
        second_color=second,
        trouser_color=third,
        shoe_color=shoe,
        sole_color=sole,
        skin_color=_SKINS[int(random.integers(len(_SKINS)))],
        hair_color=_HAIR_COLORS[int(random.integers(len(_HAIR_COLORS)))],
        eye_color=_EYE_COLORS[int(random.integers(len(_EYE_COLORS)))],
    )
