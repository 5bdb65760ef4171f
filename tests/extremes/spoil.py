"""How valid input is corrupted: bytes, words, structures and command lines, each with its own random generator."""

from __future__ import annotations

import contextlib
import copy
import gc
import io
import json
import random
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from extremes import specimens

Run = Callable[[], str | None]

# What each kind's share of the inputs is.
KINDS = {"good": 20, "xml": 500, "dict": 300, "picture": 400, "mesh": 300, "saved": 350, "command": 250}

NUMBERS = (
    "nan",
    "inf",
    "-inf",
    "-1",
    "0",
    "-0",
    "1e38",
    "1e-38",
    "1e300",
    "-1e300",
    "2147483648",
    "-2147483649",
)
NUMBERS += ("99999999999999999999", "1.5", "0x10", "١٢", "1,5", "--1", "1e", "true")
# Named by a scene, and therefore allowed to be read, wherever they are.
OUTSIDE = (
    "/dev/zero",
    "/dev/null",
    "/dev/full",
    "/etc/hostname",
    "/proc/self/mem",
    "../../../../etc/hostname",
)
# Named by a declaration that must not be followed.
FORBIDDEN = "/etc/os-release"
WORDS = (
    "",
    " ",
    ".",
    "..",
    "/",
    "abc",
    "$gloss",
    "$nothing",
    "<&>",
    "é",
    "\u202e",
    "x" * 100_000,
    "%s%n",
    "a;b",
    "~",
)
WORDS += ("paint.png", "sky.hdr", "tent.ply", "scene.xml", "missing.png", *OUTSIDE)
INTEGERS = (0, 1, 0x7F, 0xFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x10000, 0xFFFFFF00)


def own_folders() -> tuple[str, ...]:
    """The caches of Dr.Jit, matplotlib and Python, and the folder of this package."""
    home = Path.home()
    package = Path(__file__).resolve().parents[2]
    return (
        *(str(home / name) for name in (".drjit", ".cache", ".config/matplotlib")),
        str(package),
        "/var/tmp/",
    )


def is_named(path: str) -> bool:
    """Whether inputs name a file outside their folder."""
    return path in OUTSIDE or path.endswith("/etc/hostname")


class Spoiler:
    """Makes corrupted inputs from valid ones.

    Parameters
    ----------
    mi
        Mitsuba.
    folder
        An empty folder, where Mitsuba writes the pictures.
    """

    def __init__(self, mi: Any, folder: Path) -> None:
        self._mi = mi
        self._files = specimens.write_files(mi, folder)
        self.may_write: set[str] = set()
        self._result = _good_result(folder / "result.npz")

    def case(self, kind: str, rng: random.Random, folder: Path) -> Run:
        """Write one corrupted input into ``folder`` and return a function that tries it."""
        self.may_write = {"out"}
        run: Run = getattr(self, f"_{kind}")(rng, folder)
        return run

    def _lay_out(self, folder: Path, scene: str | bytes = specimens.SCENE, **files: bytes) -> Path:
        for name, content in {**self._files, **files}.items():
            (folder / name).write_bytes(content)
        path = folder / "scene.xml"
        path.write_bytes(scene if isinstance(scene, bytes) else scene.encode(errors="surrogatepass"))
        return path

    def _xml(self, rng: random.Random, folder: Path) -> Run:
        spoiled = rng.choice([_bytes_of_xml, _values_of_xml, _values_of_xml, _shape_of_xml, _tricks_of_xml])
        path = self._lay_out(folder, spoiled(rng))
        return lambda: _render(path)

    def _dict(self, rng: random.Random, folder: Path) -> Run:
        config = _scene_dict(self._mi)
        for _ in range(rng.choice([1, 1, 1, 2, 3])):
            _spoil_dict(rng, config, self._mi)
        return lambda: _render(config)

    def _good(self, rng: random.Random, folder: Path) -> Run:
        """Nothing is corrupted: all of it must succeed, or counts of refusals would mean nothing."""
        name = rng.choice(sorted(self._files))
        path = self._lay_out(folder, _scene_with(name, as_sky=name.startswith("sky")))
        (folder / "result.npz").write_bytes(self._result)

        def run() -> str | None:
            from scenecaptum import SceneCaptumError

            try:
                return (
                    _load(folder / "result.npz", self._result)
                    or _render(_scene_dict(self._mi))
                    or _render(path)
                )
            except SceneCaptumError as error:
                raise AssertionError(f"good input was refused: {error}") from error

        return run

    def _picture(self, rng: random.Random, folder: Path) -> Run:
        others = [name for name in self._files if name.startswith("paint")]
        name = rng.choice(["sky.hdr"] * 4 + ["sky.exr"] * 4 + ["sky.pfm"] + others)
        content = corrupt(rng, self._files[name], others=list(self._files.values()))
        if name == "sky.hdr" and rng.random() < 0.4:
            content = _spoil_hdr(rng)
        path = self._lay_out(folder, _scene_with(name, as_sky=rng.random() < 0.5), **{name: content})
        return lambda: _render(path)

    def _mesh(self, rng: random.Random, folder: Path) -> Run:
        name = rng.choice(
            ["tent.ply", "tent.ply", "text.ply", "flag.obj", "flag.obj", "tent.serialized", "fog.vol"]
        )
        content = corrupt(rng, self._files[name], others=list(self._files.values()))
        if name in ("text.ply", "flag.obj") and rng.random() < 0.6:
            content = _spoil_text(rng, self._files[name].decode()).encode()
        path = self._lay_out(folder, _scene_with(name), **{name: content})
        return lambda: _render(path)

    def _saved(self, rng: random.Random, folder: Path) -> Run:
        spoiled = (
            _tamper(rng, self._result)
            if rng.random() < 0.5
            else corrupt(rng, self._result, [b"PK", b"\x93NUMPY"])
        )
        path = folder / "result.npz"
        path.write_bytes(spoiled)
        return lambda: _load(path, self._result)

    def _command(self, rng: random.Random, folder: Path) -> Run:
        self._lay_out(folder)
        arguments = _command_line(rng)
        self.may_write = {
            word.split("/")[0] for word in arguments
        }  # a folder that --out names is what the user wants
        return lambda: _command(arguments)


def _scene_with(name: str, *, as_sky: bool = False) -> str:
    """Return a scene that uses the named file."""
    tent = '<shape type="ply" id="tent"><string name="filename" value="tent.ply"/>'
    match name.partition(".")[2]:
        case "obj":
            return specimens.SCENE
        case "ply":
            return specimens.SCENE.replace("tent.ply", name)
        case "serialized":
            return specimens.SCENE.replace(tent, tent.replace("ply", "serialized"))
        case "vol":
            return specimens.SCENE.replace(tent, tent + specimens.FOG)
        case "spd":
            return re.sub(r'<texture type="bitmap".*?</texture>', specimens.PAINT, specimens.SCENE)
    return specimens.SCENE.replace("sky.hdr" if as_sky else "paint.png", name)


def _render(scene: Any) -> str | None:
    """Load a scene, render it and take a gradient, as small as possible."""
    from scenecaptum import SceneRenderer

    gc.collect()  # each kernel includes the objects of every scene in the process
    inputs = ["reflectance", "emitters"]
    renderer = SceneRenderer(scene, inputs, resolution=(4, 4), spp=1, max_depth=2)
    image = renderer(renderer.leaves())
    image.mean().backward()
    return None if image.isfinite().all() else "a picture that is not finite"


# --- Bytes ----------------------------------------------------------------------------------------


def corrupt(rng: random.Random, data: bytes, others: list[bytes]) -> bytes:
    """Damage a file as disks, networks and attackers do."""
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        data = _damage(rng, data, others)
    return data


def _damage(rng: random.Random, data: bytes, others: list[bytes]) -> bytes:
    at = rng.randrange(len(data) + 1) if rng.random() < 0.5 else min(len(data), int(rng.expovariate(1 / 40)))
    width = rng.choice([1, 1, 2, 4, 16])
    match rng.randrange(9):
        case 0:
            return data[:at]
        case 1:
            return (
                data[:at]
                + bytes([(data[at] ^ (1 << rng.randrange(8))) if at < len(data) else 0])
                + data[at + 1 :]
            )
        case 2:
            return data[:at] + rng.randbytes(width) + data[at + width :]
        case 3:
            return data[:at] + rng.choice([b"\0", b"\xff"]) * width + data[at + width :]
        case 4:
            return data[:at] + data[at + width :]
        case 5:
            return data[:at] + rng.randbytes(rng.choice([1, 4, 1000])) + data[at:]
        case 6:
            return data[:at] + data[max(0, at - 64) : at] * rng.choice([1, 50]) + data[at:]
        case 7:
            number = rng.choice(INTEGERS).to_bytes(4, rng.choice(["little", "big"]))
            return data[:at] + number + data[at + 4 :]
        case _:
            return rng.choice([b"", rng.choice(others), rng.randbytes(len(data))])


def _spoil_text(rng: random.Random, text: str) -> str:
    """Replace one number or word of a text."""
    places = list(re.finditer(r"[-+.\w]+", text))
    place = rng.choice(places)
    by = rng.choice([*NUMBERS, *(str(n) for n in INTEGERS), *WORDS])
    return text[: place.start()] + by + text[place.end() :]


def _spoil_hdr(rng: random.Random) -> bytes:
    """Corrupt the header of a Radiance image."""
    head, _, rest = specimens.hdr(specimens.picture()).partition(b"-Y 4 +X 8\n")
    size = (rng.choice((*NUMBERS, "4", "8", "65536", "1000000", "")) for _ in range(2))
    axes = rng.choice(
        ["-Y {} +X {}\n", "+X {} -Y {}\n", "-Y {}\n", "-Y {} +X {}", "{} {}\n", "-X {} +Y {}\n"]
    )
    return head + axes.format(*size).encode() + rest


# --- Scene files ----------------------------------------------------------------------------------


def _bytes_of_xml(rng: random.Random) -> bytes:
    return corrupt(rng, specimens.SCENE.encode(), [b"\xff\xfe<\0s\0", b"{}", b"<html/>"])


def _values_of_xml(rng: random.Random) -> str:
    text = specimens.SCENE
    for _ in range(rng.choice([1, 1, 2, 4])):
        places = list(re.finditer(r'"([^"]*)"', text))
        place = rng.choice(places)
        by = rng.choice([*NUMBERS, *WORDS, *(p.group(1) for p in places)])
        by = by.replace("&", "&amp;").replace("<", "&lt;")
        text = text[: place.start(1)] + by + text[place.end(1) :]
    return text


def _shape_of_xml(rng: random.Random) -> str:
    root = ElementTree.fromstring(specimens.SCENE)
    for _ in range(rng.choice([1, 1, 2, 3])):
        parents = [node for node in root.iter() if len(node)]
        parent = rng.choice(parents)
        child = rng.choice(list(parent))
        match rng.randrange(6):
            case 0:
                parent.remove(child)
            case 1:
                parent.append(copy.deepcopy(child))
            case 2:
                rng.choice(list(root.iter())).append(copy.deepcopy(child))
            case 3:
                child.tag = rng.choice(
                    [node.tag for node in root.iter()] + ["include", "alias", "path", "vector", "é"]
                )
            case 4:
                for name in list(child.attrib):
                    if rng.random() < 0.5:
                        del child.attrib[name]
            case 5:
                child.set(
                    rng.choice(["type", "name", "id", "value", "filename", "version"]), rng.choice(WORDS[:12])
                )
    return ElementTree.tostring(root, encoding="unicode")


def _tricks_of_xml(rng: random.Random) -> str:
    """Return malicious XML."""
    head, body = '<scene version="3.0.0">', specimens.SCENE.partition(">")[2]
    number = rng.choice([10, 1000, 20_000, 200_000])
    laughs = "".join(f'<!ENTITY l{i} "{f"&l{i - 1};" * 10}">' for i in range(1, 10))
    gloss = '<default name="gloss" value="0.3"/>'
    chain = "".join(f'<default name="d{i}" value="$d{i - 1}$d{i - 1}"/>' for i in range(1, 40))
    return rng.choice(
        [
            f'<!DOCTYPE scene [<!ENTITY l0 "ha">{laughs}]>{head}<string name="x" value="&l9;"/>{body}',
            f'<!DOCTYPE scene [<!ENTITY f SYSTEM "{FORBIDDEN}">]>{head}<string name="x" value="&f;"/>{body}',
            f'<!DOCTYPE scene SYSTEM "file://{FORBIDDEN}">{head}{body}',
            f'<?xml version="1.0"?><?xml-stylesheet href="file://{FORBIDDEN}"?>{head}{body}',
            head + "<shape type='sphere'>" * number + "</shape>" * number + body,
            head + "<bsdf type='twosided'>" * number + "</bsdf>" * number + body,
            head + "<bsdf type='mask'>" * number + "<bsdf type='diffuse'/>" + "</bsdf>" * number + body,
            "<scene version='3.0.0'>" * number + body,
            head + '<include filename="scene.xml"/>' + body,
            head + '<include filename="paint.png"/>' + body,
            head + f'<include filename="{rng.choice(OUTSIDE)}"/>' + body,
            head + f'<path value="{rng.choice(OUTSIDE)}"/>' + body,
            head
            + '<bsdf type="twosided" id="a"><ref id="b"/></bsdf><bsdf type="twosided" id="b"><ref id="a"/></bsdf>'
            + body,
            head + '<shape type="instance"><ref id="g"/></shape>' + body,
            head
            + '<shape type="shapegroup" id="g"><shape type="instance"><ref id="g"/></shape></shape>'
            + body,
            head + '<alias id="x" as="y"/><alias id="paint" as="paint"/>' + body,
            head + f'<default name="d0" value="aaaa"/>{chain}<string name="x" value="$d39"/>' + body,
            head + '<default name="gloss" value="$gloss"/>' + body.replace(gloss, ""),
            specimens.SCENE.replace(
                "3.0.0", rng.choice(["0.1.0", "99.0.0", "2.1.0", "", "3", "a.b.c", "-1.0.0"])
            ),
            f"<!--{'-' * number}>" + specimens.SCENE,
            head + "<x " + " ".join(f"a{i}=''" for i in range(number)) + "/>" + body,
            f'<?xml version="1.0" encoding="{rng.choice(["utf-16", "nonsense", "utf-7"])}"?>{head}{body}',
            specimens.SCENE * 2,
            specimens.SCENE.replace("<scene", "<sensor").replace("</scene", "</sensor"),
        ]
    )


# --- Scene dicts ----------------------------------------------------------------------------------


def _scene_dict(mi: Any) -> dict[str, Any]:
    image = specimens.picture()
    return {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": 3},
        "eye": {
            "type": "perspective",
            "fov": 50.0,
            "to_world": mi.ScalarTransform4f().look_at(origin=[0, -4, 1], target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": 2},
        },
        "metal": {"type": "roughconductor", "material": "Cu", "alpha": 0.3},
        "ball": {"type": "sphere", "radius": 0.5, "bsdf": {"type": "ref", "id": "metal"}},
        "floor": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -1]).scale(3),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(image), "raw": True},
            },
        },
        "glass": {
            "type": "sphere",
            "center": [1, 0, 0],
            "radius": 0.3,
            "bsdf": {"type": "dielectric", "int_ior": 1.5},
        },
        "toy": {
            "type": "cube",
            "bsdf": {"type": "principled", "base_color": {"type": "rgb", "value": [0.1, 0.5, 0.7]}},
        },
        "lamp": {
            "type": "sphere",
            "center": [1, -1, 2],
            "radius": 0.2,
            "emitter": {"type": "area", "radiance": 9.0},
        },
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(image)},
    }


def _spoil_dict(rng: random.Random, config: dict[str, Any], mi: Any) -> None:
    """Change something somewhere in a scene dict."""
    inner = list(_dicts(config))
    place = rng.choice(inner)
    if not place:
        return
    key = rng.choice(list(place))
    endless: dict[str, Any] = {"type": "twosided"}
    endless["bsdf"] = endless
    deep: Any = {"type": "diffuse"}
    for _ in range(rng.choice([5, 200, 900])):
        deep = {"type": "mask", "bsdf": deep}

    def bitmap(*shape: int, value: float = 0.0) -> Any:
        return mi.Bitmap(np.full(shape, value, np.float32))

    values: list[Any] = [
        None, True, 0, -1, 2**31, 2**63, 10**30, 1.5, float("nan"), float("inf"), -1e38, 1e300, "", "abc",
        "x" * 10_000, "/dev/zero", b"bytes", 1j, object(), [], [1], [1, 2, 3, 4], ["a", "b", "c"], (), {},
        lambda: 3,
        {"type": ""}, {"type": None}, {"type": "rgb", "value": [1, 2]},
        {"type": "rgb", "value": [float("nan")] * 3},
        {"type": "rgb", "value": "red"}, {"type": "rgb", "value": -1}, {"type": "ref", "id": "nothing"},
        {"type": "ref"}, {"type": "scene"}, {"type": "bitmap"}, {"type": "bitmap", "filename": "missing.png"},
        {"type": "bitmap", "filename": ".."},
        {"type": "bitmap", "bitmap": bitmap(1, 1, 3, value=np.nan), "raw": True},
        {"type": "bitmap", "bitmap": bitmap(1, 4096, 1), "raw": True},
        {"type": "bitmap", "bitmap": bitmap(2, 2, 5), "raw": True},
        {"type": "bitmap", "data": mi.TensorXf(np.full((2, 2), 0.5, np.float32))},
        {"type": "bitmap", "data": mi.TensorXf(np.zeros((1, 2, 3), np.float32))},
        {"type": "envmap", "bitmap": bitmap(1, 1, 3)}, {"type": "constant", "radiance": -1.0}, np.zeros(3),
        np.zeros((4, 4)), np.float64(0.2), np.int64(3), mi.ScalarTransform4f(np.zeros((4, 4))),
        mi.ScalarTransform4f(np.full((4, 4), np.nan)), bitmap(2, 2, 3), copy.copy(config.get("metal")),
        config.get("sky"), type, endless, deep,
    ]  # fmt: skip
    match rng.randrange(6):
        case 0:
            del place[key]
        case 1:
            place[
                rng.choice(["type", "bsdf", "emitter", "x", "", "a.b", "é", "filename", "bitmap", "alpha"])
            ] = rng.choice(values)
        case 2 if isinstance(place.get("type"), str):
            place["type"] = rng.choice(
                [str(one.get("type")) for one in inner] + ["mask", "roughplastic", "point", "ply", "nonsense"]
            )
        case 3:
            place[rng.choice([1, None, ("a",), 1.5])] = rng.choice(values)
        case _:
            place[key] = rng.choice(values)


def _dicts(config: dict[Any, Any]) -> list[dict[Any, Any]]:
    """Return a dict and all those in it, each once, also if they are circular."""
    found, pending = [], [config]
    while pending:
        one = pending.pop()
        if not any(one is other for other in found):
            found.append(one)
            pending += [value for value in one.values() if isinstance(value, dict)]
    return found


# --- Saved results --------------------------------------------------------------------------------


def _good_result(path: Path) -> bytes:
    from results import make

    make().save(path)
    return path.read_bytes()


def _tamper(rng: random.Random, good: bytes) -> bytes:
    """Change a member of the archive, and write it again with correct zip checksums."""
    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice([*members, "header.npy", "header.npy"])
    match rng.randrange(9):
        case 0:
            del members[name]
        case 1:
            members[name] = _npy(np.array([print], dtype=object))
        case 2:
            members[name] = corrupt(rng, members[name], list(members.values()))
        case 3:
            members[name] = _huge(rng)
        case 4:
            members[rng.choice(["../evil.npy", "/tmp/evil.npy", "extra.npy", "header.npy/x"])] = members.pop(
                name
            )
        case 5:
            members[name] = bytes(2**26)
        case 6:
            array = np.load(io.BytesIO(members[name]), allow_pickle=False)
            if array.dtype.kind == "f" and array.size:
                array = array + rng.choice([np.nan, 1.0, 1e-3])
            elif array.dtype.kind == "i":
                array = array + rng.choice([1, -1, 10**6])
            members[name] = _npy(array.astype(array.dtype))
        case 7:
            first, second = rng.sample(sorted(members), 2)
            members[first], members[second] = members[second], members[first]
        case _:
            members["header.npy"] = _npy(
                np.array(_spoil_header(rng, str(np.load(io.BytesIO(members["header.npy"])))))
            )
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()


def _npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array(out, array, allow_pickle=True)
    return out.getvalue()


def _huge(rng: random.Random) -> bytes:
    """Return the header of an array that no memory can hold."""
    shape = rng.choice(["(1000000000000,)", "(-1,)", "(99999999999999999999,)", "(2, 3", "(0,)", "('a',)"])
    head = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n"
    return b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode()


def _spoil_header(rng: random.Random, text: str) -> str:
    header = json.loads(text)
    places = [header, header["info"], header["surfaces"]]
    place = rng.choice(places)
    key = rng.choice(list(place))
    values = [None, -1, 10**400, "", "x", [], [1], {}, {"a": 1}, True, [["a"]], ["../x"], float("nan")]
    if rng.random() < 0.3:
        del place[key]
    else:
        place[key] = rng.choice(values)
    return rng.choice([json.dumps(header)] * 9 + [json.dumps(header)[:-5], "[" * 100_000, "null", "3"])


def _load(path: Path, good: bytes) -> str | None:
    """Load a result and use it; if it loads, it must equal the one that was saved."""
    from scenecaptum import SceneAttribution

    loaded = SceneAttribution.load(path)
    str(loaded)
    loaded.heatmap()
    again = path.with_name("out")
    again.mkdir()
    loaded.save(again / "again.npz")
    assert _contents((again / "again.npz").read_bytes()) == _contents(good), "something else was loaded"
    return None


def _contents(archive: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        return {name: opened.read(name) for name in opened.namelist()}


# --- Command lines --------------------------------------------------------------------------------


SMALL = ["--resolution", "4x4", "--spp", "2", "--max-depth", "2", "--no-progress", "--out", "out"]
LINES = (
    ["attribute", "scene.xml", *SMALL, "--replicates", "2"],
    [
        "attribute",
        "cornell-box",
        *SMALL,
        "--replicates",
        "2",
        "--json",
        "--metric",
        "luminance",
        "--seed",
        "3",
    ],
    ["attribute", "cornell-box", *SMALL, "--replicates", "2", "--inputs", "emitters", "--target", "0"],
    ["attribute", "cornell-box", *SMALL, "--replicates", "2", "--tolerance", "0.5", "--time-limit", "1"],
    ["attribute", "cornell-box", *SMALL, "--metric", "ugr", "--threshold-factor", "5", "--sensor", "fisheye"],
    [
        "tradeoff",
        "cornell-box",
        *SMALL,
        "--vary",
        "spp=1,2",
        "--runs",
        "2",
        "--reference-spp",
        "4",
        "--tolerance",
        "0.1",
    ],
    ["validate", "cornell-box", *SMALL, "--top", "1", "--json"],
    ["doctor"],
)
# Very many samples are a long job, not bad input.
PATIENT = (
    "--spp",
    "--replicates",
    "--runs",
    "--reference-spp",
    "--top",
    "--time-limit",
    "--resolution",
    "--vary",
    "--tolerance",
)
JUNK = (
    "--help",
    "--version",
    "--",
    "-",
    "-x",
    "--no-such-option",
    "--out",
    "--spp",
    "--json",
    "attribute",
    "é",
    "\n",
    "a\0b",
)
JUNK += (
    "../scene.xml",
    "missing.xml",
    "paint.png",
    "flag.obj",
    ".",
    "",
    "x" * 5000,
    "*",
    "%s",
    "--spp=",
    "--seed=-1",
    "--res=2x2",
)
VALUES = (
    "",
    "-1",
    "0",
    "nan",
    "inf",
    "-inf",
    "1e309",
    "abc",
    "1.5",
    "２",
    "0x10",
    "--json",
    "4x",
    "x4",
    "0x0",
    "4X4",
    "-4x4",
    "1e3x2",
)
VALUES += (
    "luminance:",
    ":f",
    "os:system",
    "os:sep",
    "json:loads",
    "scene.xml:f",
    "missing.py:f",
    "ugr",
    "all",
    "materials",
    "*",
)
VALUES += (
    "[",
    "fisheye",
    "7",
    "spp=",
    "=1",
    "spp=0",
    "spp=a",
    "max_depth=-5",
    "resolution=1",
    "replicates=1,2",
    "seed=shifted(1)",
    "a\0b",
)
VALUES += ("scene.xml", "out/../../out", "/proc/nowhere", "/dev/null", "/dev/full", "x" * 300)
HUGE = ("99999999999999999999", "4294967296", "2147483648", "-99999999999999999999")


def _command_line(rng: random.Random) -> list[str]:
    words = list(rng.choice(LINES))
    for _ in range(rng.choice([1, 1, 2, 3])):
        at = rng.randrange(len(words))
        match rng.randrange(8):
            case 0:
                del words[at]
            case 1:
                words.insert(at, rng.choice(JUNK))
            case 2:
                words.insert(at, words[rng.randrange(len(words))])
            case 3:
                words[at] = rng.choice(JUNK)
            case 4:
                words[at] = words[at][: rng.randrange(len(words[at]) + 1)]
            case _:
                options = [i for i, word in enumerate(words[:-1]) if word.startswith("--")]
                if options:
                    option = rng.choice(options)
                    words[option + 1] = rng.choice(VALUES if words[option] in PATIENT else VALUES + HUGE)
        words = words or ["doctor"]
    # Whatever was removed from it, it must stay a small job.
    if words[0] in ("attribute", "tradeoff", "validate"):
        words[1:1] = SMALL[:6]
    if "tradeoff" in words[:1] and "--vary" not in words:
        words += ["--vary", "spp=1,2", "--runs", "2", "--reference-spp", "4"]
    return words


def _command(arguments: list[str]) -> str | None:
    """Run a command; raise the one line that a user would see, or an AssertionError if there are more."""
    from scenecaptum import SceneCaptumError, cli

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = cli.main(arguments)
        except SystemExit as end:  # argparse
            status = int(end.code or 0)
    said = err.getvalue()
    lines = said.strip().splitlines()
    if (
        status == 2
        and lines
        and ": error: " in lines[-1]
        and (len(lines) == 1 or lines[0].startswith("usage:"))
    ):
        raise SceneCaptumError(lines[-1])
    assert status in (0, 1), f"{arguments}: status {status}, {said[-300:]!r}"
    assert "Traceback" not in said, said
    return None
