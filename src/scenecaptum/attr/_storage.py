"""Saving and loading attributions as NumPy ``.npz`` with a JSON header and a checksum, without pickle."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from ..errors import SceneCaptumError
from ..files import atomic_write
from ..projection import SurfaceMap, TexelMap
from ._data import AttributionData

FORMAT = "scenecaptum attribution 3"

_TENSOR_FIELDS = ("attributions", "standard_error", "bias", "quadrature_error", "replicates", "covariance")
_SCALAR_FIELDS = ("metric_value", "metric_standard_error", "convergence_delta", "convergence_delta_error")
_SURFACE_FIELDS = ("pixel", "object_index", "fraction")
_TEXEL_FIELDS = ("entry", "texel", "weight")


def write_file(attribution: AttributionData, path: str | os.PathLike[str]) -> None:
    """Write an attribution to a file atomically."""
    names = list(attribution)
    header: dict[str, Any] = {
        "format": FORMAT,
        "names": names,
        "fields": [field for field in _TENSOR_FIELDS if getattr(attribution, field)],
        "labels": dict(attribution.labels),
        "info": dict(attribution.info),
        "parameter_values": list(attribution.parameter_values),
        **{field: getattr(attribution, field) for field in _SCALAR_FIELDS},
    }
    arrays = {
        f"{field}/{index}": getattr(attribution, field)[name].numpy(force=True)
        for field in header["fields"]
        for index, name in enumerate(names)
    }
    for index, value in enumerate(attribution.parameter_values.values()):
        arrays[f"parameter_values/{index}"] = value.numpy(force=True)
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
            for field in _TEXEL_FIELDS:
                arrays[f"texels/{index}/{field}"] = getattr(shown, field)
    with atomic_write(path) as partial, partial.open("wb") as file:
        members = {"header": json.dumps(header), **arrays}
        np.savez_compressed(file, checksum=_checksum(members), **members)


def read_file(path: str | os.PathLike[str]) -> dict[str, Any]:
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
        raise SceneCaptumError(
            f"{path} is not a saved attribution, or it is damaged ({type(error).__name__}: {_brief(error)}). "
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
    def tensors(field: str, names: list[str]) -> dict[str, torch.Tensor]:
        return {name: torch.from_numpy(file[f"{field}/{i}"]) for i, name in enumerate(names)}

    names = header["names"]
    fields: dict[str, Any] = {"standard_error": None, **{f: tensors(f, names) for f in header["fields"]}}
    fields["parameter_values"] = tensors("parameter_values", header["parameter_values"])
    if "image" in file:
        fields["image"] = torch.from_numpy(file["image"])
    if described := header.get("surfaces"):
        fields["surfaces"] = SurfaceMap(
            shape=tuple(described["shape"]),
            objects=tuple(described["objects"]),
            parameters=tuple(map(tuple, described["parameters"])),
            **{field: file[f"surfaces/{field}"] for field in _SURFACE_FIELDS},
            texels={
                name: TexelMap(**{field: file[f"texels/{index}/{field}"] for field in _TEXEL_FIELDS})
                for index, name in enumerate(described["texels"])
            },
        )
    scalars = {field: header[field] for field in _SCALAR_FIELDS}
    return {**fields, **scalars, "labels": header["labels"], "info": header["info"]}
