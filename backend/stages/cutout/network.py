"""A network that was trained on photographs cut out by hand tells a photograph's subject.

IS-Net (Qin et al., "Highly Accurate Dichotomous Image Segmentation", ECCV 2022) with the weights for general
use that its authors trained, under the Apache License 2.0, as the project rembg holds them ready. They are no
part of FewView: they are fetched once, when a subject is first cut out, and kept.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32

from ...errors import ErrorCode, ReconstructionError
from ...images import resized
from ...scene import Progress
from ...wire.environment import OFFLINE

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

_ADDRESS = "https://github.com/danielgatis/rembg/releases/download/v0.0.0/isnet-general-use.onnx"
_FILE_NAME = _ADDRESS.rsplit("/", 1)[-1]
_MD5 = "fc16ebd8b0c10d971d3513d564d01e29"
_OTHER_FILE = "FEWVIEW_CUT_OUT_NETWORK"
"""Variable of the environment: a file with a network of the same inputs and outputs, to be used instead."""
_WITHOUT = "or give masks of your own, or do without cutting out."
_SIDE_PX = 1024
"""Of the square that the network sees."""
_MIDDLE_GREY = 0.5
"""Taken from the colours, as in its training."""


def load_network(progress: Progress) -> "InferenceSession":
    """The network, fetched where it is not on this computer yet.

    Raises ReconstructionError(NETWORK_UNAVAILABLE) where it cannot be, or cannot be used.
    """
    import onnxruntime  # a run that cuts out nothing need not wait for it

    path = Path(os.environ[_OTHER_FILE]) if os.environ.get(_OTHER_FILE) else _fetched(progress)
    options = onnxruntime.SessionOptions()
    options.enable_cpu_mem_arena = False  # a tenth slower, and 1.4 GB instead of 2.2
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no other class in common
        text = f"The file {path} with the network that cuts out subjects cannot be used ({error})."
        remedy = f"Delete it, so that it is fetched again; {_WITHOUT}"
        raise ReconstructionError(ErrorCode.NETWORK_UNAVAILABLE, text, remedy) from error


def shown_subject(
    network: "InferenceSession", image_srgb: Float32[np.ndarray, "height width 3"]
) -> Float32[np.ndarray, "height width"]:
    """How much of each pixel shows the subject, 0 to 1."""
    height, width = image_srgb.shape[:2]
    square = resized(image_srgb, _SIDE_PX, _SIDE_PX) - np.float32(_MIDDLE_GREY)
    batch = np.ascontiguousarray(np.moveaxis(square, -1, 0)[None])
    finest = network.get_outputs()[0].name  # the others are what its training looked at
    (shares,) = network.run([finest], {network.get_inputs()[0].name: batch})
    share: Float32[np.ndarray, "height width"] = np.clip(resized(shares[0, 0], width, height), 0, 1)
    return share


def _fetched(progress: Progress) -> Path:
    import pooch
    import requests

    folder = Path(pooch.os_cache("fewview"))  # where programs keep what they fetch
    pooch.get_logger().setLevel("WARNING")
    fetch = _refused if os.environ.get(OFFLINE) else pooch.HTTPDownloader(progressbar=_Told(progress))
    try:
        found = pooch.retrieve(_ADDRESS, f"md5:{_MD5}", _FILE_NAME, folder, downloader=fetch)
    except (OSError, ValueError) as error:  # no connection, no room; what came is not the file
        offline = isinstance(error, requests.exceptions.ConnectionError | requests.exceptions.Timeout)
        why = "no connection" if offline else error
        text = f"The network that cuts out subjects could not be fetched ({why})."
        remedy = (
            "Connect to the internet this once (in Blender: Preferences > System > Allow Online Access), or "
            f"put {_ADDRESS} into the folder {folder}, {_WITHOUT}"
        )
        raise ReconstructionError(ErrorCode.NETWORK_UNAVAILABLE, text, remedy) from error
    return Path(found)


def _refused(*_: object) -> None:
    """In place of what fetches."""
    raise PermissionError("Blender is not allowed to go online")


class _Told:
    """What pooch asks of a progress bar."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self.total: int = 0
        self._done = 0

    def update(self, num_bytes: int) -> None:
        """So many bytes more have come."""
        self._done = min(self._done + num_bytes, self.total)
        megabytes = f"{self._done / 1e6:.0f} of {self.total / 1e6:.0f} MB"
        self._progress(self._done / max(self.total, 1), f"fetching the network, this once: {megabytes}")

    def reset(self) -> None:
        """From the beginning."""
        self._done = 0

    def close(self, *_: Any) -> None:
        """Nothing is open."""
