"""The output folder and its checkpoints: exact round trips, whose files they are, what a crash leaves."""

import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from jaxtyping import Float32

from backend.errors import ErrorCode, ReconstructionError
from backend.records import RecordUnreadable, load_record, read_note, save_record
from backend.workspace import Purpose, StageCost, check_free_space, fingerprint, open_workspace

COST = StageCost(seconds=1.5, peak_memory_bytes=2**30)
on_disk = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


@dataclass(frozen=True, kw_only=True)
class Inner:
    label: str
    values: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Outer:
    inner: tuple[Inner, ...]
    pair: tuple[int, str]
    size: float
    flag: bool
    where: Path
    shaped: Float32[np.ndarray, "rows 3"] | None
    maybe: Inner | None = None
    default: tuple[str, ...] = ()


arrays = st_numpy.arrays(
    dtype=st.one_of(
        st_numpy.floating_dtypes(endianness="?"),
        st_numpy.integer_dtypes(endianness="?"),
        st_numpy.boolean_dtypes(),
        st_numpy.unsigned_integer_dtypes(),
    ),
    shape=st_numpy.array_shapes(min_dims=0, min_side=0, max_side=4),
)
inners = st.builds(Inner, label=st.text(), values=arrays | arrays.map(np.transpose))
outers = st.builds(
    Outer,
    inner=st.lists(inners, max_size=3).map(tuple),
    pair=st.tuples(st.integers(), st.text(st.characters(codec="utf-8"))),
    size=st.floats(),
    flag=st.booleans(),
    where=st.just(Path("a/b c.png")),
    shaped=st.none() | st_numpy.arrays(np.float32, st.tuples(st.integers(0, 4), st.just(3))),
    maybe=st.none() | inners,
    default=st.lists(st.text(), max_size=2).map(tuple),
)


def assert_identical(found: object, expected: object) -> None:
    assert type(found) is type(expected)
    if isinstance(expected, np.ndarray):
        assert isinstance(found, np.ndarray)
        assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
        assert found.tobytes() == expected.tobytes()
    elif isinstance(expected, tuple):
        assert isinstance(found, tuple)
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert_identical(one, other)
    elif isinstance(expected, Inner | Outer):
        for name in expected.__dataclass_fields__:
            assert_identical(getattr(found, name), getattr(expected, name))
    else:
        assert repr(found) == repr(expected)  # repr: NaN equals itself, 0.0 differs from -0.0


@on_disk
@given(record=outers)
def test_a_record_comes_back_to_the_bit(tmp_path: Path, record: Outer) -> None:
    save_record(tmp_path / "r.npz", record, Outer, note="hello")
    assert_identical(load_record(tmp_path / "r.npz", Outer), record)
    assert read_note(tmp_path / "r.npz") == "hello"


def outer(**changes: object) -> Outer:
    fields = {"inner": (), "pair": (1, "x"), "size": 1.0, "flag": True, "where": Path("p"), "shaped": None}
    return Outer(**{**fields, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "changes",
    [
        {"size": True},
        {"flag": 1},
        {"pair": (1, "x", 2)},
        {"pair": ("1", "x")},
        {"where": "p"},
        {"inner": [Inner(label="", values=np.zeros(1))]},
        {"inner": (Inner(label="", values=np.array([object()])),)},
        {"maybe": "text"},
    ],
)
def test_a_value_against_its_annotation_is_not_stored(tmp_path: Path, changes: dict[str, object]) -> None:
    with pytest.raises(TypeError):
        save_record(tmp_path / "r.npz", outer(**changes), Outer)
    assert list(tmp_path.iterdir()) == []


def test_an_array_of_another_shape_is_not_loaded(tmp_path: Path) -> None:
    save_record(tmp_path / "r.npz", outer(shaped=np.zeros((4, 2), np.float32)), Outer)
    with pytest.raises(RecordUnreadable, match="shaped"):
        load_record(tmp_path / "r.npz", Outer)


def test_a_record_of_another_type_is_not_loaded(tmp_path: Path) -> None:
    save_record(tmp_path / "r.npz", outer(), Outer)
    with pytest.raises(RecordUnreadable):
        load_record(tmp_path / "r.npz", Inner)


def test_every_cut_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    save_record(path, outer(shaped=np.ones((50, 3), np.float32)), Outer, note="n")
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(RecordUnreadable):
            load_record(path, Outer)
        assert read_note(path) is None


def test_flipped_bits_in_the_data_are_noticed(tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    save_record(path, outer(shaped=np.full((50, 3), 7, np.float32)), Outer)
    data = bytearray(path.read_bytes())
    data[data.index(np.full(20, 7, np.float32).tobytes()) + 30] ^= 1
    path.write_bytes(data)
    with pytest.raises(RecordUnreadable):
        load_record(path, Outer)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs the device that is always full")
def test_a_full_disk_leaves_the_old_record(tmp_path: Path) -> None:
    path = tmp_path / "r.npz"
    save_record(path, outer(size=3.0), Outer)
    (tmp_path / "r.npz.part").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left"):
        save_record(path, outer(size=4.0, shaped=np.zeros((9999, 3), np.float32)), Outer)
    assert load_record(path, Outer).size == 3.0


def test_a_finished_stage_is_found_again_and_others_are_not(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        workspace.save("photos", "abc", outer(size=2.0), Outer, COST)
    with open_workspace(tmp_path / "out") as workspace:
        found = workspace.load_or_none("photos", "abc", Outer)
        assert found is not None
        assert (found[0].size, found[1]) == (2.0, COST)
        assert workspace.load_or_none("photos", "abd", Outer) is None
        assert workspace.load_or_none("cameras", "abc", Outer) is None
        assert workspace.load_or_none("photos", "abc", Inner) is None  # code has changed: redone


def refused(folder: Path) -> ReconstructionError:
    with pytest.raises(ReconstructionError) as raised, open_workspace(folder):
        pass
    return raised.value


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    return {str(p): (p.stat().st_mtime_ns, p.stat().st_size) for p in [folder, *folder.rglob("*")]}


def test_a_folder_with_files_of_others_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.doc").write_text("years of work")
    before = snapshot(tmp_path)
    error = refused(tmp_path)
    assert error.code is ErrorCode.OUTPUT_UNUSABLE
    assert "thesis.doc" in error.text
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("names", [("notes.txt",), ("notes.txt", "lock", "format.json.part")])
def test_a_private_folder_of_others_is_not_touched(tmp_path: Path, names: tuple[str, ...]) -> None:
    (tmp_path / ".fewview").mkdir()
    for name in names:
        (tmp_path / ".fewview" / name).write_text("mine")
    before = snapshot(tmp_path)
    assert refused(tmp_path).code is ErrorCode.OUTPUT_UNUSABLE
    assert snapshot(tmp_path) == before


@pytest.mark.parametrize("names", [(), ("lock",), ("lock", "format.json.part")])
def test_what_a_kill_while_opening_leaves_is_ours(tmp_path: Path, names: tuple[str, ...]) -> None:
    (tmp_path / ".fewview").mkdir()
    for name in names:
        (tmp_path / ".fewview" / name).touch()
    (tmp_path / ".DS_Store").touch()
    with open_workspace(tmp_path) as workspace:
        assert workspace.folder == tmp_path


@pytest.mark.parametrize("content", ['{"format": 999}', "not json", "[1]"])
def test_a_folder_of_another_format_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / ".fewview").mkdir()
    (tmp_path / ".fewview" / "format.json").write_text(content)
    assert "another version" in refused(tmp_path).text


def test_a_file_or_a_folder_below_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    assert refused(tmp_path / "file").code is ErrorCode.OUTPUT_UNUSABLE
    assert refused(tmp_path / "file" / "out").code is ErrorCode.OUTPUT_UNUSABLE


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder that nobody can write to")
def test_a_place_that_cannot_be_written_is_refused() -> None:
    assert refused(Path("/proc/fewview-output")).code is ErrorCode.OUTPUT_UNUSABLE


@pytest.mark.skipif(sys.platform == "win32" or os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_refused(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert refused(tmp_path / "out").code is ErrorCode.OUTPUT_UNUSABLE


def test_a_second_run_on_the_same_folder_is_refused(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out"):
        assert "Another run" in refused(tmp_path / "out").text
    with open_workspace(tmp_path / "out"):
        pass


def write_text(text: str):  # type: ignore[no-untyped-def]
    return lambda path: path.write_text(text)


def fail(_path: Path) -> None:
    raise OSError(28, "No space left on device")


def test_results_appear_together_or_not_at_all(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        workspace.write_results({"a": write_text("old a"), "b": write_text("old b")})
        with pytest.raises(OSError, match="No space"):
            workspace.write_results({"a": write_text("new a"), "b": fail})
        assert (workspace.folder / "a").read_text() == "old a"
        workspace.write_results({"a": write_text("new a"), "b": write_text("new b")})
        assert [(workspace.folder / name).read_text() for name in "ab"] == ["new a", "new b"]


def test_what_an_earlier_run_left_and_this_one_has_not_is_removed(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        workspace.write_results({"a": write_text("old a"), "b": write_text("old b")}, replaced=("b",))
        assert (workspace.folder / "b").read_text() == "old b"
        assert workspace.results == ("a", "b")
        workspace.write_results({"a": write_text("new a")}, replaced=("b", "never"))
        assert workspace.results == ("a",)
        # where letter cases are not told apart, the earlier name is that of the new result
        workspace.write_results({"A": write_text("another")}, replaced=("a",))
        assert (workspace.folder / "a").exists()
        assert (workspace.folder / "A").read_text() == "another"
        assert not (workspace.folder / "b").exists()
        assert (workspace.folder / "a").read_text() == "new a"


def test_a_note_that_names_files_elsewhere_is_not_believed(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        note = workspace.private / "format.json"
        note.write_text(
            json.dumps({**json.loads(note.read_text()), "results": ["../theirs", "/theirs", "a"]})
        )
        assert workspace.results == ("a",)


@pytest.mark.parametrize("stuck", ["b", "c"])
def test_a_result_that_is_open_elsewhere_leaves_all_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stuck: str
) -> None:
    """As on Windows, where nobody may replace or remove a file that another program has open."""
    replace = Path.replace

    def refuse(path: Path, target: Path) -> Path:
        if path == tmp_path / "out" / stuck:
            raise PermissionError(13, "Permission denied")
        return replace(path, target)

    with open_workspace(tmp_path / "out") as workspace:
        workspace.write_results({name: write_text(f"old {name}") for name in "abc"}, frame="old")
        monkeypatch.setattr(Path, "replace", refuse)
        new = {name: write_text(f"new {name}") for name in "xab"}
        with pytest.raises(ReconstructionError) as raised:
            workspace.write_results(new, replaced=("c",), frame="new")
        assert raised.value.code is ErrorCode.OUTPUT_UNUSABLE
        assert f"the program that has {stuck} open" in raised.value.remedy
        assert {path.name: path.read_text() for path in (tmp_path / "out").glob("?")} == {
            name: f"old {name}" for name in "abc"
        }
        assert workspace.frame == "old"
        monkeypatch.setattr(Path, "replace", replace)
        workspace.write_results(new, replaced=("c",), frame="new")
        assert {path.name: path.read_text() for path in (tmp_path / "out").glob("?")} == {
            name: f"new {name}" for name in "xab"
        }
        assert workspace.frame == "new"
        assert not list(workspace.private.glob("*/"))


def test_a_checkpoint_that_another_program_holds_does_not_fail_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A virus scanner on Windows: the results are written, and nothing else is asked of the run."""

    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    with open_workspace(tmp_path / "out") as workspace:
        held = workspace.private / "stereo.npz"
        held.touch()
        monkeypatch.setattr(Path, "unlink", refuse)
        workspace.discard_stages()
        monkeypatch.undo()
        assert held.exists()
        workspace.discard_stages()
        assert not held.exists()


def test_a_checkpoint_that_can_not_be_written_is_told(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        (workspace.private / "photos.npz.part").mkdir()
        with pytest.raises(ReconstructionError, match="cannot be written"):
            workspace.save("photos", "abc", outer(), Outer, COST)


def test_a_folder_stays_with_its_photographs(tmp_path: Path) -> None:
    """With one of them at least: who adds, drops or retouches some goes on in the same folder."""
    with open_workspace(tmp_path / "out") as workspace:
        workspace.claim("photographs", ["1", "2", "3"])
        workspace.claim("photographs", ["3", "4"])
    with open_workspace(tmp_path / "out") as workspace:
        for others in (["1", "2"], ["5"]):  # those of before last are forgotten
            with pytest.raises(ReconstructionError, match="other photographs") as raised:
                workspace.claim("photographs", others)
            assert raised.value.code is ErrorCode.OUTPUT_UNUSABLE
        workspace.claim("photographs", ["4"])


@pytest.mark.parametrize(
    ("first", "then", "words"),
    [
        ("photographs", "points", "a reconstruction from photographs"),
        ("points", "photographs", "a surface that was fitted to points"),
        ("pictures", "photographs", "pictures of a finished job"),
    ],
)
def test_a_folder_keeps_its_purpose(tmp_path: Path, first: Purpose, then: Purpose, words: str) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        workspace.claim(first)
        workspace.claim(first)
    with open_workspace(tmp_path / "out") as workspace, pytest.raises(ReconstructionError, match=words):
        workspace.claim(then)


def test_checkpoints_without_a_purpose_are_those_of_photographs(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        workspace.save("photos", "abc", outer(), Outer, COST)
        with pytest.raises(ReconstructionError, match="from photographs"):
            workspace.claim("points")
        workspace.claim("photographs", ["1"])


def test_a_run_that_did_nothing_leaves_nothing(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        workspace.log_path.write_text("log")
        workspace.discard_if_nothing_done()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kept", ["photos.npz", "../notes.txt"])
def test_a_run_that_did_something_is_kept(tmp_path: Path, kept: str) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        (workspace.private / kept).write_text("x")
        workspace.discard_if_nothing_done()
        assert (workspace.private / kept).exists()
        assert json.loads((workspace.private / "format.json").read_text())["format"] == 1


def test_free_space_is_asked_for(tmp_path: Path) -> None:
    check_free_space(tmp_path, 1)
    with pytest.raises(ReconstructionError) as raised:
        check_free_space(tmp_path, 10**18)
    assert raised.value.code is ErrorCode.DISK_FULL


def test_the_fingerprint_follows_content_names_and_settings(tmp_path: Path) -> None:
    file, folder = tmp_path / "a.png", tmp_path
    file.write_bytes(b"1")
    first = fingerprint(folder, "x", 1)
    os.utime(file, (1, 1))
    assert fingerprint(folder, "x", 1) == first  # times do not matter
    assert fingerprint(file, "x", 1) == first  # nor whether the file or its folder is named
    assert fingerprint(folder, "x", 1.0) != first
    file.write_bytes(b"2")
    second = fingerprint(folder, "x", 1)
    file.rename(tmp_path / "b.png")
    assert len({first, second, fingerprint(folder, "x", 1)}) == 3


def test_what_file_browsers_leave_is_not_in_the_fingerprint(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"1")
    first = fingerprint(tmp_path)
    (tmp_path / ".DS_Store").write_bytes(b"where windows were")
    assert fingerprint(tmp_path) == first
    (tmp_path / "b.png").write_bytes(b"1")
    assert fingerprint(tmp_path) != first


def test_the_scratch_folder_is_empty_each_time(tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as workspace:
        (workspace.emptied_sfm_folder() / "left over").touch()
        assert list(workspace.emptied_sfm_folder().iterdir()) == []
