"""The wire: what is written is read back, and nothing else is accepted."""

import ast
import json
import os
import sys
import time
import typing
from dataclasses import fields, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backend.wire import client, protocol
from backend.wire.client import WireProcess, backend_command, clean_environment, describe_crash
from backend.wire.protocol import (
    PROTOCOL_VERSION,
    Failed,
    Finished,
    Hello,
    Job,
    Message,
    ProtocolError,
    decode,
    decode_job,
    encode,
    encode_job,
)

VALUES = {
    str: st.text(),
    int: st.integers(),
    float: st.floats(allow_nan=False, allow_infinity=False),
    float | None: st.none() | st.floats(allow_nan=False, allow_infinity=False),
    str | None: st.none() | st.text(),
    bool: st.booleans(),
    tuple[float, ...] | None: st.none()
    | st.lists(st.floats(allow_nan=False, allow_infinity=False)).map(tuple),
    tuple[str, ...]: st.lists(st.text(), max_size=3).map(tuple),
}


def any_of(kind: type) -> st.SearchStrategy[typing.Any]:
    """Any valid record of the kind; a field of a new type fails here until it has a strategy."""
    values = {name: VALUES[hint] for name, hint in typing.get_type_hints(kind).items()}
    if "protocol" in values:
        values["protocol"] = st.just(PROTOCOL_VERSION)
    return st.builds(kind, **values)


@given(st.one_of([any_of(kind) for kind in typing.get_args(Message)]))
def test_every_message_comes_back(message: Message) -> None:
    line = encode(message)
    assert "\n" not in line
    assert line.isascii()
    assert decode(line) == message


@given(any_of(Job), st.sampled_from(protocol.PRESETS), st.sampled_from(protocol.DEVICES))
def test_every_job_comes_back(job: Job, preset: str, device: str) -> None:
    values = {f.name: getattr(job, f.name) for f in fields(job)}
    sensible = {
        "seed": job.seed % 1000,
        "region_centre": (0.0, 1.5, -2.0),
        "region_radius": 3.0,
        "budget_s": 2.5,
    }
    valid = Job(**{**values, **sensible, "preset": preset, "device": device, "until": "cameras"})
    assert decode_job(encode_job(valid)) == valid


@given(st.text() | st.binary().map(lambda data: data.decode("latin-1")))
def test_any_other_text_is_refused_in_an_orderly_way(text: str) -> None:
    with pytest.raises(ProtocolError):
        decode(text)


PROGRESS: dict[str, object] = {
    "type": "progress",
    "stage": "s",
    "fraction": 0.5,
    "text": "t",
    "remaining_s": None,
}


def test_the_line_that_the_next_test_damages_is_fine() -> None:
    assert decode(json.dumps(PROGRESS)) == protocol.Progress(
        stage="s", fraction=0.5, text="t", remaining_s=None
    )


@pytest.mark.parametrize(
    "change",
    [
        {"type": "progres"},
        {"type": None},
        {"type": ["progress"]},
        {"fraction": "0.5"},
        {"fraction": True},
        {"fraction": float("nan")},
        {"fraction": float("inf")},
        {"fraction": 10**400},
        {"stage": 3},
        {"text": None},
        {"colour": "red"},
    ],
)
def test_a_wrong_field_is_refused(change: dict[str, object]) -> None:
    with pytest.raises(ProtocolError):
        decode(json.dumps({**PROGRESS, **change}))


@pytest.mark.parametrize("name", PROGRESS)
def test_a_missing_field_is_refused(name: str) -> None:
    with pytest.raises(ProtocolError):
        decode(json.dumps({k: v for k, v in PROGRESS.items() if k != name}))


def test_true_is_no_number() -> None:
    stage = {"type": "stage", "name": "mesh", "index": 1, "count": 7}
    assert decode(json.dumps(stage)) == protocol.Stage(name="mesh", index=1, count=7)
    with pytest.raises(ProtocolError, match="index"):
        decode(json.dumps({**stage, "index": True}))


def test_a_number_of_thousands_of_digits_is_refused() -> None:
    with pytest.raises(ProtocolError):
        decode('{"type": "heartbeat", "elapsed_s": ' + "9" * 5000 + "}")


def test_a_repeated_key_is_refused() -> None:
    with pytest.raises(ProtocolError, match="repeated"):
        decode('{"type": "cancel", "type": "cancel"}')


def test_numbers_that_json_lacks_are_not_written() -> None:
    with pytest.raises(ValueError, match="JSON"):
        encode(protocol.Heartbeat(elapsed_s=float("nan")))


@pytest.mark.parametrize("version", [PROTOCOL_VERSION + 1, 0, "1", None, True])
def test_another_version_is_named_even_if_its_fields_differ(version: object) -> None:
    for text, read in ((json.dumps({"type": "hello", "protocol": version, "new": 1}), decode),):
        with pytest.raises(ProtocolError, match="speaks protocol"):
            read(text)
    with pytest.raises(ProtocolError, match="speaks protocol"):
        decode_job(json.dumps({"protocol": version, "new": 1}))


@pytest.mark.parametrize(
    "change",
    [
        {"preset": "best"},
        {"device": "tpu"},
        {"until": "tomorrow"},
        {"seed": 1.5},
        {"seed": -1},
        {"seed": 2**40},
        {"images": "a.png"},
        {"region_centre": [0, 0, 0]},
        {"region_radius": 1},
        {"region_centre": [0, 0], "region_radius": 1},
        {"region_centre": [0, 0, 1e300], "region_radius": 1},
        {"region_centre": [0, 0, 0], "region_radius": 0},
        {"region_centre": [0, 0, 0], "region_radius": -1},
        {"budget_s": 0},
        {"budget_s": -1},
        {"budget_s": "1"},
        {"region_centre": [0, 0, "0"], "region_radius": 1},
    ],
)
def test_a_job_with_a_wrong_value_is_refused(change: dict[str, object]) -> None:
    job = {"protocol": PROTOCOL_VERSION, "images": ["a"], "output": "o"}
    assert decode_job(json.dumps(job)).seed == 0
    with pytest.raises(ProtocolError):
        decode_job(json.dumps({**job, **change}))


@pytest.mark.parametrize("name", ["images", "output", "cameras", "masks", "truth"])
def test_a_path_that_no_file_can_have_is_refused(name: str) -> None:
    job = Job(protocol=PROTOCOL_VERSION, images=("a",), output="o")
    protocol.check_paths(job)
    wrong = replace(job, **{name: ("a", "a\0b") if name == "images" else "a\0b"})
    with pytest.raises(ProtocolError, match="path of a file"):
        protocol.check_paths(wrong)


@pytest.mark.parametrize("name", ["images", "output", "cameras", "masks", "truth"])
def test_a_path_without_a_letter_is_refused(name: str) -> None:
    """A variable of a shell that is not set: it would be the folder of the job file, or the current one."""
    job = Job(protocol=PROTOCOL_VERSION, images=("a",), output="o")
    wrong = replace(job, **{name: ("a", "") if name == "images" else ""})
    with pytest.raises(ProtocolError, match=f"{name} .*empty"):
        protocol.check_paths(wrong)


@pytest.mark.parametrize("number", ["1e999", "-1e999"])
def test_a_number_beyond_all_floats_is_refused(number: str) -> None:
    """JSON has no infinity, but numbers that are read as one."""
    with pytest.raises(ProtocolError, match="larger than any float"):
        decode(f'{{"type": "heartbeat", "elapsed_s": {number}}}')
    job = f'{{"protocol": {PROTOCOL_VERSION}, "images": ["a"], "output": "o", "budget_s": {number}}}'
    with pytest.raises(ProtocolError, match="budget_s is larger than any float"):
        decode_job(job)


def test_a_job_with_a_number_that_json_lacks_says_so() -> None:
    job = Job(protocol=PROTOCOL_VERSION, images=("a",), output="o", budget_s=float("nan"))
    with pytest.raises(ProtocolError, match="job: a number is not finite"):
        encode_job(job)


def test_the_wire_needs_nothing_but_the_standard_library() -> None:
    for path in Path(protocol.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level <= 1, f"{path.name} reaches out of wire/"
                names = [node.module or ""] if node.level == 0 else []
            else:
                continue
            for name in names:
                assert name.split(".")[0] in sys.stdlib_module_names, f"{path.name} imports {name}"


# The caller's side, against backends of a few lines.

FAKE = """
import os, signal, sys, time
sys.path.insert(0, {root!r})
from backend.wire.protocol import *
def say(message): os.write(1, (encode(message) + "\\n").encode())
hello = Hello(protocol=PROTOCOL_VERSION, backend="0", python="3", pid=os.getpid())
"""


def start(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, body: str) -> WireProcess:
    """A backend that runs the body instead of ours."""
    package = tmp_path / "fake" / "backend"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    wire = package / "wire"
    wire.symlink_to(Path(protocol.__file__).parent, target_is_directory=True)
    (package / "__main__.py").write_text(FAKE.format(root=str(package.parent)) + body)
    monkeypatch.setattr(client, "ROOT", package.parent)
    return WireProcess(backend_command(sys.executable), log_path=tmp_path / "backend.log")


def listen(backend: WireProcess, limit_s: float = 10.0) -> list[Message]:
    """All messages until the last one."""
    heard: list[Message] = []
    deadline = time.monotonic() + limit_s
    while backend.is_running and time.monotonic() < deadline:
        heard += backend.poll()
        time.sleep(0.01)
    backend.close()
    return heard


def last_of(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, body: str) -> Failed:
    heard = listen(start(monkeypatch, tmp_path, body))
    assert sum(isinstance(message, Finished | Failed) for message in heard) == 1
    assert isinstance(heard[-1], Failed)
    return heard[-1]


def test_a_conversation_is_heard_in_order(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    body = 'say(hello); say(Warned(text="ä\\n")); say(Finished(output="o", files=("mesh.ply",)))'
    heard = listen(start(monkeypatch, tmp_path, body))
    assert [type(message) for message in heard] == [Hello, protocol.Warned, Finished]
    assert heard[1] == protocol.Warned(text="ä\n")


def test_a_traceback_is_quoted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    failed = last_of(monkeypatch, tmp_path, 'say(hello); raise KeyError("the reason")')
    assert failed.code == protocol.CRASHED
    assert "exit code 1" in failed.text
    assert "the reason" in failed.text


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(("name", "words"), [("SIGKILL", "out of memory"), ("SIGSEGV", "SIGSEGV")])
def test_a_death_by_signal_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, words: str
) -> None:
    failed = last_of(monkeypatch, tmp_path, f"say(hello); os.kill(os.getpid(), signal.{name})")
    assert words in failed.text


@pytest.mark.parametrize(
    "body",
    [
        'os.write(1, b"library noise\\n"); time.sleep(60)',
        'say(Warned(text="no hello")); time.sleep(60)',
        "say(hello); say(hello); time.sleep(60)",
        'os.write(1, encode(hello).replace(": 1,", ": 2,", 1).encode() + b"\\n"); time.sleep(60)',
        'say(hello); os.write(1, b"\\xff\\n"); time.sleep(60)',
    ],
)
def test_a_backend_against_the_protocol_is_ended(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, body: str
) -> None:
    started_s = time.monotonic()
    assert last_of(monkeypatch, tmp_path, body).code == protocol.PROTOCOL_BROKEN
    assert time.monotonic() - started_s < 5.0


def test_cancel_is_heard_by_the_backend(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    body = 'say(hello); line = sys.stdin.readline(); say(Failed(code="cancelled", text=line, remedy=""))'
    backend = start(monkeypatch, tmp_path, body)
    backend.cancel()
    (_, failed) = listen(backend)
    assert isinstance(failed, Failed)
    assert decode(failed.text) == protocol.Cancel()


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(
    ("ignored", "expected"),
    [((), "SIGINT"), (("SIGINT",), "SIGTERM"), (("SIGINT", "SIGTERM"), "out of memory")],
)
def test_a_deaf_backend_is_pressed_harder(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ignored: tuple[str, ...], expected: str
) -> None:
    monkeypatch.setattr(client, "INTERRUPT_AFTER_S", 0.1)
    monkeypatch.setattr(client, "TERMINATE_AFTER_S", 0.4)
    monkeypatch.setattr(client, "KILL_AFTER_S", 0.7)
    lines = ["signal.signal(signal.SIGINT, signal.SIG_DFL)"]
    lines += [f"signal.signal(signal.{name}, signal.SIG_IGN)" for name in ignored]
    backend = start(monkeypatch, tmp_path, "\n".join([*lines, "say(hello)", "time.sleep(60)"]))
    while not backend.poll():
        time.sleep(0.01)
    backend.cancel()
    (failed,) = listen(backend)
    assert isinstance(failed, Failed)
    assert expected in failed.text


def test_closing_ends_a_backend_that_hangs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    backend = start(monkeypatch, tmp_path, "say(hello)\nwhile True: time.sleep(1)")
    while not (heard := backend.poll()):
        time.sleep(0.01)
    assert isinstance(heard[0], Hello)
    backend.close(timeout_s=0.1)
    with pytest.raises(ProcessLookupError):
        os.kill(heard[0].pid, 0)


def test_a_python_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="no-python"):
        WireProcess(backend_command(tmp_path / "no-python"), log_path=tmp_path / "log")


def test_the_callers_python_settings_do_not_reach_the_backend() -> None:
    clean = clean_environment(
        {"PATH": "p", "PYTHONHOME": "x", "PYTHONPATH": "x", "BLENDER_USER_CONFIG": "x", "HOME": "h"}
    )
    assert (clean["PATH"], clean["HOME"]) == ("p", "h")
    assert clean["PYTHONPATH"] == str(client.ROOT)
    assert not {"PYTHONHOME", "BLENDER_USER_CONFIG"} & set(clean)


@pytest.mark.parametrize(
    ("code", "words"), [(0xC0000135, "missing DLL"), (137, "memory"), (3, "exit code 3"), (-4, "SIGILL")]
)
def test_exit_codes_are_translated(code: int, words: str) -> None:
    assert words in describe_crash(code, "").text


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_of_the_caller_does_not_reach_the_backend(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    backend = start(monkeypatch, tmp_path, "say(hello); time.sleep(60)")
    while not (heard := backend.poll()):
        time.sleep(0.01)
    assert isinstance(heard[0], Hello)
    assert os.getpgid(heard[0].pid) != os.getpgid(0)
    backend.close(timeout_s=0.1)
