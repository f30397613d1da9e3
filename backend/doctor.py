"""Whether this Python can reconstruct: the only proof of "ready"."""

import importlib
import json
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version

from .errors import ErrorCode, ReconstructionError
from .failures import first_line

MIN_PYTHON = (3, 11)
_PYTHON = "Python"
_SPARE = ("cuda", "mps")
"""Devices that a reconstruction can do without."""
DEPENDENCIES = {
    # pillow stands before pycolmap: imported the other way round, the two corrupt memory.
    "numpy": "numpy",
    "PIL": "pillow",
    "pillow_heif": "pillow-heif",
    "tifffile": "tifffile",
    "scipy": "scipy",
    "skimage": "scikit-image",
    "torch": "torch",
    "numba": "numba",
    "pycolmap": "pycolmap",
    "trimesh": "trimesh",
    "embreex": "embreex",
    "fast_simplification": "fast-simplification",
    "rich": "rich",
    "jinja2": "jinja2",
    "jaxtyping": "jaxtyping",
    "onnxruntime": "onnxruntime",
    "pooch": "pooch",
}
"""Import name of each needed package, with its name for pip."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing that was looked at."""

    name: str
    fine: bool
    found: str
    """A version, a device or what is wrong."""


def examine() -> Iterator[Check]:
    """Each check as it is made: Python, the packages, and, where all load, each device by a computation."""
    checks = [_check_python()]
    yield checks[0]
    for module, distribution in DEPENDENCIES.items():
        checks.append(_check_package(module, distribution))
        yield checks[-1]
    if is_ready(checks):
        yield _check_compiler()
        yield from _check_devices()


def is_ready(checks: Sequence[Check]) -> bool:
    """Whether a reconstruction can start here, on the CPU at least."""
    return not _faults(checks)


def not_ready(checks: Sequence[Check]) -> ReconstructionError:
    """What is wrong, where it is not ready: the first thing in full, the others by name."""
    first, *others = _faults(checks)
    packages = [check.name for check in (first, *others) if check.name in DEPENDENCIES.values()]
    more = f"; also {', '.join(check.name for check in others)}" if others else ""
    is_device = not packages and first.name != _PYTHON
    by_hand = f"; by hand: `{sys.executable} -m pip install {' '.join(packages)}`" if packages else ""
    return ReconstructionError(
        ErrorCode.DEVICE_UNAVAILABLE if is_device else ErrorCode.MISSING_DEPENDENCY,
        f"This Python cannot reconstruct: {first.name} ({first.found}){more}.",
        f"Choose another Python, or press Set Up FewView{by_hand}.",
    )


def as_text(checks: Sequence[Check]) -> str:
    """The checks for a person."""
    width = max(len(check.name) for check in checks)
    lines = [f"{'ok ' if check.fine else 'NOT'} {check.name:<{width}} {check.found}" for check in checks]
    if faults := _faults(checks):
        return "\n".join([*lines, f"not ready: {_by_hand(faults[0])}"])
    spare = [check.name for check in checks if not check.fine]
    but = f", but not on {' and '.join(spare)}: compute with `--device cpu`"
    return "\n".join([*lines, "ready" + (but if spare else "")])


def _faults(checks: Sequence[Check]) -> list[Check]:
    """What keeps a reconstruction from starting: a GPU that fails does not."""
    return [check for check in checks if not check.fine and check.name not in _SPARE]


def _by_hand(first: Check) -> str:
    """What to do in a shell about the first thing that is wrong."""
    if first.name == _PYTHON:
        return f"take Python {'.'.join(map(str, MIN_PYTHON))} or a later one"
    if first.name in DEPENDENCIES.values():
        return f"in FewView's folder run `{sys.executable} -m pip install --constraint constraints.txt .`"
    return "install the packages again; if that does not help, report it with the lines above"


def as_json(checks: Sequence[Check]) -> str:
    """The checks for a program."""
    return json.dumps({"ready": is_ready(checks), "checks": [asdict(check) for check in checks]})


def _check_python() -> Check:
    fine = sys.version_info[:2] >= MIN_PYTHON
    needed = "" if fine else f", at least {'.'.join(map(str, MIN_PYTHON))} is needed"
    return Check(name=_PYTHON, fine=fine, found=platform.python_version() + needed)


def _check_package(module: str, distribution: str) -> Check:
    try:
        importlib.import_module(module)
    except (ImportError, OSError, AttributeError, ValueError, RuntimeError) as error:
        # Beside a missing package: a library of the system it needs, or packages that do not fit together.
        return Check(name=distribution, fine=False, found=f"{type(error).__name__}: {error}")
    try:
        return Check(name=distribution, fine=True, found=version(distribution))
    except PackageNotFoundError:
        return Check(name=distribution, fine=True, found="version unknown")


def _check_compiler() -> Check:
    """Fine if compiled code finds what is known; it is kept for later runs."""
    from .kernels.bending import error_of_a_constant
    from .kernels.bilinear_reading import error_of_a_slope
    from .kernels.cross_check import error_of_a_map_with_itself
    from .kernels.face_drawing import error_of_a_half
    from .kernels.patch_correlation import error_of_an_image_with_itself
    from .kernels.plane_fits import error_of_a_plane
    from .kernels.ray_crossing import error_of_a_plane_ahead

    known = (
        error_of_a_constant,
        error_of_an_image_with_itself,
        error_of_a_plane,
        error_of_a_map_with_itself,
        error_of_a_plane_ahead,
        error_of_a_half,
        error_of_a_slope,
    )
    started = time.perf_counter()
    error = max(error_of() for error_of in known)
    seconds = time.perf_counter() - started
    wrong = "" if error < 1e-5 else f", but computes wrongly (error {error:.2g})"
    return Check(name="compiled code", fine=not wrong, found=f"ready after {seconds:.1f} s{wrong}")


def _check_devices() -> Iterator[Check]:
    from .machine import seen_devices

    for device in seen_devices():
        if device.fault:
            yield Check(name=device.kind, fine=False, found=f"{device.name}: {device.fault}")
        else:
            yield _check_device(device.kind, device.name)


def _check_device(kind: str, name: str, solve: Callable[[str], float] | None = None) -> Check:
    """Fine if the device computes the gradient of a sum of squares, which is known."""
    try:
        error = (solve or _gradient_error)(kind)
    except RuntimeError as reason:
        return Check(name=kind, fine=False, found=f"{name}: {first_line(reason)}")
    wrong = "" if error < 1e-5 else f": computes wrongly (error {error:.2g})"
    return Check(name=kind, fine=not wrong, found=name + wrong)


def _gradient_error(kind: str) -> float:
    """Largest error of d/dx sum((x A)^2) = 2 x A A^T on the device."""
    import torch

    matrix = torch.tensor([[1.0, 2.0], [3.0, 4.0]], device=kind)
    x = torch.tensor([[0.5, -1.0]], device=kind, requires_grad=True)
    (gradient,) = torch.autograd.grad((x @ matrix).square().sum(), x)
    expected = 2 * x.detach() @ matrix @ matrix.T
    return float((gradient - expected).abs().max())
