"""What doctor says on the wire, and in what order."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from backend import doctor, machine
from backend.doctor import Check
from backend.errors import ErrorCode
from backend.machine import SeenDevice
from backend.wire import protocol
from backend.wire.client import ROOT, WireProcess, backend_command
from backend.wire.protocol import Checked, Failed, Finished, Hello, Message, decode


def conversation(*python: str) -> tuple[int, list[Message]]:
    command = [*python, "-m", "backend", "doctor", "--wire"]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        assert process.stdout is not None
        heard = [decode(line) for line in process.stdout]
    return process.returncode, heard


def checks(*faulty: str) -> list[Check]:
    names = ["Python", *doctor.DEPENDENCIES.values(), "compiled code", "cuda", "mps", "cpu"]
    return [Check(name=name, fine=name not in faulty, found="?") for name in names]


@pytest.mark.slow
def test_a_ready_python_says_each_check_and_finishes() -> None:
    code, heard = conversation(sys.executable)
    assert code == 0
    assert isinstance(heard[0], Hello)
    assert heard[-1] == Finished(output="", files=())
    found = [message for message in heard if isinstance(message, Checked)]
    expected = ["Python", *doctor.DEPENDENCIES.values()]
    assert [check.name for check in found][: len(expected)] == expected
    assert found[-1].name == "cpu"
    assert all(check.fine for check in found)


def test_a_bare_python_names_all_that_is_missing() -> None:
    code, heard = conversation(sys.executable, "-S")
    assert code == 2
    last = heard[-1]
    assert isinstance(last, Failed)
    assert last.code == "missing_dependency"
    assert "numpy" in last.text
    assert "torch" in last.text
    assert "-m pip install numpy pillow" in last.remedy
    assert [message.fine for message in heard if isinstance(message, Checked)] == [True] + [False] * 17


def test_checks_come_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    monkeypatch.setattr(doctor, "_check_package", lambda _, name: made.append(name) or checks()[0])
    coming = doctor.examine()
    next(coming)
    assert made == []
    next(coming)
    assert made == ["numpy"]


def test_devices_are_left_out_where_a_package_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_check_package", lambda _, name: Check(name=name, fine=False, found=""))
    assert len(list(doctor.examine())) == 1 + len(doctor.DEPENDENCIES)


@pytest.mark.parametrize(
    ("faulty", "code", "words"),
    [
        (("torch", "rich"), ErrorCode.MISSING_DEPENDENCY, "torch (?); also rich"),
        (("Python",), ErrorCode.MISSING_DEPENDENCY, "Python (?)"),
        (("cuda", "cpu"), ErrorCode.DEVICE_UNAVAILABLE, "cannot reconstruct: cpu (?)."),
    ],
)
def test_faults_are_named_by_kind(faulty: tuple[str, ...], code: ErrorCode, words: str) -> None:
    error = doctor.not_ready(checks(*faulty))
    assert error.code is code
    assert words in error.text
    assert ("pip install" in error.remedy) == ("torch" in faulty)


@pytest.mark.parametrize(
    ("faulty", "words"),
    [
        (("Python", "torch"), "take Python 3.11 or a later one"),
        (("torch", "compiled code"), f"`{sys.executable} -m pip install --constraint constraints.txt .`"),
        (("compiled code",), "report it"),
        (("cuda", "cpu"), "report it"),
        (("cuda",), "ready, but not on cuda: compute with `--device cpu`"),
        (("cuda", "mps"), "ready, but not on cuda and mps: compute"),
    ],
)
def test_the_remedy_in_a_shell_is_that_of_the_first_fault(faulty: tuple[str, ...], words: str) -> None:
    assert words in doctor.as_text(checks(*faulty)).splitlines()[-1]


@pytest.mark.parametrize("part", ["Python", "torch", "compiled code", "cpu"])
def test_all_but_a_gpu_is_needed(part: str) -> None:
    assert doctor.is_ready(checks("cuda", "mps"))
    assert not doctor.is_ready(checks(part))


def test_a_gpu_that_fails_is_told_and_the_cpu_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether that is known before, as of one that torch has no code for, or found out by a computation."""
    old = SeenDevice(kind="cuda", name="GTX 1080", fault="no code for it")
    full = SeenDevice(kind="cuda", name="RTX 5090")
    cpu = SeenDevice(kind="cpu", name="2 cores")

    def solve(kind: str) -> float:
        if kind == "cuda":
            raise RuntimeError("CUDA error: out of memory\nCompile with TORCH_USE_CUDA_DSA")
        return 0.0

    monkeypatch.setattr(doctor, "_gradient_error", solve)
    for gpu, found in ((old, "GTX 1080: no code for it"), (full, "RTX 5090: CUDA error: out of memory")):
        monkeypatch.setattr(machine, "seen_devices", lambda gpu=gpu: (gpu, cpu))
        assert list(doctor._check_devices()) == [
            Check(name="cuda", fine=False, found=found),
            Check(name="cpu", fine=True, found="2 cores"),
        ]


def test_it_can_be_cancelled(tmp_path: Path) -> None:
    """Between two checks; a slow import is waited for."""
    process = WireProcess(backend_command(sys.executable, "doctor", "--wire"), log_path=tmp_path / "log")
    process.cancel()
    heard: list[Message] = []
    deadline = time.monotonic() + 30
    while process.is_running:
        assert time.monotonic() < deadline
        heard += process.poll()
        time.sleep(0.01)
    last = heard[-1]
    process.close()
    assert isinstance(last, Failed)
    assert last.code == protocol.CANCELLED
    assert "cpu" not in {message.name for message in heard if isinstance(message, Checked)}
