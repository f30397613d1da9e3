"""Small wheels that doctor takes for the packages that the backend needs; standard library only."""

import zipfile
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FAKE_TORCH = """
class cuda:
    is_available = staticmethod(lambda: False)
class backends:
    class mps:
        is_available = staticmethod(lambda: False)
class autograd:
    grad = staticmethod(lambda *_: (Number(),))
device = Generator = Tensor = type("Stand-in", (), {})
class Number:
    def __getattr__(self, _): return self
    def __call__(self, *_): return self
    def __matmul__(self, _): return self
    def __rmul__(self, _): return self
    def __sub__(self, _): return self
    def __float__(self): return 0.0
tensor = lambda *_, **__: Number()
"""
FAKE_NUMBA = """
import sys, types
checks = {
    "bending": "error_of_a_constant",
    "cross_check": "error_of_a_map_with_itself",
    "patch_correlation": "error_of_an_image_with_itself",
    "plane_fits": "error_of_a_plane",
    "ray_crossing": "error_of_a_plane_ahead",
    "face_drawing": "error_of_a_half",
    "bilinear_reading": "error_of_a_slope",
}
for module, check in checks.items():
    compiled = sys.modules[f"backend.kernels.{module}"] = types.ModuleType(module)
    setattr(compiled, check, lambda: 0.0)
"""
"""Stands in for what it would compile too, which needs a real numpy."""
FAKE_UV = """
import os, subprocess, sys
words = sys.argv[1:]
assert words[:2] == ["pip", "install"], words
assert os.environ["UV_FIND_LINKS"] == ",".join(os.environ["PIP_FIND_LINKS"].split())
assert words[words.index("--torch-backend") + 1] == "cpu"
assert words[words.index("--python") + 1] == sys.executable
del words[words.index("--torch-backend"):][:2]
rest = words[words.index("--constraint"):]
sys.exit(subprocess.run([sys.executable, "-m", "pip", "install", *rest]).returncode)
"""
"""Installs what it is asked for with pip, after a look at how it is asked."""
CODE = {"torch": FAKE_TORCH, "numba": FAKE_NUMBA}


def write_wheel(folder: Path, distribution: str, version: str, *, module: str, code: str = "") -> None:
    """The smallest wheel that pip installs."""
    name = distribution.replace("-", "_")
    info = f"{name}-{version}.dist-info"
    content = {
        f"{module}.py": code,
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    content[f"{info}/RECORD"] = "".join(f"{path},,\n" for path in (*content, f"{info}/RECORD"))
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as wheel:
        for path, text in content.items():
            wheel.writestr(path, text)


def write_uv(folder: Path) -> None:
    """A uv that takes the CPU's build of torch from where pip has it."""
    write_wheel(folder, "uv", "1.0", module="uv", code=FAKE_UV)


def constrained_version(distribution: str) -> str:
    """What constraints.txt says."""
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        name, _, version = line.partition("==")
        if name.lower().replace("_", "-") == distribution:
            return version
    raise AssertionError(f"constraints.txt says nothing of {distribution}")


def write_wheels(folder: Path, modules: Mapping[str, str]) -> None:
    """A wheel for each module, named like its package and of the version of constraints.txt.

    Of rich there is a later one as well, which does not work: constraints keep it away.
    """
    folder.mkdir()
    for module, distribution in modules.items():
        version, code = constrained_version(distribution), CODE.get(module, "")
        write_wheel(folder, distribution, version, module=module, code=code)
    write_wheel(folder, "rich", "99.0", module="rich", code="raise ImportError('not tested yet')")
