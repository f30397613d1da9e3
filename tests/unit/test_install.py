"""The installer as a program, with small wheels in place of the real packages and no network.

The wheels hold stand-ins that the real doctor takes for the packages. One environment is made; most tests
begin from a copy of it, as if an installation had been stopped after its first step.
"""

import http.server
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.metadata import distribution
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from backend.commands import environment_folder as folders
from backend.commands import install
from backend.commands.cancelling import CancelRequest
from backend.commands.computers import reason_against
from backend.commands.install import Plan, begun_for
from backend.commands.install_progress import TEXT_LENGTH, InstallProgress, shortened
from backend.commands.packages import (
    _settings_for_uv,
    explain,
    install_packages,
    pip_environment,
    pip_settings,
)
from backend.doctor import DEPENDENCIES
from backend.errors import ErrorCode, ReconstructionError
from backend.wire import protocol
from backend.wire.client import ROOT, WireProcess, backend_command, clean_environment
from backend.wire.environment import (
    MARKER,
    RECORD,
    beside,
    is_ours,
    needed_bytes,
    python_in,
    requirements,
    sizes_gb,
)
from backend.wire.protocol import Checked, Failed, Finished, Message, Progress, Stage, Warned
from tests.stand_in_packages import constrained_version, write_uv, write_wheels

posix_only = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")


@dataclass(frozen=True, kw_only=True)
class Shop:
    """Packages and the first step of an installation, made once."""

    wheels: Path
    all_names: Path
    """Requirements file with everything that doctor asks for."""
    part: Path
    """A folder as the first step leaves it, and a note of what it was begun for."""


@pytest.fixture(scope="module")
def shop(tmp_path_factory: pytest.TempPathFactory) -> Shop:
    folder = tmp_path_factory.mktemp("shop")
    write_wheels(folder / "wheels", DEPENDENCIES)
    names = folder / "all.txt"
    names.write_text("\n".join(DEPENDENCIES.values()) + "\n")
    part = folder / "part"
    subprocess.run([sys.executable, "-m", "venv", str(part)], check=True, timeout=120)
    return Shop(wheels=folder / "wheels", all_names=names, part=part)


class Case:
    """A place for an environment, and installations into it."""

    def __init__(self, shop: Shop, place: Path) -> None:
        self.shop = shop
        self.place = place
        self.folder = place / "environment"
        self.names = shop.all_names
        self.index: dict[str, str] = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(shop.wheels)}

    @property
    def part(self) -> Path:
        return beside(self.folder, ".part")

    @property
    def environment(self) -> dict[str, str]:
        clean = {k: v for k, v in clean_environment(os.environ).items() if not k.startswith(("PIP_", "UV_"))}
        return {**clean, "PIP_CONFIG_FILE": os.devnull, "PIP_NO_CACHE_DIR": "1", **self.index}

    def command(self, *more: str) -> list[str]:
        options = ("--folder", str(self.folder), "--requirements", str(self.names), *more)
        return list(backend_command(sys.executable, "install", *options))

    def start(self, *more: str) -> WireProcess:
        return WireProcess(
            self.command(*more), log_path=self.place / "install.log", environment=self.environment
        )

    def run(self, *more: str) -> list[Message]:
        return wait_for(self.start(*more))

    def begin(self) -> None:
        """As if the first step were done: let the installer note what for, then put its result there."""
        shutil.copytree(self.shop.part, self.part, symlinks=True)
        (self.part / MARKER).write_text(json.dumps(self.note()))

    def note(self) -> dict[str, object]:
        return begun_for(Plan(folder=self.folder, requirements_file=self.names))

    def make_ready(self) -> None:
        """An environment that is finished."""
        self.begin()
        heard = self.run()
        assert isinstance(heard[-1], Finished), heard[-1]


@pytest.fixture
def case(shop: Shop, tmp_path: Path) -> Case:
    return Case(shop, tmp_path)


def wait_for(
    process: WireProcess, until: type[Message] | None = None, timeout_s: float = 60
) -> list[Message]:
    """What is said until a kind of message, or the end."""
    heard: list[Message] = []
    deadline = time.monotonic() + timeout_s
    while process.is_running and not (until and any(isinstance(message, until) for message in heard)):
        assert time.monotonic() < deadline, heard
        heard += process.poll()
        time.sleep(0.01)
    if not process.is_running:
        process.close()
    return heard


class SilentIndex:
    """A package index that takes a question and never answers: a download that is under way."""

    def __init__(self) -> None:
        asked, self.left = threading.Event(), threading.Event()
        self.asked, left = asked, self.left

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                asked.set()
                while self.connection.recv(1024):
                    pass
                left.set()

            def handle(self) -> None:
                try:
                    super().handle()
                except OSError:  # it was killed
                    left.set()

        self._server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    @property
    def settings(self) -> dict[str, str]:
        return {
            "PIP_INDEX_URL": f"http://127.0.0.1:{self._server.server_port}/simple",
            "PIP_TIMEOUT": "60",
            "NO_PROXY": "*",
        }

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def silent_index() -> Iterator[SilentIndex]:
    index = SilentIndex()
    yield index
    index.close()


# The whole.


@pytest.mark.slow
def test_an_environment_is_made_checked_and_recorded(case: Case) -> None:
    """From nothing, with the Python that runs; then it is left alone."""
    heard = case.run()
    assert isinstance(heard[-1], Finished), heard[-1]
    assert heard[-1].output == str(case.folder)
    assert [message.name for message in heard if isinstance(message, Stage)] == [
        "python",
        "packages",
        "check",
    ]
    checked = {message.name: message.found for message in heard if isinstance(message, Checked)}
    assert {"Python", "torch", "cpu"} <= set(checked)
    record = json.loads((case.folder / RECORD).read_text())
    assert record["found"] == checked
    assert record["torch_build"] == "default"
    assert checked["rich"] == constrained_version("rich")
    assert is_ours(case.folder)
    assert not case.part.exists()
    # It works where it is now, though it was made under another name.
    result = subprocess.run(
        [python_in(case.folder), "-m", "pip", "--version"], capture_output=True, text=True, check=True
    )
    assert str(case.folder) + os.sep in result.stdout

    before = (case.folder / RECORD).stat().st_mtime_ns
    heard = case.run("--torch", "cpu")
    assert isinstance(heard[-1], Finished)
    (warned,) = [message for message in heard if isinstance(message, Warned)]
    assert "with the build default" in warned.text
    assert (case.folder / RECORD).stat().st_mtime_ns == before


@pytest.mark.slow
def test_progress_never_falls_and_ends_at_one(case: Case) -> None:
    case.begin()
    heard = case.run()
    fractions = [m.fraction for m in heard if isinstance(m, Progress) and m.stage == "packages"]
    # pip's version is asked for first, which is no progress.
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0


@pytest.mark.slow
def test_again_replaces_and_a_failure_leaves_the_old_one(case: Case, shop: Shop) -> None:
    case.make_ready()
    (case.folder / "sign").touch()
    case.index["PIP_FIND_LINKS"] = str(case.place)  # an empty shop
    case.begin()
    assert isinstance(case.run("--again")[-1], Failed)
    assert (case.folder / "sign").exists()
    case.index["PIP_FIND_LINKS"] = str(shop.wheels)
    assert isinstance(case.run("--again")[-1], Finished)
    assert not (case.folder / "sign").exists()
    assert {entry.name for entry in case.place.iterdir()} == {
        "environment",
        "environment.lock",
        "install.log",
    }


@pytest.mark.slow
def test_what_does_not_pass_the_check_never_gets_its_name(case: Case) -> None:
    """Not even where it is asked for to be so: doctor alone says ready."""
    case.names = case.place / "few.txt"
    case.names.write_text("numpy\nrich\n")
    heard = case.run()
    last = heard[-1]
    assert isinstance(last, Failed)
    assert last.code == ErrorCode.MISSING_DEPENDENCY
    assert "torch" in last.text
    assert not case.folder.exists()
    assert [m.name for m in heard if isinstance(m, Stage)].count("check") == 1, "made twice from nothing"


@pytest.mark.slow
def test_a_broken_beginning_is_made_anew(case: Case) -> None:
    case.begin()
    shutil.rmtree(case.part / "lib")
    (case.part / "trash").touch()
    assert isinstance(case.run()[-1], Finished)
    assert not (case.folder / "trash").exists()


@pytest.mark.slow
def test_a_package_that_was_half_installed_is_no_end(case: Case) -> None:
    """pip takes it for installed; doctor does not, and the beginning is thrown away."""
    case.begin()
    (packages,) = case.part.glob("lib/python*/site-packages")
    version = constrained_version("rich")
    (packages / f"rich-{version}.dist-info").mkdir()
    (packages / f"rich-{version}.dist-info" / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: rich\nVersion: {version}\n"
    )
    heard = case.run()
    assert isinstance(heard[-1], Finished), heard[-1]
    assert [message.name for message in heard if isinstance(message, Stage)].count("python") == 2


# Stopping and going on.


@pytest.mark.slow
def test_a_cancelled_one_stops_at_once_and_goes_on_later(case: Case, silent_index: SilentIndex) -> None:
    case.begin()
    (case.part / "sign").touch()
    usual, case.index = case.index, silent_index.settings
    process = case.start()
    assert silent_index.asked.wait(30)
    started = time.monotonic()
    process.cancel()
    last = wait_for(process)[-1]
    assert isinstance(last, Failed)
    assert last.code == protocol.CANCELLED
    assert silent_index.left.wait(5), "pip lives on"
    assert time.monotonic() - started < 5
    assert not case.folder.exists()
    case.index = usual
    heard = case.run()
    assert isinstance(heard[-1], Finished), heard[-1]
    assert (case.folder / "sign").exists(), "it began from nothing"


@posix_only
@pytest.mark.slow
def test_it_ends_with_its_caller_and_takes_pip_along(case: Case, silent_index: SilentIndex) -> None:
    case.begin()
    case.index = silent_index.settings
    code = f"""
        import time
        from pathlib import Path
        from backend.wire.client import WireProcess
        process = WireProcess(
            {case.command()!r}, log_path=Path({str(case.place / "log")!r}), environment={case.environment!r}
        )
        while True:
            for message in process.poll():
                if hasattr(message, "pid"):
                    print(message.pid, flush=True)
            time.sleep(0.01)
    """
    caller = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        env=case.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert caller.stdout is not None
    installer = int(caller.stdout.readline())
    assert silent_index.asked.wait(30)
    os.kill(caller.pid, signal.SIGKILL)
    caller.wait()
    caller.stdout.close()
    killed = time.monotonic()
    assert silent_index.left.wait(10)
    while is_alive(installer):
        time.sleep(0.02)
        assert time.monotonic() - killed < 10
    # The promise is 2 s; the machine of the tests may be busy.
    assert time.monotonic() - killed < 4


def is_alive(pid: int) -> bool:
    state = Path(f"/proc/{pid}/stat")
    if state.parent.parent.is_dir() and Path("/proc/self").exists():
        return state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_two_do_not_work_on_one_folder(case: Case, silent_index: SilentIndex) -> None:
    case.begin()
    usual, case.index = case.index, silent_index.settings
    first = case.start()
    assert silent_index.asked.wait(30)
    case.index = usual
    last = wait_for(WireProcess(case.command(), log_path=case.place / "2.log", environment=case.environment))[
        -1
    ]
    assert isinstance(last, Failed)
    assert "Another installation" in last.text
    first.close()


@pytest.mark.slow
def test_without_a_network_it_says_so(case: Case) -> None:
    case.begin()
    case.index = {"PIP_INDEX_URL": "http://127.0.0.1:9/simple", "PIP_RETRIES": "1", "NO_PROXY": "*"}
    last = case.run()[-1]
    assert isinstance(last, Failed)
    assert "out of reach" in last.text
    assert "Retrying" in last.text, "the end of what pip wrote is missing"
    assert "proxy" in last.remedy
    assert "Traceback" not in last.text


@pytest.mark.slow
def test_a_build_that_uv_can_not_fetch_is_the_usual_one(case: Case) -> None:
    """The shop has no uv."""
    case.begin()
    (case.part / MARKER).write_text(json.dumps({**case.note(), "torch_build": "cpu"}))
    heard = case.run("--torch", "cpu")
    assert isinstance(heard[-1], Finished), heard[-1]
    assert any("CPU build" in message.text for message in heard if isinstance(message, Warned))
    assert json.loads((case.folder / RECORD).read_text())["torch_build"] == "default"


@pytest.mark.slow
def test_a_build_is_chosen_by_uv_with_the_settings_of_pip(case: Case) -> None:
    """A stand-in for uv checks what it is asked for; pip's settings reach it, and no log shows them."""
    case.begin()
    (case.part / MARKER).write_text(json.dumps({**case.note(), "torch_build": "cpu"}))
    (case.place / "more").mkdir()
    write_uv(case.place / "more")
    case.index["PIP_FIND_LINKS"] += f" {case.place / 'more'}"
    case.index["PIP_INDEX_URL"] = "http://me:secret@127.0.0.1:9/simple"
    heard = case.run("--torch", "cpu")
    assert isinstance(heard[-1], Finished), heard[-1]
    assert not [message for message in heard if isinstance(message, Warned)]
    assert json.loads((case.folder / RECORD).read_text())["torch_build"] == "cpu"
    assert "secret" not in (case.place / "install.log").read_text()


class PlayedInstaller:
    """Programs that are not run: whether each ends well, and what it writes, by a word of its command."""

    def __init__(self, **said: tuple[bool, str]) -> None:
        self.said = said
        self.ran: list[str] = []
        self.warned: list[str] = []
        self.tail: list[str] = []
        self.environment: dict[str, str] = {}

    def run(self, command: list[str], **_: object) -> bool:
        program = "fetch_uv" if command[-1] == "uv" else command[2]
        self.ran.append(program)
        fine, text = self.said.get(program, (True, ""))
        self.tail = text.splitlines()
        return fine

    def ask(self, command: list[str]) -> bool:
        self.tail = self.said.get(command[3], (True, "pip 26.0 from here"))[1].splitlines()
        return True

    def begin(self, stage: str) -> None:
        pass

    def warn(self, text: str) -> None:
        self.warned.append(text)


def install_in(installer: PlayedInstaller, build: str) -> bool:
    given: Any = installer
    return install_packages(Path("py"), ["torch>=2.6"], constraints=None, build=build, installer=given)


UV_UNREACHABLE = """\
error: Request failed after 1 retry in 1.5s
  cause: Failed to fetch: https://download.pytorch.org/whl/cpu/torch/
  cause: error sending request for url (https://download.pytorch.org/whl/cpu/torch/)
  cause: client error (Connect)"""
UV_NO_SOLUTION = """\
error: No solution found when resolving dependencies
  cause: Because only networkx<=3.7 is available and you require networkx>=300, it can not be."""
UV_FULL = """\
error: Failed to extract archive: torch-2.13.0+cu130-cp312-cp312-manylinux_2_28_x86_64.whl
  cause: No space left on device (os error 28)"""


@pytest.mark.parametrize(
    ("build", "said", "ran", "reached"),
    [
        ("default", {}, ["pip"], True),
        ("cuda", {}, ["fetch_uv", "uv"], True),
        ("cuda", {"fetch_uv": (False, "")}, ["fetch_uv"], False),
        ("cuda", {"uv": (False, UV_UNREACHABLE)}, ["fetch_uv", "uv"], False),
    ],
)
def test_another_build_is_for_where_uv_is_out_of_reach(
    build: str, said: dict[str, tuple[bool, str]], ran: list[str], reached: bool
) -> None:
    installer = PlayedInstaller(**said)
    assert install_in(installer, build) == reached
    assert installer.ran == ran


@pytest.mark.parametrize(
    ("said", "code", "words"),
    [
        (UV_FULL, ErrorCode.DISK_FULL, "disk is full"),
        (UV_NO_SOLUTION, ErrorCode.MISSING_DEPENDENCY, "No solution"),
    ],
)
def test_any_other_failure_of_uv_is_one(said: str, code: ErrorCode, words: str) -> None:
    """Not a reason for gigabytes of another build."""
    installer = PlayedInstaller(uv=(False, said))
    with pytest.raises(ReconstructionError, match=words) as caught:
        install_in(installer, "cuda")
    assert caught.value.code is code
    assert installer.ran == ["fetch_uv", "uv"]


@pytest.fixture
def without_uv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Plan:
    """An installation of the CUDA build that gets the usual one, on a computer where no GPU is found."""
    monkeypatch.setattr(install, "install_packages", lambda *_, build, **__: build == "default")
    monkeypatch.setattr(install, "works", lambda *_: True)
    monkeypatch.setattr(install, "_check", lambda *_: [Checked(name="cpu", fine=True, found="2 cores")])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=100e9))
    return Plan(folder=tmp_path / "e", build="cuda")


def fill(plan: Plan) -> tuple[str, list[str]]:
    """The build that there is in the end, and the warnings."""
    installer: Any = PlayedInstaller()
    return install._fill(plan, (), installer)[0], installer.warned


def test_the_build_that_there_is_in_the_end_is_known(without_uv: Plan) -> None:
    """And no GPU is missed by one that does without."""
    build, (warned,) = fill(without_uv)
    assert build == "default"
    assert "CUDA build of torch could not be chosen" in warned


def test_for_another_build_the_disk_is_looked_at_again(
    without_uv: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With CUDA it is four times as large."""
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=needed_bytes("cpu")))
    with pytest.raises(ReconstructionError, match=r"needs about 11\.5 GB"):
        fill(replace(without_uv, build="cpu"))


@pytest.mark.parametrize(
    ("gpu", "words"),
    [
        ([], ["No GPU by NVIDIA was found: "]),
        ([Checked(name="cuda", fine=True, found="H200")], []),
        (
            [Checked(name="cuda", fine=False, found="GTX 1080: no code")],
            ["cannot be used (GTX 1080: no code): "],
        ),
    ],
)
def test_the_build_for_a_gpu_without_one_that_works_is_told(
    without_uv: Plan, monkeypatch: pytest.MonkeyPatch, gpu: list[Checked], words: list[str]
) -> None:
    monkeypatch.setattr(install, "install_packages", lambda *_, **__: True)
    monkeypatch.setattr(install, "_check", lambda *_: gpu)
    build, warned = fill(without_uv)
    assert build == "cuda"
    assert len(warned) == len(words)
    assert all(word in text for word, text in zip(words, warned, strict=True))


def test_uv_gets_the_settings_of_pip_that_it_knows() -> None:
    lines = """\
global.index-url='https://m/simple'
global.extra-index-url='https://a/simple\\nhttps://b/simple'
global.proxy='http://proxy.firm:3128'
install.trusted-host='pypi.org files.pythonhosted.org'
global.cert='/of mine/cert.pem'
global.timeout='60'"""
    installer: Any = PlayedInstaller(config=(True, lines))
    installer.environment["UV_DEFAULT_INDEX"] = "uv's own comes first"
    assert _settings_for_uv(Path("py"), installer) == {
        "UV_INDEX": "https://a/simple https://b/simple",
        "HTTPS_PROXY": "http://proxy.firm:3128",
        "UV_INSECURE_HOST": "pypi.org files.pythonhosted.org",
        "SSL_CERT_FILE": "/of mine/cert.pem",
    }


# Whose folders.


@pytest.mark.parametrize("ending", ["", ".part", ".old"])
def test_a_folder_of_somebody_else_is_left_alone(case: Case, ending: str) -> None:
    theirs = beside(case.folder, ending)
    theirs.mkdir()
    (theirs / "thesis.txt").write_text("years")
    for more in ((), ("--again",), ("--remove",)):
        last = case.run(*more)[-1]
        assert isinstance(last, Failed)
        assert last.code == ErrorCode.OUTPUT_UNUSABLE
        assert [entry.name for entry in theirs.iterdir()] == ["thesis.txt"]
        assert {entry.name for entry in case.place.iterdir()} == {theirs.name, "install.log"}


@posix_only
def test_a_link_to_an_environment_is_not_ours(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / MARKER).touch()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    with pytest.raises(ReconstructionError, match="not made by FewView"):
        folders.remove(tmp_path / "link")
    assert (tmp_path / "real" / MARKER).exists()


def ours(folder: Path, content: str) -> Path:
    folder.mkdir()
    (folder / MARKER).touch()
    (folder / "content").write_text(content)
    return folder


def test_the_new_one_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    part, folder = ours(tmp_path / "e.part", "new"), ours(tmp_path / "e", "old")
    assert folders.put_in_place(part, folder) == ""
    assert (folder / "content").read_text() == "new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["e"]


def test_where_the_new_one_can_not_come_the_old_one_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, folder = ours(tmp_path / "e.part", "new"), ours(tmp_path / "e", "old")
    rename = Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self == part:
            raise PermissionError(13, "in use")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", refuse)
    with pytest.raises(ReconstructionError, match="in use"):
        folders.put_in_place(part, folder)
    assert (folder / "content").read_text() == "old"
    assert (part / "content").read_text() == "new"


def test_an_exchange_that_was_cut_short_is_undone(tmp_path: Path) -> None:
    ours(tmp_path / "e.old", "old")
    with folders.held(tmp_path / "e"):
        assert (tmp_path / "e" / "content").read_text() == "old"


def test_a_removal_that_is_cut_short_can_be_taken_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sign that the folder is ours goes last."""
    folder = ours(tmp_path / "e", "old")
    (folder / "a").mkdir()
    monkeypatch.setattr(shutil, "rmtree", lambda _: (_ for _ in ()).throw(OSError("cut short")))
    with pytest.raises(OSError, match="cut short"):
        folders.remove(folder)
    assert is_ours(folder)
    monkeypatch.undo()
    folders.remove(folder)
    assert not folder.exists()


def test_remove_takes_the_environment_and_what_was_begun(case: Case) -> None:
    ours(case.folder, "ready")
    ours(case.part, "begun")
    (case.place / "photograph.jpg").touch()
    assert isinstance(case.run("--remove")[-1], Finished)
    assert {e.name for e in case.place.iterdir()} == {"photograph.jpg", "environment.lock", "install.log"}


def test_a_beginning_for_another_build_is_not_continued(tmp_path: Path) -> None:
    part = tmp_path / "e.part"
    assert not folders.begin_part(part, {"torch_build": "cpu"})
    (part / "half").touch()
    assert folders.begin_part(part, {"torch_build": "cpu"})
    assert (part / "half").exists()
    assert not folders.begin_part(part, {"torch_build": "cuda"})
    assert not (part / "half").exists()


def test_a_small_disk_is_told_before_anything_is_made(
    case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=needed_bytes("cpu") - 1))
    folder = tmp_path / "a" / "b"
    with pytest.raises(ReconstructionError, match=r"the environment needs about 2\.7 GB") as caught:
        folders.check_space(folder, "cpu")
    assert caught.value.code is ErrorCode.DISK_FULL
    # What was begun needs no room any more.
    (tmp_path / "a").mkdir()
    ours(tmp_path / "a" / "b.part", "1234")
    folders.check_space(folder, "cpu")


# Computers that there are no packages for.


@pytest.mark.parametrize(
    ("system", "machine", "macos", "words"),
    [
        ("win32", "win-amd64", "", ""),
        ("win32", "win-arm64", "", "not made for the processor win-arm64"),
        ("darwin", "arm64", "14.0", ""),
        ("darwin", "arm64", "26.1", ""),
        ("darwin", "arm64", "", ""),  # which is not known
        ("darwin", "arm64", "13.7.1", "not made for macOS 13.7.1"),
        ("darwin", "x86_64", "15.2", "not made for Blenders and Macs for Intel"),  # also on Apple silicon
        ("linux", "x86_64", "", ""),
        ("linux", "aarch64", "", "not made for the processor aarch64"),
        ("freebsd14", "amd64", "", ""),
    ],
)
def test_where_there_are_no_packages_is_known(system: str, machine: str, macos: str, words: str) -> None:
    reason = reason_against(system, machine, macos)
    assert words in reason
    assert bool(reason) == bool(words)


def test_where_there_are_none_nothing_is_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install, "_make", lambda *_: pytest.fail("it began"))
    monkeypatch.setattr("platform.machine", lambda: "ppc64")
    monkeypatch.setattr("sys.platform", "linux")
    plan = Plan(folder=tmp_path / "environment")
    with pytest.raises(ReconstructionError, match=r"cannot be set up here: .* ppc64") as caught:
        install._install(plan, CancelRequest(), SimpleNamespace(say=lambda _: None))  # type: ignore[arg-type]
    assert "Apple silicon" in caught.value.remedy


# Windows takes no long paths.

ROAMING = "C:/Users/max/AppData/Roaming/Blender Foundation/Blender/4.5/extensions/.user/user_default/fewview"
LOCAL = "C:/Users/nineteen characters/AppData/Local/fewview"


@pytest.mark.parametrize(("place", "fits"), [(ROAMING, False), (LOCAL, True), (LOCAL + "X", False)])
def test_a_folder_that_is_too_deep_for_windows_is_refused(
    place: str, fits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = Path(place) / "environment"
    folders.check_length(folder)  # where paths have no such limit
    monkeypatch.setattr(folders, "takes_long_paths", lambda: False)
    if fits:
        folders.check_length(folder)
        return
    with pytest.raises(ReconstructionError, match="characters too long") as caught:
        folders.check_length(folder)
    assert "shorter Environment Folder" in caught.value.remedy


def test_that_is_said_before_anything_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is anything fetched."""
    monkeypatch.setattr(folders, "takes_long_paths", lambda: False)
    monkeypatch.setattr("backend.commands.install._make", lambda *_: pytest.fail("it began"))
    plan = Plan(folder=tmp_path / ("deep" * 40) / "environment")
    with pytest.raises(ReconstructionError, match="characters too long"):
        install._install(plan, CancelRequest(), SimpleNamespace(say=lambda _: None))  # type: ignore[arg-type]


def test_no_package_has_longer_names_than_are_reckoned_with() -> None:
    """Of torch as it is here: other builds have another name, at most that with "+cu130"."""
    found = [distribution(name) for name in DEPENDENCIES.values()]
    torch = distribution("torch").version
    longest_build = f"torch-{torch.partition('+')[0]}+cu130."
    names = [str(path) for package in found for path in package.files or ()]
    assert max(len(name.replace(f"torch-{torch}.", longest_build)) for name in names) == folders._LONGEST_NAME


@pytest.mark.parametrize(
    ("path", "whole"),
    [
        (r"C:\a\..\b c", r"\\?\C:\b c"),
        (r"\\server\share\a", r"\\?\UNC\server\share\a"),
        (r"\\?\C:\a", r"\\?\C:\a"),
    ],
)
def test_long_paths_are_spelled_as_windows_takes_them(path: str, whole: str) -> None:
    assert folders.unlimited(path, windows=True) == whole
    assert folders.unlimited(path, windows=False) == path


def test_what_was_begun_is_measured_and_removed_however_deep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows, where files under the plain path cannot be reached: here they lie elsewhere."""
    plain = ours(tmp_path / "e.part", "")
    (plain / "content").unlink()
    deep = ours(tmp_path / "deep", "1234")
    (deep / "a").mkdir()
    monkeypatch.setattr(folders, "unlimited", lambda _: str(deep))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=needed_bytes("cpu") - 4))
    folders.check_space(tmp_path / "e", "cpu")
    folders.remove(plain)
    assert [entry.name for entry in deep.iterdir()] == [MARKER]
    assert not plain.exists()


def test_a_file_that_goes_away_while_it_is_measured_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = ours(tmp_path / "e.part", "1234")
    monkeypatch.setattr(os, "walk", lambda _: [(str(part), [], ["gone", "content"])])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=needed_bytes("cpu") - 4))
    folders.check_space(tmp_path / "e", "cpu")


def test_unknown_builds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown build 'rocm'"):
        Plan(folder=tmp_path, build="rocm")
    with pytest.raises(ValueError, match="unknown build 'rocm'"):
        sizes_gb("rocm")


# What pip and uv say.

PIP = """\
Looking in indexes: somewhere
Collecting torch>=2.6
  Downloading torch-2.13.0-cp311-cp311-linux_x86_64.whl.metadata (30 kB)
Collecting numpy>=1.26 (from torch)
  Using cached numpy-2.4.6-cp311-cp311-linux_x86_64.whl (17.0 MB)
Downloading torch-2.13.0-cp311-cp311-linux_x86_64.whl (890.0 MB)
Progress 1000000 of 890000000
Progress 890000000 of 890000000
WARNING: something beside the matter
Installing collected packages: numpy, torch
Successfully installed numpy-2.4.6 torch-2.13.0"""
UV = """\
Using Python 3.12.1 environment at: environment
Resolved 2 packages in 800ms
Downloading torch (849.0MiB)
 Downloaded torch
Prepared 2 packages in 1m 02s
Installed 2 packages in 300ms
 + numpy==2.4.6
 + torch==2.13.0"""


@pytest.mark.parametrize("said", [PIP, UV])
def test_fractions_rise_from_what_is_said(said: str) -> None:
    reading = InstallProgress(num_requirements=1)
    fractions = []
    for line in said.splitlines():
        reading.read(line)
        fractions.append(reading.fraction)
        assert 0 <= reading.fraction <= 1
        assert len(reading.text) <= TEXT_LENGTH
    assert fractions == sorted(fractions)
    assert fractions[0] == 0
    assert fractions[-1] == 1
    assert len(set(fractions)) >= 4


def test_a_long_download_is_told_in_megabytes() -> None:
    reading = InstallProgress(num_requirements=1)
    for line in PIP.splitlines()[:7]:
        reading.read(line)
    assert reading.text == "Downloading torch: 1 of 890 MB"
    reading.read("Progress 5 of 0")
    reading.read("WARNING: no matter")
    assert reading.text == "Downloading torch: 1 of 890 MB"


def test_texts_are_cut() -> None:
    assert shortened("  a   b ") == "a b"
    assert len(shortened("x" * 1000)) == TEXT_LENGTH


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("ERROR: [Errno 28] No space left on device", ErrorCode.DISK_FULL, "disk is full"),
        ("ERROR: No matching distribution found for x", ErrorCode.MISSING_DEPENDENCY, "No matching"),
    ],
)
def test_failures_of_pip_are_explained(line: str, code: ErrorCode, words: str) -> None:
    error = explain(["before", line])
    assert error.code is code
    assert words in error.text


COLLECTED = """\
Collecting scikit-image>=0.24
  Downloading scikit_image-0.26.0-cp311-cp311-win_amd64.whl.metadata (15 kB)
Collecting networkx>=3.0 (from scikit-image>=0.24)
  Downloading networkx-3.6.1-py3-none-any.whl.metadata (6.8 kB)
Installing collected packages: mpmath, networkx, torch"""
RETRYING = (
    "WARNING: Retrying (Retry(total={}, connect=None, read=None, redirect=None, status=None)) after "
    "connection broken by 'NewConnectionError('<pip._vendor.urllib3.connection.HTTPConnection object>: "
    "Failed to establish a new connection: [Errno 111] Connection refused')': /simple/numpy/"
)
DENIED = r"""
ERROR: Could not install packages due to an OSError: [WinError 5] Access is denied: 'C:\e\torch\fx\proxy.py'
Check the permissions."""
NOTHING_FOUND = """
ERROR: Could not find a version that satisfies the requirement numpy>=1.26 (from versions: none)
ERROR: No matching distribution found for numpy>=1.26"""
CONFLICT = """
ERROR: Cannot install numpy because these package versions have conflicting dependencies."""
TOO_OLD = """
ERROR: Could not find a version that satisfies the requirement networkx>=9 (from versions: 3.5, 3.6.1)
ERROR: No matching distribution found for networkx>=9"""
BROKEN_OFF = """
ERROR: Exception:
Traceback (most recent call last):
  File "/e/pip/_vendor/urllib3/response.py", line 438, in _error_catcher
pip._vendor.urllib3.exceptions.ReadTimeoutError: HTTPSConnectionPool(host='files'): Read timed out."""
INCOMPLETE = """
error: incomplete-download

× Download failed because not enough bytes were received (0.8 MB/890 MB)
╰─> URL: https://files/torch.whl

note: This is an issue with network connectivity, not pip."""
UV_OLDER = """\
  × Failed to download `torch==2.13.0`
  ├─▶ Failed to fetch: `https://download.pytorch.org/whl/cpu/torch.whl`
  ╰─▶ operation timed out"""


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        pytest.param(COLLECTED + DENIED, False, id="a file is held"),
        pytest.param(
            f"{RETRYING.format(4)}\n{COLLECTED}{DENIED}", False, id="answered in the end, then a file is held"
        ),
        pytest.param(COLLECTED + TOO_OLD, False, id="no such version"),
        pytest.param(RETRYING.format(1) + TOO_OLD, False, id="answered in the end, no such version"),
        pytest.param(RETRYING.format(0) + NOTHING_FOUND, True, id="never answered"),
        pytest.param(RETRYING.format(0) + CONFLICT, True, id="never answered, with constraints"),
        pytest.param(COLLECTED + BROKEN_OFF, True, id="broken off"),
        pytest.param(COLLECTED + INCOMPLETE, True, id="incomplete"),
        pytest.param(UV_UNREACHABLE, True, id="uv never answered"),
        pytest.param(UV_OLDER, True, id="an older uv never answered"),
        pytest.param(UV_NO_SOLUTION, False, id="uv found no version"),
    ],
)
def test_the_network_is_named_only_where_it_is_to_blame(said: str, expected: bool) -> None:
    """Not for the names of packages and files."""
    error = explain(said.splitlines())
    assert ("out of reach" in error.text) == expected
    assert ("proxy" in error.remedy) == expected


def test_the_users_settings_hold_and_nothing_leads_elsewhere() -> None:
    found = pip_environment({"PIP_INDEX_URL": "i", "PIP_TARGET": "t", "PIP_USER": "1", "PYTHONPATH": "p"})
    assert found["PIP_INDEX_URL"] == "i"
    assert found["PIP_USER"] == "0"
    assert not {"PIP_TARGET", "PYTHONPATH"} & set(found)


def test_settings_of_pip_are_read_and_variables_win() -> None:
    lines = [":env:.index-url='b'", "global.index-url='a'", "global.find-links='x\\ny'", "nonsense"]
    assert pip_settings(lines) == {"index-url": "b", "find-links": "x\ny"}


def test_the_requirements_are_those_of_the_project() -> None:
    assert len(requirements(ROOT)) == len(DEPENDENCIES)


# Messages that the tests above do not reach.


def test_a_file_in_the_way_is_a_sentence(case: Case, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    case.folder = tmp_path / "file" / "environment"
    last = case.run()[-1]
    assert isinstance(last, Failed)
    assert last.code == ErrorCode.OUTPUT_UNUSABLE
    assert "Traceback" not in last.text
