"""What the words of the command line become."""

import os
from pathlib import Path
from typing import Any

import pytest

import backend.__main__ as program
from backend import waiting
from backend.commands.install import Plan
from backend.commands.reconstruct import resolve, settings_of
from backend.errors import ReconstructionError
from backend.wire.protocol import Job


@pytest.fixture
def jobs(monkeypatch: pytest.MonkeyPatch) -> list[Job]:
    given: list[Job] = []
    monkeypatch.setattr(program, "on_terminal", lambda job, **_: given.append(job) or 0)
    monkeypatch.setattr(program, "on_wire", lambda path: given.append(path) or 0)
    return given


def test_a_region_is_a_centre_and_a_radius(jobs: list[Job]) -> None:
    assert program.run(["reconstruct", "photos", "--output", "o", "--region", "-1", "2.5", "-0.3", "4"]) == 0
    assert (jobs[0].region_centre, jobs[0].region_radius) == ((-1.0, 2.5, -0.3), 4.0)


def test_without_a_region_it_is_found(jobs: list[Job]) -> None:
    assert program.run(["reconstruct", "photos", "--output", "o"]) == 0
    assert (jobs[0].region_centre, jobs[0].region_radius) == (None, None)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["photos", "--output", "o", "--region", "1", "2", "3", "0"], "must be positive"),
        (["photos", "--output", "o", "--region", "1", "2", "nan", "1"], "finite"),
        (["photos", "--output", "o", "--region", "1", "2", "3"], "expected 4"),
        (["job.json", "--region", "1", "2", "3", "4"], "--region stands in the file"),
        (["job.json", "--budget-seconds", "4"], "--budget-seconds stands in the file"),
        (["job.json", "--without-ground"], "--without-ground stands in the file"),
        (["job.json", "--cut-out"], "--cut-out stands in the file"),
    ],
)
def test_wrong_regions_and_double_options_end_with_a_sentence(
    jobs: list[Job], words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        program.run(["reconstruct", *words])
    assert ended.value.code == 2
    assert message in capsys.readouterr().err
    assert not jobs


def test_a_budget_is_in_seconds(jobs: list[Job]) -> None:
    program.run(["reconstruct", "photos", "--output", "o"])
    program.run(["reconstruct", "photos", "--output", "o", "--budget-seconds", "12.5"])
    assert [job.budget_s for job in jobs] == [None, 12.5]
    assert [settings_of(job).train.budget_s for job in jobs] == [None, 12.5]


def test_the_ground_is_kept_unless_it_is_to_be_left_out(jobs: list[Job]) -> None:
    program.run(["reconstruct", "photos", "--output", "o"])
    program.run(["reconstruct", "photos", "--output", "o", "--without-ground"])
    assert [job.without_ground for job in jobs] == [False, True]
    stereo = [settings_of(job).stereo for job in jobs]
    assert [config.without_ground for config in stereo if config is not None] == [False, True]


@pytest.mark.parametrize("command", ["reconstruct", "cameras"])
def test_the_subject_is_cut_out_where_that_is_asked(jobs: list[Job], command: str) -> None:
    program.run([command, "photos", "--output", "o"])
    program.run([command, "photos", "--output", "o", "--cut-out"])
    assert [job.cut_out for job in jobs] == [False, True]
    assert [resolve(job, Path()).cut_out for job in jobs] == [False, True]


def test_a_preset_without_points_cannot_leave_out_the_ground(jobs: list[Job]) -> None:
    program.run(["reconstruct", "photos", "--output", "o", "--without-ground", "--preset", "nerf"])
    with pytest.raises(ReconstructionError, match="The preset nerf measures no points"):
        settings_of(jobs[0])


@pytest.mark.parametrize("words", [["0"], ["-3"], ["nan"], ["inf"], ["soon"]])
def test_wrong_budgets_end_with_a_sentence(
    jobs: list[Job], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        program.run(["reconstruct", "photos", "--output", "o", "--budget-seconds", *words])
    assert ended.value.code == 2
    assert "--budget-seconds" in capsys.readouterr().err
    assert not jobs


@pytest.mark.parametrize("command", ["reconstruct", "cameras", "fit-points"])
@pytest.mark.parametrize("number", ["-1", "2147483648", "1.5"])
def test_wrong_seeds_end_with_a_sentence(
    jobs: list[Job], command: str, number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        program.run([command, "photos", "--output", "o", "--seed", number])
    assert ended.value.code == 2
    assert "--seed" in capsys.readouterr().err
    assert not jobs


@pytest.mark.parametrize("words", [["photos", "--output", ""], ["", "--output", "o"]])
def test_an_empty_path_is_told_before_anything_is_looked_for(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert program.run(["reconstruct", *words]) == 2
    assert "is empty" in capsys.readouterr().err


def test_every_option_is_explained() -> None:
    (commands,) = (action for action in program._parser()._actions if isinstance(action.choices, dict))
    assert isinstance(commands.choices, dict)
    options = [(name, option) for name, parser in commands.choices.items() for option in parser._actions]
    assert [(name, option.dest) for name, option in options if not option.help] == []


def test_install_and_remove_get_their_words(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(program.install, "install", lambda plan: asked.append(plan) or 0)
    monkeypatch.setattr(program.install, "remove", lambda folder: asked.append(folder) or 0)
    program.run(["install", "--folder", "e"])
    program.run(["install", "--folder", "e", "--torch", "cuda", "--again", "--requirements", "r"])
    program.run(["install", "--folder", "e", "--remove"])
    assert asked == [
        Plan(folder=Path("e")),
        Plan(folder=Path("e"), build="cuda", again=True, requirements_file=Path("r")),
        Path("e"),
    ]


def test_a_rehearsal_gets_its_length_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(program, "rehearse", lambda output, **options: asked.append((output, options)) or 0)
    program.run(["rehearse"])
    program.run(["rehearse", "--output", "o", "--seconds", "3", "--end", "crashed"])
    assert asked == [
        (None, {"seconds": 1.0, "end": "finished"}),
        (Path("o"), {"seconds": 3.0, "end": "crashed"}),
    ]


SLEEP, SPIN, SHORTLY = (
    {"OMP_WAIT_POLICY": "PASSIVE"},
    {"OMP_WAIT_POLICY": "ACTIVE"},
    {"GOMP_SPINCOUNT": "10000"},
)
AT_LENGTH = {"GOMP_SPINCOUNT": "500000"}


@pytest.mark.parametrize(
    ("running", "chosen", "expected"),
    [
        (1, {}, SHORTLY),
        (9, {}, SLEEP),
        (9, SPIN, SPIN),
        (1, SLEEP, SLEEP),
        (1, AT_LENGTH, AT_LENGTH),
        (9, AT_LENGTH, AT_LENGTH),
    ],
)
def test_threads_that_wait_leave_the_cores_to_others(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    running: int,
    chosen: dict[str, str],
    expected: dict[str, str],
) -> None:
    """At once where the computer is busy, else soon; but as the user says if he does."""
    environment = pretended(monkeypatch, tmp_path / "loadavg", chosen, running)
    monkeypatch.setattr(program, "run", lambda _arguments: 0)
    program.main([])
    assert environment == expected


def pretended(
    monkeypatch: pytest.MonkeyPatch, load: Path, chosen: dict[str, str], running: int
) -> dict[str, str]:
    """The environment that a process with four cores finds, of which so many are wanted."""
    load.write_text(f"5.00 5.00 5.00 {running}/250 4711\n", encoding="ascii")
    environment = dict(chosen)
    monkeypatch.setattr(waiting, "_LOAD", load)
    monkeypatch.setattr(waiting, "_chosen", {})
    monkeypatch.setattr(os, "environ", environment)
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    return environment


def test_a_computer_that_became_busy_is_looked_at_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    environment = pretended(monkeypatch, tmp_path / "loadavg", {"HOME": "h"}, running=1)
    waiting.set_waiting_policy()
    assert environment == {"HOME": "h", **SHORTLY}
    (tmp_path / "loadavg").write_text("5.00 5.00 5.00 9/250 4711\n", encoding="ascii")
    waiting.set_waiting_policy()
    assert environment == {"HOME": "h", **SLEEP}


@pytest.mark.parametrize("chosen", [{}, SLEEP, SPIN, SHORTLY, AT_LENGTH])
def test_a_process_that_is_started_gets_what_the_user_chose_and_looks_for_itself(
    chosen: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    environment = pretended(monkeypatch, tmp_path / "loadavg", {"HOME": "h", **chosen}, running=1)
    waiting.set_waiting_policy()
    assert waiting.without_own_policy(environment) == {"HOME": "h", **chosen}
