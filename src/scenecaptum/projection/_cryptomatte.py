"""Cryptomatte: object ids and coverages of each pixel, as channels of an OpenEXR image.

References
----------
Friedman and Jones, "Fully automatic ID mattes with support for motion blur and transparency", 2015, and the
Cryptomatte specification 1.2.0, https://github.com/Psyop/Cryptomatte.
"""

from __future__ import annotations

import json
import math

import numpy as np
from numpy.typing import NDArray

from ._surfaces import SurfaceMap

LAYER = "CryptoObject"


def layers(surfaces: SurfaceMap) -> tuple[dict[str, NDArray[np.float32]], dict[str, str]]:
    """Return the channels ``(H, W)`` by name, and the metadata of the image.

    The objects of a pixel are sorted by decreasing coverage, two per layer: ids in R and B, coverages in G and A.
    The background is left out.
    """
    ids = np.array([identifier(name) for name in surfaces.objects], np.uint32).view(np.float32)
    is_object = surfaces.object_index != len(surfaces.objects) - 1
    pixel, index, fraction = (
        array[is_object] for array in (surfaces.pixel, surfaces.object_index, surfaces.fraction)
    )
    order = np.lexsort((index, -fraction, pixel))
    pixel, index, fraction = pixel[order], index[order], fraction[order]
    rank = np.arange(len(pixel)) - np.searchsorted(pixel, pixel)  # within each pixel
    count = 2 * math.ceil((rank.max(initial=0) + 1) / 2)
    planes = np.zeros((surfaces.shape[0] * surfaces.shape[1], count, 2), np.float32)
    planes[pixel, rank] = np.stack([ids[index], fraction], axis=-1)
    planes = planes.reshape(*surfaces.shape, count // 2, 4)
    channels = {
        f"{LAYER}{layer:02}.{channel}": planes[..., layer, number]
        for layer in range(count // 2)
        for number, channel in enumerate("RGBA")
    }
    return channels, _metadata(surfaces.objects[:-1])


def _metadata(names: tuple[str, ...]) -> dict[str, str]:
    key = f"cryptomatte/{murmur3(LAYER):08x}"[: len("cryptomatte/") + 7]
    return {
        f"{key}/name": LAYER,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps({name: f"{identifier(name):08x}" for name in names}),
    }


def identifier(name: str) -> int:
    """Return the id of a name: its hash, with the exponent changed if the float is inf, NaN or subnormal."""
    bits = murmur3(name)
    exponent = bits >> 23 & 0xFF
    return bits ^ 1 << 23 if exponent in (0, 0xFF) else bits


def murmur3(text: str) -> int:
    """Return the 32-bit MurmurHash3 of a text in UTF-8, with seed 0 (Appleby, 2011)."""
    data = text.encode()
    tail = len(data) - len(data) % 4
    state = 0
    for start in range(0, tail, 4):
        state ^= _scramble(int.from_bytes(data[start : start + 4], "little"))
        state = (_rotate_left(state, 13) * 5 + 0xE6546B64) & 0xFFFFFFFF
    state ^= _scramble(int.from_bytes(data[tail:], "little")) ^ len(data)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
        state = (state ^ state >> shift) * factor & 0xFFFFFFFF
    return state


def _scramble(block: int) -> int:
    return _rotate_left(block * 0xCC9E2D51 & 0xFFFFFFFF, 15) * 0x1B873593 & 0xFFFFFFFF


def _rotate_left(word: int, bits: int) -> int:
    return (word << bits | word >> (32 - bits)) & 0xFFFFFFFF
