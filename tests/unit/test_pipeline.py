"""What a run makes of its photographs' files and of an earlier run's folder, before and between stages."""

import inspect
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

from backend import pipeline, workspace
from backend.errors import Cancelled, ErrorCode, ReconstructionError
from backend.pipeline import Job, Listener, Stages
from backend.presets import PRESETS
from backend.records import load_record
from backend.scene import CutOut, Photo, Region, SolvedCameras, StereoResult
from backend.stages.stereo.multi_view_stereo import unmatched
from backend.stages.surface import Surface
from backend.workspace import StageCost, open_workspace
from tests.synthetic_scene import arc_cameras, photographed, true_region

SETTINGS = PRESETS["fast"]


class Quiet:
    """A listener that remembers which stages were finished before."""

    def __init__(self) -> None:
        self.kept: tuple[str, ...] = ()

    def resumed(self, stages: tuple[str, ...]) -> None:
        self.kept = stages

    def stage_started(self, name: str, index: int, count: int) -> None: ...

    def progressed(self, fraction: float, text: str) -> None: ...

    def stage_finished(self, cost: StageCost) -> None: ...

    def previewed(self, path: Path) -> None: ...

    def warned(self, text: str) -> None: ...


@pytest.fixture(autouse=True)
def _among_other_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch stays as it is, and so do hints: the checks of arguments take `tuple[Photo, ...]` for no type."""
    monkeypatch.setattr(pipeline, "set_up_torch", lambda _: None)
    monkeypatch.setattr(workspace, "load_record", inspect.unwrap(load_record))


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return make_photos(tmp_path / "photos", 0)


def make_photos(folder: Path, first: int) -> Path:
    """Three, named alike in every folder."""
    folder.mkdir()
    for index in range(3):
        grey = np.full((4, 6, 3), 20 * (first + index), np.uint8)
        Image.fromarray(grey).save(folder / f"{index}.png")
    return folder


def up_to_the_cameras(job: Job, listener: Listener | None = None) -> tuple[Photo, ...]:
    """Run until cameras are asked for, and stop there; the photographs that they would be found for."""
    given: list[tuple[Photo, ...]] = []

    def solve_cameras(photos: tuple[Photo, ...], *_: Any, **__: Any) -> Any:
        given.append(photos)
        raise Cancelled

    solve_cameras.__annotations__["return"] = pipeline.SolvedCameras
    with open_workspace(job.output) as opened, pytest.raises(Cancelled):
        pipeline.run(
            job,
            opened,
            settings=SETTINGS,
            stages=Stages(solve_cameras=solve_cameras),
            listener=listener or Quiet(),
        )
    return given[0]


def found_and_warned(job: Job) -> tuple[tuple[Photo, ...], list[str]]:
    """The photographs that cameras would be found for, and what the user was told until then."""
    warned: list[str] = []
    listener = Quiet()
    listener.warned = warned.append  # type: ignore[method-assign]
    return up_to_the_cameras(job, listener), warned


def job_of(images: Path, **changes: Any) -> Job:
    return Job(images=(images,), output=images.parent / "out", device="cpu", **changes)


def kept_after(job: Job, change: Callable[[], object]) -> tuple[str, ...]:
    """Which stages a second run need not do again."""
    up_to_the_cameras(job)
    change()
    listener = Quiet()
    up_to_the_cameras(job, listener)
    return listener.kept


def test_a_gpu_that_is_left_aside_is_told(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def choose(_: str, warn: Callable[[str], object]) -> torch.device:
        warn("The CPU is used.")
        return torch.device("cpu")

    monkeypatch.setattr(pipeline, "choose_device", choose)
    _, warned = found_and_warned(job_of(photos))
    assert warned == ["The CPU is used."]


def test_photographs_that_were_moved_are_read_from_where_they_are(photos: Path) -> None:
    """Cameras read them once more where they were made smaller."""
    up_to_the_cameras(job_of(photos))
    moved = photos.rename(photos.with_name("moved"))
    listener = Quiet()
    found = up_to_the_cameras(job_of(moved), listener)
    assert listener.kept == ("photos",)
    assert [photo.path for photo in found] == [moved / f"{index}.png" for index in range(3)]


def test_what_is_no_photograph_does_not_count(photos: Path, tmp_path: Path) -> None:
    """Neither for what is kept nor for the space that is needed; nor masks of other photographs."""
    masks = make_photos(tmp_path / "masks", 5)

    def open_in_a_file_browser() -> None:
        for name in (".DS_Store", "clip.mov", "0.xmp", "._0.png"):
            (photos / name).write_bytes(b"no photograph")
        (masks / "of another.png").write_bytes(b"never read")

    assert kept_after(job_of(photos, masks=masks), open_in_a_file_browser) == ("photos",)


@pytest.mark.parametrize("name", ["photos/1.png", "masks/1.png"])
def test_a_photograph_or_mask_that_changed_is_read_again(photos: Path, tmp_path: Path, name: str) -> None:
    masks = make_photos(tmp_path / "masks", 5)
    change = np.full((4, 6, 3), 222, np.uint8)
    assert not kept_after(job_of(photos, masks=masks), lambda: Image.fromarray(change).save(tmp_path / name))


def test_what_else_lies_with_given_cameras_does_not_count(photos: Path, tmp_path: Path) -> None:
    """In the folder of a finished run the log grows; its points beside the cameras are read with them."""
    folder = tmp_path / "finished"
    folder.mkdir()
    for name in ("cameras.json", "sparse.ply", "log.txt"):
        (folder / name).write_text("before")
    job = job_of(photos, cameras=folder)

    def of_cameras() -> str:
        return pipeline.stage_fingerprints(job, pipeline._files(job), SETTINGS, "cpu")["cameras"]

    before = of_cameras()
    (folder / "log.txt").write_text("after")
    assert of_cameras() == before
    (folder / "sparse.ply").write_text("after")
    assert of_cameras() != before


def test_masks_that_are_no_longer_given_are_forgotten(photos: Path, tmp_path: Path) -> None:
    masks = make_photos(tmp_path / "masks", 5)
    up_to_the_cameras(job_of(photos, masks=masks))
    assert all(photo.mask is None for photo in up_to_the_cameras(job_of(photos)))


def test_photographs_without_masks_among_others_with_masks_are_told(photos: Path, tmp_path: Path) -> None:
    masks = make_photos(tmp_path / "masks", 5)
    Image.fromarray(np.eye(4, 6, dtype=np.uint8)).save(masks / "0.png")  # not white all over
    warned: list[str] = []
    listener = Quiet()
    listener.warned = warned.append  # type: ignore[method-assign]
    up_to_the_cameras(job_of(photos, masks=masks), listener)
    assert not warned
    (masks / "1.png").rename(masks / "l.png")
    up_to_the_cameras(job_of(photos, masks=masks), listener)
    (text,) = warned
    assert "no mask for 1.png:" in text
    assert "Name the mask of 1.png 1_mask.png" in text


def test_masks_among_the_photographs_that_nobody_asked_for_are_told(photos: Path) -> None:
    Image.new("L", (6, 4), 255).save(photos / "1_mask.png")
    found, warned = found_and_warned(job_of(photos))
    assert [photo.name for photo in found] == ["0.png", "1.png", "2.png"]
    assert all(photo.mask is None for photo in found)
    (text,) = warned
    assert "1_mask.png" in text
    found, _ = found_and_warned(job_of(photos, masks=photos))
    assert [photo.name for photo in found if photo.mask is not None] == ["1.png"]


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("cameras", ["none", "in doubt", "known"])
def test_what_may_not_be_turned_with_its_photograph_is_told(
    masked: bool, cameras: str, photos: Path, tmp_path: Path
) -> None:
    """Upside down or not: the shape of a mask or camera does not tell."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3
    Image.new("RGB", (6, 4)).save(photos / "1.png", exif=exif)
    masks = make_photos(tmp_path / "masks", 5)
    Image.fromarray(np.eye(4, 6, dtype=np.uint8)).save(masks / "0.png")  # not white all over
    path = tmp_path / "transforms.json"
    path.write_text('{"frames": []}')
    solved = replace(photographed(arc_cameras(2, 20, 16)).solved(), way_up_told=cameras == "known")

    def solve_cameras(*_: Any, **__: Any) -> SolvedCameras:
        return solved

    def find_region(*_: Any, **__: Any) -> Region:
        raise Cancelled

    job = job_of(photos, masks=masks if masked else None, cameras=None if cameras == "none" else path)
    warned: list[str] = []
    listener = Quiet()
    listener.warned = warned.append  # type: ignore[method-assign]
    stages = Stages(solve_cameras=solve_cameras, find_region=find_region)
    with open_workspace(job.output) as opened, pytest.raises(Cancelled):
        pipeline.run(job, opened, settings=SETTINGS, stages=stages, listener=listener)
    expected = ["masks"] * masked + ["cameras"] * (cameras == "in doubt")
    assert [text.partition(" are taken")[0] for text in warned] == [
        f"EXIF asks to turn 1.png: their {what}" for what in expected
    ]


def test_what_stages_doubt_is_told(photos: Path) -> None:
    scene = photographed(arc_cameras(2, 20, 16))
    views = tuple(replace(view, name=f"{index}.png") for index, view in enumerate(scene.views))
    solved = replace(scene, views=views).solved()

    def solve_cameras(*_: Any, **__: Any) -> SolvedCameras:
        return solved

    def find_region(*_: Any, **__: Any) -> Region:
        return replace(true_region(), doubt="the region's doubt")

    def match_views(*_: Any, **__: Any) -> StereoResult:
        return replace(unmatched(solved.views), doubt="stereo's doubt")

    def fit_surface(*_: Any, **__: Any) -> Surface:
        raise Cancelled

    warned: list[str] = []
    listener = Quiet()
    listener.warned = warned.append  # type: ignore[method-assign]
    stages = Stages(
        solve_cameras=solve_cameras,
        find_region=find_region,
        match_views=match_views,
        fit_surface=fit_surface,
    )
    job = job_of(photos)
    with open_workspace(job.output) as opened, pytest.raises(Cancelled):
        pipeline.run(job, opened, settings=SETTINGS, stages=stages, listener=listener)
    assert [text for text in warned if "doubt" in text] == ["the region's doubt", "stereo's doubt"]


def test_the_subject_is_cut_out_between_cameras_and_region_where_that_is_asked(photos: Path) -> None:
    """Region and stereo get the masks, the user the doubt; a run that does not ask has none of it."""
    scene = photographed(arc_cameras(2, 20, 16))
    views = tuple(replace(view, name=f"{index}.png", mask=None) for index, view in enumerate(scene.views))
    solved = replace(scene, views=views).solved()
    masks = tuple(view.mask for view in scene.views)
    given: list[list[Any]] = []

    def solve_cameras(*_: Any, **__: Any) -> SolvedCameras:
        return solved

    def cut_out(*_: Any, **__: Any) -> CutOut:
        return CutOut(masks=masks, doubt="the cut-out's doubt")

    def find_region(solved: SolvedCameras, *_: Any, **__: Any) -> Region:
        given.append([view.mask for view in solved.views])
        return true_region()

    def match_views(solved: SolvedCameras, *_: Any, **__: Any) -> StereoResult:
        given.append([view.mask for view in solved.views])
        raise Cancelled

    warned: list[str] = []
    listener = Quiet()
    listener.warned = warned.append  # type: ignore[method-assign]
    stages = Stages(
        solve_cameras=solve_cameras, cut_out=cut_out, find_region=find_region, match_views=match_views
    )
    for asked in (True, False):
        job = replace(job_of(photos), cut_out=asked)
        with open_workspace(job.output) as opened, pytest.raises(Cancelled):
            pipeline.run(job, opened, settings=SETTINGS, stages=stages, listener=listener)
    for found in given[:2]:
        for mask, true in zip(found, masks, strict=True):
            np.testing.assert_array_equal(mask, true)
    assert given[2:] == [[None, None]] * 2
    assert [text for text in warned if "doubt" in text] == ["the cut-out's doubt"]


def test_a_finished_job_is_not_replaced_by_another_shoot(photos: Path, tmp_path: Path) -> None:
    """Photographs are told apart by what is in them: cameras begin to count at the same number each time."""
    up_to_the_cameras(job_of(photos))
    kept = (tmp_path / "out/.fewview/photos.npz").read_bytes()
    with pytest.raises(ReconstructionError, match="other photographs") as raised:
        up_to_the_cameras(job_of(make_photos(tmp_path / "others", 3)))
    assert raised.value.code is ErrorCode.OUTPUT_UNUSABLE
    assert (tmp_path / "out/.fewview/photos.npz").read_bytes() == kept


def test_a_photograph_that_nobody_may_read_is_told(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path) -> str:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(pipeline, "content_of", refuse)
    with pytest.raises(ReconstructionError, match=r"0\.png cannot be read") as raised:
        up_to_the_cameras(job_of(photos))
    assert raised.value.code is ErrorCode.PHOTO_UNREADABLE


def test_a_surface_from_points_is_not_replaced(photos: Path, tmp_path: Path) -> None:
    with open_workspace(tmp_path / "out") as opened:
        opened.claim("points")
        opened.write_results({"mesh.ply": lambda path: path.write_text("a mesh")})
    with pytest.raises(ReconstructionError, match="fitted to points"):
        up_to_the_cameras(job_of(photos))
    assert (tmp_path / "out/mesh.ply").read_text() == "a mesh"


def test_one_photograph_more_goes_into_the_same_folder(photos: Path) -> None:
    """As the program advises where there were too few."""
    up_to_the_cameras(job_of(photos))
    Image.fromarray(np.full((4, 6, 3), 222, np.uint8)).save(photos / "3.png")
    assert len(up_to_the_cameras(job_of(photos))) == 4


def test_space_is_asked_for_by_photographs_their_size_and_what_is_to_come(
    photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(
        pipeline, "check_free_space", lambda _folder, needed_bytes: asked.append(needed_bytes)
    )

    def more_files() -> None:
        for index in range(50):
            (photos / f"{index}.xmp").touch()

    kept_after(job_of(photos), more_files)
    cut_out = pipeline.STAGE_NAMES
    all_stages = tuple(name for name in cut_out if name != "cutout")
    first, second = asked
    assert first == pipeline._needed_bytes(3, all_stages, SETTINGS)
    assert second == pipeline._needed_bytes(3, all_stages[1:], SETTINGS) < first
    assert first < pipeline._needed_bytes(3, cut_out, SETTINGS)
    assert first < pipeline._needed_bytes(3, all_stages, PRESETS["detailed"])
    assert pipeline._needed_bytes(20, ("report",), SETTINGS) == pipeline._BYTES_FOR_RESULTS


@pytest.mark.parametrize(("seed", "fits"), [(0, True), (1, False)])
def test_cameras_do_not_come_to_stand_beside_a_mesh_of_others(photos: Path, seed: int, fits: bool) -> None:
    job = job_of(photos, until="cameras")
    with open_workspace(job.output) as opened:
        files = pipeline._files(job)
        frame = pipeline.stage_fingerprints(job, files, SETTINGS, "cpu")["cameras"]
        opened.claim("photographs", files.photo_contents.values())
        opened.write_results({"mesh.ply": lambda path: path.write_text("a mesh")}, frame=frame)
    job = job_of(photos, until="cameras", seed=seed)
    if fits:
        up_to_the_cameras(job)
        return
    with pytest.raises(ReconstructionError, match="would not fit it") as raised:
        up_to_the_cameras(job)
    assert raised.value.code is ErrorCode.OUTPUT_UNUSABLE
