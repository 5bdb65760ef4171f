"""Saving and loading attributions as NumPy ``.npz`` with a JSON header and a checksum, without pickle."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import SceneCaptumError
from ..files import atomic_write
from ..projection import SurfaceMap, TexelMap
from ._data import AttributionData
from ._texel_blocks import TexelBlocks, choose_blocks

FORMAT = "scenecaptum attribution 4"

_TENSOR_FIELDS = (
    "attributions",
    "standard_error",
    "bias",
    "quadrature_error",
    "replicates",
    "covariance",
    "extents",
)
# Elementwise, so that those of large textures are stored in blocks.
_TEXEL_FIELDS = ("attributions", "standard_error", "bias")
_BLOCK_PARTS = ("/visible", "/means")
_SCALAR_FIELDS = ("metric_value", "metric_standard_error", "convergence_delta", "convergence_delta_error")
_SURFACE_FIELDS = ("pixel", "object_index", "fraction")
_MAP_FIELDS = ("entry", "texel", "weight")


def write_file(
    attribution: AttributionData, path: str | os.PathLike[str] | BinaryIO, *, exact_texels: bool
) -> None:
    """Write an attribution to an open binary file, or to a path atomically."""
    members = _members(attribution, exact_texels=exact_texels)
    if not isinstance(path, (str, os.PathLike)):
        np.savez_compressed(path, checksum=_checksum(members), **members)
        return
    with atomic_write(path) as partial, partial.open("wb") as file:
        np.savez_compressed(file, checksum=_checksum(members), **members)


def _members(attribution: AttributionData, *, exact_texels: bool) -> dict[str, Any]:
    """Return the JSON header and the arrays of a file."""
    names = list(attribution)
    blocks = {} if exact_texels else choose_blocks(attribution)
    header: dict[str, Any] = {
        "format": FORMAT,
        "names": names,
        "fields": [field for field in _TENSOR_FIELDS if getattr(attribution, field)],
        "labels": dict(attribution.labels),
        "info": dict(attribution.info),
        "parameter_values": list(attribution.parameter_values),
        "blocks": {name: {"shape": parts.shape, "side": parts.side} for name, parts in blocks.items()},
        **{field: getattr(attribution, field) for field in _SCALAR_FIELDS},
    }
    arrays: dict[str, Any] = {
        f"{field}/{index}{part}": array
        for field in header["fields"]
        for index, name in enumerate(names)
        for part, array in _parts(attribution, field, name, blocks.get(name)).items()
    }
    for index, value in enumerate(attribution.parameter_values.values()):
        arrays[f"parameter_values/{index}"] = value.numpy(force=True)
    if attribution.metric_error_parts is not None:
        arrays["metric_error_parts"] = attribution.metric_error_parts.numpy(force=True)
    if attribution.image is not None:
        arrays["image"] = attribution.image.numpy(force=True)
    if (surfaces := attribution.surfaces) is not None:
        header["surfaces"] = {
            "shape": surfaces.shape,
            "objects": surfaces.objects,
            "parameters": surfaces.parameters,
            "texels": list(surfaces.texels),
        }
        for field in _SURFACE_FIELDS:
            arrays[f"surfaces/{field}"] = getattr(surfaces, field)
        for index, shown in enumerate(surfaces.texels.values()):
            for field in _MAP_FIELDS:
                arrays[f"texels/{index}/{field}"] = getattr(shown, field)
    return {"header": json.dumps(header), **arrays}


def _parts(
    attribution: AttributionData, field: str, name: str, blocks: TexelBlocks | None
) -> dict[str, NDArray[Any]]:
    """Return the arrays of one tensor: itself, or its visible texels and the means of the others."""
    tensor: torch.Tensor = getattr(attribution, field)[name]
    if blocks is None or field not in _TEXEL_FIELDS:
        return {"": tensor.numpy(force=True)}
    split = (
        blocks.split_errors(tensor, attribution[name]) if field == "standard_error" else blocks.split(tensor)
    )
    return dict(zip(_BLOCK_PARTS, split, strict=True))


def read_file(path: str | os.PathLike[str] | BinaryIO) -> dict[str, Any]:
    """Return the fields of an attribution that ``write_file`` wrote."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays["header"]))
        if header["format"] != FORMAT:
            raise SceneCaptumError(
                f"{path} has the format {header['format']!r}, but this version reads {FORMAT!r}: attribute again."
            )
        if str(arrays.pop("checksum")) != _checksum(arrays):
            raise SceneCaptumError(
                f"{path} is damaged or was changed after it was saved: its contents do not match their checksum. "
                "Use an intact copy, or attribute again."
            )
        return _restore(header, arrays)
    except FileNotFoundError:
        raise SceneCaptumError(f"There is no saved attribution at {path}.") from None
    except SceneCaptumError:
        raise
    except Exception as error:  # any error of zip, NumPy or JSON is due to the file
        # Not that the file may be unpickled, which NumPy advises for whatever it does not know.
        reason = "" if "pickle" in str(error) else f" ({type(error).__name__}: {_brief(error)})"
        raise SceneCaptumError(
            f"{path} is not a saved attribution, or it is damaged{reason}. "
            "Save it again with SceneAttribution.save."
        ) from error


def _checksum(arrays: Mapping[str, Any]) -> str:
    """Return the SHA-256 hash of all members, to detect damage and accidental edits, not tampering."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode() + array.tobytes())
    return digest.hexdigest()


def _brief(error: Exception) -> str:
    """Return an error message on one line of limited length."""
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"{text[:200]} …"


def _restore(header: dict[str, Any], file: Any) -> dict[str, Any]:
    surfaces = _restore_surfaces(header["surfaces"], file) if header.get("surfaces") else None
    blocks = {}
    for name, described in header["blocks"].items():
        assert surfaces is not None
        visible = np.unique(surfaces.texels[name].texel)
        blocks[name] = TexelBlocks(tuple(described["shape"]), visible, described["side"])

    def tensor(field: str, index: int, name: str) -> torch.Tensor:
        if name not in blocks or field not in _TEXEL_FIELDS:
            return torch.from_numpy(file[f"{field}/{index}"])
        join = blocks[name].join_errors if field == "standard_error" else blocks[name].join
        visible, means = (file[f"{field}/{index}{part}"] for part in _BLOCK_PARTS)
        return join(visible, means)

    def tensors(field: str, names: list[str]) -> dict[str, torch.Tensor]:
        return {name: tensor(field, index, name) for index, name in enumerate(names)}

    fields: dict[str, Any] = {
        "standard_error": None,
        **{field: tensors(field, header["names"]) for field in header["fields"]},
        "parameter_values": tensors("parameter_values", header["parameter_values"]),
        **{field: header[field] for field in (*_SCALAR_FIELDS, "labels", "info")},
        "surfaces": surfaces,
    }
    if "metric_error_parts" in file:
        fields["metric_error_parts"] = torch.from_numpy(file["metric_error_parts"])
    if "image" in file:
        fields["image"] = torch.from_numpy(file["image"])
    return fields


def _restore_surfaces(described: dict[str, Any], file: Any) -> SurfaceMap:
    return SurfaceMap(
        shape=tuple(described["shape"]),
        objects=tuple(described["objects"]),
        parameters=tuple(map(tuple, described["parameters"])),
        **{field: file[f"surfaces/{field}"] for field in _SURFACE_FIELDS},
        texels={
            name: TexelMap(**{field: file[f"texels/{index}/{field}"] for field in _MAP_FIELDS})
            for index, name in enumerate(described["texels"])
        },
    )
