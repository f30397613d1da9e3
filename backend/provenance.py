"""What results depend on besides their inputs: the code that computes them, and versions of packages."""

import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path

from .version import VERSION
from .workspace import fingerprint

_COMPUTING_FOLDERS = ("kernels", "maths", "stages")
_COMPUTING_MODULES = (
    "errors.py",
    "images.py",
    "machine.py",
    "mesh_files.py",
    "pipeline.py",
    "point_methods.py",
    "scene.py",
    "wire/environment.py",
    "wire/photographs.py",
)
_PACKAGES = (
    "torch",
    "numba",
    "pycolmap",
    "numpy",
    "scipy",
    "scikit-image",
    "trimesh",
    "embreex",
    "fast-simplification",
    "pillow",
    "pillow-heif",
    "onnxruntime",
)
"""All that compute, or read photographs."""


@cache
def code_fingerprint() -> str:
    """Changes with the code that computes results, so that no result of older code is taken for new.

    Packages belong to it: another version of one may round otherwise, or decide otherwise.
    """
    return fingerprint(sorted(versions().items()), *computing_sources())


def computing_sources() -> tuple[Path, ...]:
    """The files whose code decides what a kept stage gives."""
    here = Path(__file__).parent
    folders = (path for name in _COMPUTING_FOLDERS for path in (here / name).rglob("*.py"))
    return tuple(sorted([*(here / name for name in _COMPUTING_MODULES), *folders]))


def versions() -> dict[str, str]:
    """What the result depends on, with versions."""
    return {"FewView": VERSION, "Python": platform.python_version(), **{n: version(n) for n in _PACKAGES}}
