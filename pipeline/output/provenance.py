"""How a result was made, in words that a file can carry."""

import json
from typing import Any


def provenance_of(attributes: dict[str, Any], number: int | None = None, time_s: float | None = None) -> dict[str, str]:
    """Return how a frame was decoded, as names and lines of text.

    Parameters
    ----------
    attributes : dict
        What its store or report says of it.
    number : int, optional
        The frame, of footage.
    time_s : float, optional
        When it was taken, s.
    """
    said = {"software": f"colorphase {attributes['colorphase_version']}"}
    source = attributes.get("source", attributes.get("footage", {}).get("name"))
    if source is not None:
        said["source"] = str(source).replace("\n", " ")
    if number is not None:
        said["frame"] = str(number)
    if time_s is not None:
        said["time_s"] = f"{time_s:.6f}"
    if attributes.get("calibration_sha256") is not None:
        said["calibration_sha256"] = attributes["calibration_sha256"]
    # Of the settings what differs from nothing; the whole is in the store.
    said["settings"] = json.dumps({name: value for name, value in attributes["settings"].items() if value is not None})
    return said
