"""Pictures that a page holds itself, so that it makes no request."""

from __future__ import annotations

import base64
from typing import Any

from calib.report.figures.export import png_size
from calib.report.figures.plate import Plate


def data_uri(image: bytes) -> str:
    """Return a PNG file as an address that holds it; nothing for none."""
    return f"data:image/png;base64,{base64.b64encode(image).decode()}" if image else ""


def picture(plate: Plate, image: bytes, caption: str) -> dict[str, Any]:
    """Return what a template shows of a plate, `image` being its file, empty where there is none.

    The caption is that of the plate as the page writes it.
    """
    return {
        "heading": plate.heading or plate.name.replace("_", " ").capitalize(),
        "caption": caption,
        "uri": data_uri(image),
        "size": png_size(image) if image else (0, 0),
    }
