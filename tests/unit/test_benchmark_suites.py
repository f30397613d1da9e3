"""The benchmark's cases: what is given and held out, and what is found on a machine."""

from dataclasses import replace
from pathlib import Path

import pytest

from backend.benchmark.measuring import Trial, reconstruct_words
from backend.benchmark.suites import SUITES, Case, Suite, find_cases, image_paths, rendered_case

CASES = [case for suite in SUITES.values() for case in suite.cases]
DATA = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"


def filled(case: Case, folder: Path, num_images: int) -> Path:
    """A folder with all that the case needs, as empty files."""
    (folder / case.images).mkdir(parents=True)
    for index in range(num_images):
        (folder / case.images / f"{index:03d}.png").touch()
    for name in case.files:
        (folder / name).touch()
    return folder


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_what_is_held_out_is_not_given(case: Case, tmp_path: Path) -> None:
    folder = filled(case, tmp_path, 24)
    held_out = {str(path) for path in image_paths(case, folder, case.held_out)}
    given = {str(path) for path in image_paths(case, folder, case.given)}
    trial = Trial(case=case, folder=folder, preset="fast", seed=3, device="cpu")
    words = set(reconstruct_words(trial, tmp_path / "out"))
    assert len(held_out) == len(case.held_out)
    assert given <= words
    assert not held_out & words


def test_a_subject_without_its_ground_is_of_the_same_photographs(tmp_path: Path) -> None:
    cases = {case.name: case for case in CASES}
    words = []
    for name in ("table_6", "table_alone_6"):
        folder = filled(cases[name], tmp_path / name, 24)
        trial = Trial(case=cases[name], folder=folder, preset="fast", seed=3, device="cpu")
        words.append([word.replace(name, "") for word in reconstruct_words(trial, tmp_path / "out")])
    assert [word for word in words[1] if word not in words[0]] == ["--without-ground"]
    assert cases["table_alone_6"].folder == "table_6"


@pytest.mark.parametrize("name", SUITES)
def test_cases_of_a_suite_have_names_of_their_own(name: str) -> None:
    names = [case.name for case in SUITES[name].cases]
    assert len(set(names)) == len(names)


@pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is not there")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_no_case_is_left_out_for_a_wrong_name(case: Case) -> None:
    if case.rendering is None:
        assert (DATA / case.folder / case.images).is_dir()
    elif Path(case.rendering.scene).suffix:
        assert (DATA / case.rendering.scene).is_file()


def test_an_image_cannot_be_both_given_and_held_out() -> None:
    with pytest.raises(ValueError, match="both given and held out"):
        Case(name="a", folder="a", given=(0, 1), held_out=(1, 2))


@pytest.mark.parametrize("changes", [{"held_out": (1,)}, {"held_out": (1, 3), "cameras": None}])
def test_held_out_images_need_cameras_and_company(changes: dict[str, object]) -> None:
    case = Case(name="a", folder="a", given=(0, 2))
    with pytest.raises(ValueError, match="held-out images need"):
        replace(case, **changes)


def test_surroundings_are_told_from_a_truth() -> None:
    with pytest.raises(ValueError, match="surroundings need a truth"):
        Case(name="a", folder="a", given=(0, 2), surroundings="room.ply")


@pytest.mark.parametrize(("num_given", "total", "kind"), [(3, 5, "40"), (6, 11, "120"), (12, 24, "ring")])
def test_given_views_of_a_scene_lie_evenly_with_one_held_out_between_two(
    num_given: int, total: int, kind: str
) -> None:
    case = rendered_case("monkey", num_given)
    assert case.rendering is not None
    assert sorted(case.given + case.held_out) == list(range(total))
    assert case.given == tuple(range(0, 2 * num_given, 2))
    assert str(total) in case.rendering.words
    assert kind in case.rendering.words


@pytest.mark.parametrize("num_given", [3, 6, 12])
def test_without_any_held_out_as_many_views_are_rendered_as_are_given(num_given: int) -> None:
    case = rendered_case("monkey", num_given, hold_out=False)
    assert case.given == tuple(range(num_given))
    assert case.held_out == ()
    assert case.rendering is not None
    assert str(num_given) in case.rendering.words


def test_cases_are_found_where_all_their_files_are(tmp_path: Path) -> None:
    scene = rendered_case("monkey", 3)
    photos = Case(name="photos", folder="set", given=(0, 1, 2), cameras=None)
    suite = Suite(name="both", cases=(scene, photos))
    filled(scene, tmp_path / "scenes" / scene.folder, 5)
    filled(photos, tmp_path / "photos" / photos.folder, 3)
    both = find_cases(suite, tmp_path / "scenes", tmp_path / "photos")
    assert [case.name for case, _ in both.cases] == ["monkey_3", "photos"]
    assert both.missing == ()
    alone = find_cases(suite, tmp_path / "scenes", None)
    assert [case.name for case, _ in alone.cases] == ["monkey_3"]
    assert alone.missing == ("photos",)


@pytest.mark.parametrize("lost", ["truth.ply", "transforms.json", "images/004.png"])
def test_a_case_that_lacks_a_file_is_missing(lost: str, tmp_path: Path) -> None:
    case = rendered_case("monkey", 3)
    (filled(case, tmp_path / case.folder, 5) / lost).unlink()
    found = find_cases(Suite(name="one", cases=(case,)), tmp_path, None)
    assert found.cases == ()
    assert found.missing == ("monkey_3",)
