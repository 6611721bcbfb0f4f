r"""HDR and wide-gamut video as 8-bit sRGB.

The steps, each of which is one function:

1. signal to light: for PQ the display's light in cd/m² (SMPTE ST 2084), for HLG the scene's light (ITU-R BT.2100) and
   from it the display's, \( L = 1000 \, Y^{0.2} E \), as a display with a peak of 1000 cd/m² shows it;
2. highlights are rolled off by the curve of ITU-R BT.2390, 5.4.1, from a peak of 1000 to 203 cd/m², the level of white
   (ITU-R BT.2408): colours below 88 cd/m² stay, brighter ones are compressed. It acts on the largest of the three
   channels, and the others keep their ratio to it, so that hues stay;
3. the primaries of BT.2020 or P3 become those of sRGB (linear, ITU-R BT.2087), and what lies outside is clipped;
4. the curve of sRGB, 8 bits.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, UInt8, UInt16

PEAK, WHITE = 1000.0, 203.0
"""Of the video and of sRGB, cd/m²."""
PQ, HLG = 16, 18
"""Numbers of the transfer functions (ISO/IEC 23091-2)."""
FULL = 255 * 256
"""The value of white in images of 16 bits; brighter ones count as white."""
_LUMINANCE = np.array([0.2627, 0.6780, 0.0593])  # Of BT.2020's primaries.
_STEPS = 65536  # Of the tables.

_TO_SRGB = {
    9: np.array([[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]]),
    12: np.array([[1.224940, -0.224940, 0.0], [-0.042057, 1.042057, 0.0], [-0.019638, -0.078636, 1.098274]]),
}
"""From the linear light of other primaries (BT.2020, P3 with D65) to that of sRGB's."""
_TRANSFERS = {PQ: "PQ", HLG: "HLG"}
_PRIMARIES = {9: "BT.2020", 12: "Display P3"}


@dataclass(frozen=True)
class ColorSpace:
    """How a video codes colours, by the numbers of ISO/IEC 23091-2.

    Attributes:
        transfer: from signal to light; what is neither `PQ` nor `HLG` is taken as sRGB's curve.
        primaries: 9 for BT.2020, 12 for P3; others are taken as sRGB's.
    """

    transfer: int
    primaries: int

    @property
    def is_hdr(self) -> bool:
        """Its whites are brighter than paper."""
        return self.transfer in _TRANSFERS

    @property
    def is_srgb(self) -> bool:
        """Nothing has to be done."""
        return not self.is_hdr and self.primaries not in _PRIMARIES

    def remark(self, name: str) -> str:
        """What was done with it, a sentence.

        >>> ColorSpace(HLG, 9).remark("clip.mov")
        'clip.mov: HDR video (HLG, BT.2020) was tone-mapped to sRGB.'
        >>> ColorSpace(1, 12).remark("clip.mov")
        'clip.mov: wide-gamut video (Display P3) was converted to sRGB.'
        """
        primaries = _PRIMARIES.get(self.primaries, "BT.709")
        if self.is_hdr:
            return f"{name}: HDR video ({_TRANSFERS[self.transfer]}, {primaries}) was tone-mapped to sRGB."
        return f"{name}: wide-gamut video ({primaries}) was converted to sRGB."


def to_srgb(signal: UInt16[np.ndarray, "h w 3"], space: ColorSpace) -> UInt8[np.ndarray, "h w 3"]:
    """8-bit sRGB of an image whose white is `FULL`, as FFmpeg's conversion to 16 bits has it."""
    light = _linear_table(space.transfer)[signal]
    if space.transfer == HLG:
        light = light * np.power(np.maximum(light @ _LUMINANCE.astype(np.float32), 1e-12), np.float32(0.2))[..., None]
    if space.is_hdr:
        light = _rolled_off(light)
    if space.primaries in _TO_SRGB:
        light = light @ _TO_SRGB[space.primaries].T.astype(np.float32)
    return _srgb_table()[np.round(np.clip(light, 0, 1) * (_STEPS - 1)).astype(np.uint16)]


def _rolled_off(light: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Light in units of the peak, its highlights compressed, in units of white."""
    largest = light.max(-1)
    place = np.sqrt(np.clip(largest, 0, 1)) * (_STEPS - 1)  # Finer where it is dark.
    gain = _gain_table()[np.round(place).astype(np.uint16)] / np.maximum(largest, 1)
    return light * gain[..., None]


@lru_cache(maxsize=4)
def _linear_table(transfer: int) -> Float[np.ndarray, "n"]:
    signal = np.minimum(np.arange(_STEPS) / FULL, 1)
    if transfer == PQ:
        return (pq_light(signal) / PEAK).astype(np.float32)
    return (hlg_light(signal) if transfer == HLG else srgb_light(signal)).astype(np.float32)


@lru_cache(maxsize=1)
def _gain_table() -> Float[np.ndarray, "n"]:
    largest = np.maximum(np.linspace(0, 1, _STEPS), 1e-5) ** 2 * PEAK
    return (PEAK * roll_off(largest) / largest * PEAK / WHITE).astype(np.float32)


@lru_cache(maxsize=1)
def _srgb_table() -> UInt8[np.ndarray, "n"]:
    return np.round(255 * srgb_signal(np.linspace(0, 1, _STEPS))).astype(np.uint8)


def pq_light(signal: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    r"""Light of PQ signals 0..1, cd/m² (SMPTE ST 2084).

    \[ L = 10000 \left( \frac{\max(V^{1/m_2} - c_1, 0)}{c_2 - c_3 V^{1/m_2}} \right)^{1/m_1} \]

    >>> pq_light(np.array([0.0, 0.5081, 1.0])).round().tolist()
    [0.0, 100.0, 10000.0]
    """
    power = np.power(signal, 32 / 2523)
    return 10000 * np.power(np.maximum(power - 3424 / 4096, 0) / (2413 / 128 - 2392 / 128 * power), 8192 / 1305)


def pq_signal(light: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """PQ signals 0..1 of light in cd/m²; the inverse of `pq_light`."""
    power = np.power(np.maximum(light, 0) / 10000, 1305 / 8192)
    return np.power((3424 / 4096 + 2413 / 128 * power) / (1 + 2392 / 128 * power), 2523 / 32)


def hlg_light(signal: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    r"""Light of the scene, 0..1, of HLG signals 0..1 (ITU-R BT.2100).

    \[ E = \begin{cases} V^2 / 3 & V \le 1/2 \\ (e^{(V - c) / a} + b) / 12 & \text{else} \end{cases} \]

    >>> hlg_light(np.array([0.0, 0.5, 0.75, 1.0])).round(3).tolist()
    [0.0, 0.083, 0.265, 1.0]
    """
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((np.maximum(signal, 0.5) - c) / a) + b) / 12)


def roll_off(light: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    r"""Light up to `PEAK` with its highlights compressed to `WHITE`, in units of `PEAK` (ITU-R BT.2390, 5.4.1).

    With both as PQ signals in units of the peak's, \(E\) and the white's \(m\), all below the knee
    \(k = 1.5 m - 0.5\) stays, and with \(T = (E - k) / (1 - k)\) the rest follows the Hermite spline

    \[ (2T^3 - 3T^2 + 1) k + (T^3 - 2T^2 + T)(1 - k) + (-2T^3 + 3T^2) m . \]

    >>> (PEAK * roll_off(np.array([0.0, 50.0, 203.0, 1000.0, 4000.0]))).round().tolist()
    [0.0, 50.0, 159.0, 203.0, 203.0]
    """
    peak, most = pq_signal(np.array([PEAK, WHITE]))
    bright = np.clip(pq_signal(light) / peak, 0, 1)
    most = most / peak
    knee = 1.5 * most - 0.5
    t = np.maximum(bright - knee, 0) / (1 - knee)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    return pq_light(np.where(bright < knee, bright, spline) * peak) / PEAK


def srgb_light(signal: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """Linear light of sRGB signals, both 0..1 (IEC 61966-2-1)."""
    return np.where(signal <= 0.04045, signal / 12.92, np.power((np.maximum(signal, 0.04045) + 0.055) / 1.055, 2.4))


def srgb_signal(light: Float[np.ndarray, "*s"]) -> Float[np.ndarray, "*s"]:
    """sRGB signals of linear light, both 0..1; the inverse of `srgb_light`."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.power(np.maximum(light, 0.0031308), 1 / 2.4) - 0.055)
