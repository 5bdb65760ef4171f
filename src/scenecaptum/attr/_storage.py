"""Saving and loading attributions: numpy's ``.npz`` with a JSON header and a checksum, never pickle."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from .._writing import whole_file
from ..errors import SceneCaptumError
from ..scene import SurfaceMap, TexelMap
from ._attribution import SceneAttribution

FORMAT = "scenecaptum attribution 2"
WITHOUT_CHECKSUM = "scenecaptum attribution 1"  # what earlier versions wrote; zip's own checks are all it has

_TENSOR_FIELDS = ("attributions", "standard_error", "bias", "quadrature_error", "replicates", "covariance")
_SCALAR_FIELDS = ("metric_value", "metric_standard_error", "convergence_delta", "convergence_delta_error")
_SURFACE_FIELDS = ("pixel", "object_index", "fraction")
_TEXEL_FIELDS = ("entry", "texel", "weight")


def save(attribution: SceneAttribution, path: str | os.PathLike[str]) -> None:
    """Write an attribution to a file, which appears whole or not at all."""
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
    with whole_file(path) as partial, partial.open("wb") as file:
        members = {"header": json.dumps(header), **arrays}
        np.savez_compressed(file, checksum=_checksum(members), **members)


def load(path: str | os.PathLike[str]) -> SceneAttribution:
    """Read an attribution that ``save`` wrote."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        header = json.loads(str(arrays["header"]))
        if header["format"] not in (FORMAT, WITHOUT_CHECKSUM):
            raise SceneCaptumError(f"{path} is a {header['format']!r}, not a {FORMAT!r}.")
        if header["format"] == FORMAT and str(arrays.pop("checksum")) != _checksum(arrays):
            raise SceneCaptumError(
                f"{path} is damaged, or was changed after it was saved: its contents do not match their checksum. "
                "Take a copy that is whole, or attribute again."
            )
        return _restore(header, arrays)
    except FileNotFoundError:
        raise SceneCaptumError(f"There is no saved attribution at {path}.") from None
    except SceneCaptumError:
        raise
    except Exception as error:  # whatever zip, numpy or JSON make of it, it is the file that is wrong
        raise SceneCaptumError(
            f"{path} is not a saved attribution, or it is damaged ({type(error).__name__}: {_brief(error)}). "
            "Save it again with SceneAttribution.save."
        ) from error


def _checksum(arrays: Mapping[str, Any]) -> str:
    """Return SHA-256 over all members: it tells damage and careless edits, not a forger, who can make it anew."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.asarray(arrays[name])
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode() + array.tobytes())
    return digest.hexdigest()


def _brief(error: Exception) -> str:
    """Return the message of an error on one line of reasonable length."""
    text = " ".join(str(error).split())
    return text if len(text) <= 200 else f"{text[:200]} …"


def _restore(header: dict[str, Any], file: Any) -> SceneAttribution:
    def tensors(field: str, names: list[str]) -> dict[str, torch.Tensor]:
        return {name: torch.from_numpy(file[f"{field}/{i}"]) for i, name in enumerate(names)}

    names = header["names"]
    fields: dict[str, Any] = {"standard_error": None, **{f: tensors(f, names) for f in header["fields"]}}
    fields["parameter_values"] = tensors("parameter_values", header.get("parameter_values", []))
    if "image" in file:
        fields["image"] = torch.from_numpy(file["image"])
    if described := header.get("surfaces"):
        fields["surfaces"] = SurfaceMap(
            shape=tuple(described["shape"]),
            objects=tuple(described["objects"]),
            parameters=tuple(map(tuple, described["parameters"])),
            **{field: file[f"surfaces/{field}"] for field in _SURFACE_FIELDS},
            # Files of earlier versions have none.
            texels={
                name: TexelMap(**{field: file[f"texels/{index}/{field}"] for field in _TEXEL_FIELDS})
                for index, name in enumerate(described.get("texels", ()))
            },
        )
    scalars = {field: header[field] for field in _SCALAR_FIELDS}
    return SceneAttribution(**fields, **scalars, labels=header["labels"], info=header["info"])
