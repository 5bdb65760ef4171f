"""Results made by hand for the report, and the report in a browser window."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from seeds import shifted

from scenecaptum import SceneAttribution
from scenecaptum.projection import SurfaceMap

NASTY = '</script><img src=x onerror="window.hacked=1">&lt;\'`${1}'
OBJECTS = ("floor", "lamp", "chair", NASTY, "sky")  # no pixel shows the sky
VALUES = {
    "floor.reflectance.value": [-0.02, -0.3, -0.04],
    "lamp.radiance.value": [0.3, 0.4, 0.0],
    "chair.reflectance.data": [[[0.001, 0.02, 0.003]] * 4] * 4,
    "chair.alpha": -0.05,
    "sky.radiance.value": 0.2,
    NASTY: 1e-4,
}
PARAMETERS = (
    ("floor.reflectance.value",),
    ("lamp.radiance.value",),
    ("chair.reflectance.data", "chair.alpha"),
    (NASTY,),
    ("sky.radiance.value",),
)
HEIGHT, WIDTH = 9, 16
PHONE = {
    "viewport": {"width": 360, "height": 740},
    "has_touch": True,
    "is_mobile": True,
    "device_scale_factor": 2,
}


def make(metric: str = "Glare", factor: float = 1.0, **changes: Any) -> SceneAttribution:
    values = {name: factor * torch.tensor(value) for name, value in VALUES.items()}
    errors = {name: torch.full_like(value, 0.002) for name, value in values.items()}
    channels = {name: value.shape[-1] if value.ndim else 1 for name, value in values.items()}
    return dataclasses.replace(
        SceneAttribution(
            attributions=values,
            standard_error=errors,
            metric_value=2.336942,
            metric_standard_error=0.000533,
            covariance={name: 0.002**2 * torch.eye(count) for name, count in channels.items()},
            parameter_values={
                "floor.reflectance.value": torch.tensor([0.5, 0.25, 0.125]),
                "chair.reflectance.data": torch.tensor([0.2, 0.3, 0.4]),
                "chair.alpha": torch.tensor(0.15),
            },
            labels={"chair.alpha": "chair: alpha", "floor.reflectance.value": "floor: reflectance"},
            image=torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(shifted())),
            surfaces=quarters(HEIGHT, WIDTH),
            info={
                "metric": metric,
                "method": "VanillaSceneGradient",
                "scene": "rooms/office.xml",
                "seed": shifted(7),
                "spp": 64,
                "replicates": 8,
                "cautions": {"chair.alpha": "its size is off <b>"},
                "left_out": {"knob.eta": "it is -0.0485 <i>"},
                "versions": {"torch": "2.13"},
            },
        ),
        **changes,
    )


def quarters(height: int, width: int) -> SurfaceMap:
    """Floor below, lamp and chair above, a malicious name at the right; the lamp shares an edge."""
    index = np.zeros((height, width), np.int32)
    index[: height // 2, : width // 2] = 1
    index[: height // 2, width // 2 :] = 2
    index[:, -1] = 3
    pixel = np.arange(height * width, dtype=np.int32)
    shared = pixel[(index == 1).ravel() & (pixel % width == width // 2 - 1)]
    fraction = np.ones(height * width, np.float32)
    fraction[shared] = 0.75
    return SurfaceMap(
        shape=(height, width),
        pixel=np.concatenate([pixel, shared]).astype(np.int32),
        object_index=np.concatenate([index.ravel(), np.full(len(shared), 2)]).astype(np.int32),
        fraction=np.concatenate([fraction, np.full(len(shared), 0.25)]).astype(np.float32),
        objects=OBJECTS,
        parameters=PARAMETERS,
    )


def data_of(path: Path) -> dict[str, Any]:
    (text,) = re.findall(
        r'<script type="application/json" id="data">(.*?)</script>', path.read_text(), re.DOTALL
    )
    data: dict[str, Any] = json.loads(text)
    return data


class Page:
    """A report in a browser window that records every console message and request."""

    def __init__(self, browser: Any, path: Path, fragment: str = "", **options: Any) -> None:
        self.context = browser.new_context(**{"viewport": {"width": 1440, "height": 900}, **options})
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.context.set_default_timeout(8000)
        self.page = self.context.new_page()
        self.page.on("console", lambda message: self.complaints.append(message.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri() + fragment)
        self.page.wait_for_selector("html[data-ready]")

    def check(self, path: Path) -> None:
        assert self.complaints == []
        outside = [url.split("#")[0] for url in self.requests if not url.startswith(("data:", "blob:"))]
        assert outside == [path.as_uri()]

    def place(self, column: float, line: float) -> tuple[float, float]:
        self.page.locator("#picture").scroll_into_view_if_needed()
        box = self.page.locator("#picture").bounding_box()
        return box["x"] + box["width"] * column / WIDTH, box["y"] + box["height"] * line / HEIGHT

    def hover(self, column: float, line: float) -> str:
        self.page.mouse.move(*self.place(column, line))
        text: str = self.page.locator("#tip").inner_text()
        return text

    def click(self, column: float, line: float) -> None:
        self.page.mouse.click(*self.place(column, line))

    def selected(self) -> list[str]:
        names = self.page.locator('#rows [aria-selected="true"] .label').all()
        return [one.get_attribute("title") for one in names]

    def names(self) -> list[str]:
        return [one.get_attribute("title") for one in self.page.locator("#rows .label").all()]

    def colour(self, canvas: str, column: int, line: int) -> list[int]:
        # From a copy, because Chromium warns of pages that read their own canvases often.
        read = """(canvas, [x, y]) => {
            const context = new OffscreenCanvas(1, 1).getContext("2d");
            context.drawImage(canvas, x, y, 1, 1, 0, 0, 1, 1);
            return [...context.getImageData(0, 0, 1, 1).data];
        }"""
        pixel: list[int] = self.page.locator(f"#{canvas}").evaluate(read, [column, line])
        return pixel

    def lit(self) -> list[str]:
        """The objects that are not dimmed, sampled in the middle of each region."""
        places = {"lamp": (2, 1), "chair": (11, 1), "floor": (4, 7), "nasty": (15, 5)}
        return [name for name, (x, y) in places.items() if self.colour("shade", x, y)[3] < 10]
