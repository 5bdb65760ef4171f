"""Valid input of every kind that the library reads, for the fuzzer to corrupt: scenes, images and meshes."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from bitmaps import write_bitmap
from seeds import shifted

SCENE = """<scene version="3.0.0">
    <default name="gloss" value="0.3"/>
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective" id="eye">
        <float name="fov" value="50"/>
        <transform name="to_world"><lookat origin="0, -4, 1" target="0, 0, 0" up="0, 0, 1"/></transform>
        <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="4"/><integer name="height" value="4"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <bsdf type="diffuse" id="paint">
        <texture type="bitmap" name="reflectance"><string name="filename" value="paint.png"/></texture>
    </bsdf>
    <bsdf type="roughconductor" id="metal">
        <string name="material" value="Cu"/><float name="alpha" value="$gloss"/>
    </bsdf>
    <bsdf type="roughplastic" id="vinyl">
        <rgb name="diffuse_reflectance" value="0.2, 0.4, 0.6"/>
        <float name="alpha" value="0.2"/>
        <float name="int_ior" value="1.5"/>
    </bsdf>
    <bsdf type="twosided" id="both">
        <bsdf type="principled">
            <rgb name="base_color" value="0.5, 0.6, 0.7"/>
            <float name="roughness" value="0.4"/><float name="specular" value="0.5"/>
        </bsdf>
    </bsdf>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="3"/><translate z="-1"/></transform>
        <ref id="paint"/>
    </shape>
    <shape type="sphere" id="ball">
        <point name="center" x="0" y="0" z="0"/><float name="radius" value="0.5"/>
        <ref id="metal"/>
    </shape>
    <shape type="ply" id="tent"><string name="filename" value="tent.ply"/><ref id="vinyl"/></shape>
    <shape type="obj" id="flag"><string name="filename" value="flag.obj"/><ref id="both"/></shape>
    <shape type="sphere" id="lamp">
        <point name="center" value="1, -1, 2"/><float name="radius" value="0.2"/>
        <emitter type="area"><rgb name="radiance" value="9, 8, 7"/></emitter>
    </shape>
    <emitter type="envmap" id="sky"><string name="filename" value="sky.hdr"/></emitter>
</scene>
"""

FOG = """<medium name="interior" type="heterogeneous">
    <volume name="sigma_t" type="gridvolume"><string name="filename" value="fog.vol"/></volume>
</medium>"""

PAINT = """<spectrum name="reflectance" filename="paint.spd"/>"""

OBJ = """v 0.6 0.2 0
v 1.2 0.2 0
v 1.2 0.2 0.8
v 0.6 0.2 0.8
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 -1 0
f 1/1/1 2/2/1 3/3/1
f 1/1/1 3/3/1 4/4/1
"""

SPECTRUM = (
    "\n".join(f"{nanometres} {0.2 + nanometres / 2000:.3f}" for nanometres in range(360, 831, 30)) + "\n"
)


def picture(height: int = 4, width: int = 8) -> np.ndarray:
    """Radiance that differs from pixel to pixel."""
    return np.random.default_rng(shifted(3)).uniform(0.2, 0.95, (height, width, 3)).astype(np.float32)


def hdr(image: np.ndarray) -> bytes:
    """Return an image as Radiance RGBE, run-length encoded as wide images are."""
    height, width, _ = image.shape
    exponent = np.floor(np.log2(image.max(-1))) + 1
    mantissa = np.clip(image * 256 / np.exp2(exponent)[..., None], 0, 255)
    rgbe = np.concatenate([mantissa, exponent[..., None] + 128], -1).astype(np.uint8)
    lines = b"".join(
        struct.pack(">BBH", 2, 2, width)
        + b"".join(bytes([width]) + rgbe[row, :, channel].tobytes() for channel in range(4))
        for row in range(height)
    )
    return f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {height} +X {width}\n".encode() + lines


def ply(binary: bool = True) -> bytes:
    """Return a tent of two triangles."""
    vertices = np.array([[-1, 0, -1], [-0.5, 0, 0], [0, 0, -1], [-0.5, 1, -1]], np.float32)
    faces = [(0, 1, 2), (1, 3, 2)]
    kind = "binary_little_endian" if binary else "ascii"
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if binary:
        return head + vertices.tobytes() + b"".join(struct.pack("<Biii", 3, *face) for face in faces)
    rows = [" ".join(map(str, row)) for row in vertices.tolist()] + [f"3 {a} {b} {c}" for a, b, c in faces]
    return head + ("\n".join(rows) + "\n").encode()


def serialized() -> bytes:
    """Return the tent in Mitsuba's own format: a header, a compressed mesh and a dictionary at the end."""
    vertices = np.array([[-1, 0, -1], [-0.5, 0, 0], [0, 0, -1]], np.float32)
    faces = np.array([[0, 1, 2]], np.uint32)
    body = struct.pack("<I", 0x1000) + b"tent\0" + struct.pack("<QQ", len(vertices), len(faces))
    packed = zlib.compress(body + vertices.tobytes() + faces.tobytes())
    return struct.pack("<HH", 0x041C, 4) + packed + struct.pack("<QI", 0, 1)


def volume() -> bytes:
    """Return a grid of 2×2×2 densities in Mitsuba's format."""
    grid = np.linspace(0.1, 0.8, 8, dtype=np.float32)
    return (
        b"VOL\x03"
        + struct.pack("<iiiii", 1, 2, 2, 2, 1)
        + struct.pack("<6f", -1, -1, -1, 1, 1, 1)
        + grid.tobytes()
    )


def write_files(mi: Any, folder: Path) -> dict[str, bytes]:
    """Return the valid files by name; Mitsuba writes the formats that it can write."""
    image = picture()
    eight_bit = (np.clip(image, 0, 1) * 255).astype(np.uint8)
    for name in ("sky.exr", "sky.pfm"):
        write_bitmap(folder / name, image)
    for name in ("paint.png", "paint.jpg", "paint.ppm"):
        write_bitmap(folder / name, eight_bit)
    written = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    return {
        **written,
        "sky.hdr": hdr(image),
        "tent.ply": ply(),
        "text.ply": ply(binary=False),
        "flag.obj": OBJ.encode(),
        "tent.serialized": serialized(),
        "fog.vol": volume(),
        "paint.spd": SPECTRUM.encode(),
    }
