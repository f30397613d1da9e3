"""A finished job rendered from given cameras: as a program, and what it refuses."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from backend.errors import Cancelled, ErrorCode, ReconstructionError
from backend.maths.raycast import render_mesh
from backend.mesh_files import read_mesh, write_mesh
from backend.records import save_record
from backend.rendering import render_job
from backend.results import RADIANCE
from backend.scene import SurfaceMesh, no_progress
from backend.stages.published.radiance_field import RadianceField, kept, restored
from backend.stages.published.radiance_image import radiance_image
from backend.stages.radiance import Radiance, RadianceShape
from backend.wire.client import clean_environment
from backend.wire.protocol import Finished, Hello, Stage, decode
from backend.wire.protocol import Progress as WireProgress
from backend.workspace import open_workspace
from tests.synthetic_scene import (
    Scene,
    photographed,
    ring_cameras,
    texture_srgb,
    true_mesh,
    true_region,
    write_scene,
)

ROOT = Path(__file__).resolve().parents[2]
SHAPE = RadianceShape(width=16, layers=2, proposal_width=8, proposal_intervals=8, intervals=6)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return photographed(ring_cameras(3, 40))


@pytest.fixture
def folder(scene: Scene, tmp_path: Path) -> Iterator[Path]:
    """With images/transforms.json, a job with a radiance field in `nerf`, one with a mesh in `surface`."""
    write_scene(scene, tmp_path)
    for image in (tmp_path / "images").glob("*.png"):
        image.unlink()
    (tmp_path / "nerf").mkdir()
    save_record(tmp_path / "nerf" / RADIANCE, radiance(), Radiance)
    (tmp_path / "surface").mkdir()
    body = true_mesh()
    mesh = SurfaceMesh(
        vertices=np.asarray(body.vertices),
        faces=np.asarray(body.faces, np.int64),
        normals=np.asarray(body.vertex_normals, np.float32),
        colours_srgb=np.round(255 * texture_srgb(np.asarray(body.vertices))).astype(np.uint8),
        support=np.ones(len(body.vertices), np.float32),
    )
    write_mesh(tmp_path / "surface" / "mesh.ply", mesh)
    deterministic = torch.are_deterministic_algorithms_enabled()
    yield tmp_path
    torch.use_deterministic_algorithms(deterministic)
    torch.set_flush_denormal(False)


def radiance() -> Radiance:
    return kept(RadianceField(SHAPE, torch.Generator().manual_seed(0)), true_region(), None)


def rendered(folder: Path, job: str, output: str = "pictures") -> tuple[str, ...]:
    cameras = folder / "images" / "transforms.json"
    return render_job(folder / job, cameras, folder / output, "cpu", no_progress)


def program(
    command: str, subject: Path, folder: Path, *more: str, output: Path
) -> "subprocess.CompletedProcess[str]":
    """The command as a user starts it, with the folder's cameras."""
    options = ["--cameras", str(folder / "images" / "transforms.json"), "--output", str(output)]
    result = subprocess.run(
        [sys.executable, "-m", "backend", command, str(subject), *options, "--device", "cpu", *more],
        cwd=ROOT,
        env={**clean_environment(os.environ), "OMP_NUM_THREADS": "1"},
        timeout=300,
        check=False,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    return result


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as file:
        return np.asarray(file).astype(int)


def refusal(folder: Path, job: str = "nerf", output: str = "pictures") -> ReconstructionError:
    with pytest.raises(ReconstructionError) as found:
        rendered(folder, job, output)
    return found.value


def test_the_program_renders_a_radiance_field(folder: Path, scene: Scene) -> None:
    """No photograph is there, only the cameras."""
    result = program("render", folder / "nerf", folder, output=folder / "pictures")
    names = [f"view_{index:02d}.png" for index in range(3)]
    assert result.stdout.split() == [str(folder / "pictures" / name) for name in names]
    assert "[1/1] render done" in result.stderr
    field, device = restored(radiance(), torch.device("cpu")), torch.device("cpu")
    for name, camera in zip(names, scene.cameras, strict=True):
        image = radiance_image(field, radiance(), camera, device=device, progress=no_progress)
        found = pixels(folder / "pictures" / name)
        assert found.shape == (camera.height, camera.width, 4)
        np.testing.assert_allclose(found[..., 3], 255 * image.opacity, atol=0.51)
        seen = found[..., 3] > 127
        assert seen.any()
        before_black = found[..., :3] / 255 * image.opacity[..., None]
        np.testing.assert_allclose(before_black[seen], image.colour_srgb[seen], atol=4 / 255)


def test_a_learned_background_is_in_the_picture(folder: Path) -> None:
    green = replace(radiance(), background_srgb=np.array([0, 1, 0], np.float32))
    save_record(folder / "nerf" / RADIANCE, green, Radiance)
    rendered(folder, "nerf")
    found = pixels(folder / "pictures" / "view_00.png")
    assert found.shape[2] == 3
    assert found[0, 0].tolist() == [0, 255, 0]


def test_a_job_without_a_field_gives_pictures_of_its_mesh(folder: Path, scene: Scene) -> None:
    assert rendered(folder, "surface") == ("view_00.png", "view_01.png", "view_02.png")
    found = pixels(folder / "pictures" / "view_01.png")
    expected = render_mesh(read_mesh(folder / "surface" / "mesh.ply"), scene.cameras[1])
    assert ((found[..., 3] == 255) == expected.coverage).all()
    np.testing.assert_allclose(found[..., :3], 255 * expected.colour_srgb, atol=0.51)


def test_rendered_again_the_pictures_are_replaced_but_strangers_are_left_alone(folder: Path) -> None:
    rendered(folder, "surface")
    before = pixels(folder / "pictures" / "view_00.png")
    rendered(folder, "nerf")
    assert (pixels(folder / "pictures" / "view_00.png") != before).any()
    (folder / "strange").mkdir()
    (folder / "strange" / "letter.txt").write_text("mine")
    error = refusal(folder, output="strange")
    assert error.code is ErrorCode.OUTPUT_UNUSABLE
    assert [path.name for path in (folder / "strange").iterdir()] == ["letter.txt"]


def test_rendered_from_fewer_cameras_earlier_pictures_are_gone(folder: Path) -> None:
    """Ours, not what somebody has put beside them."""
    rendered(folder, "surface")
    (folder / "pictures" / "mine.png").write_bytes(b"mine")
    named(folder, "view_00", "other")
    assert rendered(folder, "surface") == ("view_00.png", "other.png")
    found = sorted(path.name for path in (folder / "pictures").glob("*.png"))
    assert found == ["mine.png", "other.png", "view_00.png"]


def test_a_job_s_own_folder_gets_no_pictures(folder: Path) -> None:
    (folder / "nerf" / "cameras.json").write_text("{}")
    error = refusal(folder, output="nerf")
    assert error.code is ErrorCode.OUTPUT_UNUSABLE
    assert "results of a reconstruction" in error.text
    with open_workspace(folder / "points") as workspace:
        workspace.claim("points")
    assert "fitted to points" in refusal(folder, output="points").text


def test_what_is_no_job_is_told(folder: Path) -> None:
    error = refusal(folder, job="images")
    assert error.code is ErrorCode.SETTINGS_INVALID
    assert "neither radiance.npz nor mesh.ply" in error.text
    (folder / "nerf" / RADIANCE).write_bytes(b"PK damaged")
    assert "cannot be read" in refusal(folder).text
    (folder / "surface" / "mesh.ply").write_bytes(b"ply damaged")
    assert "cannot be read" in refusal(folder, job="surface").text
    assert not (folder / "pictures").exists()


def test_two_frames_of_one_name_are_refused(folder: Path) -> None:
    path = folder / "images" / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"][1]["file_path"] = "elsewhere/view_00.png"
    path.write_text(json.dumps(content))
    error = refusal(folder)
    assert error.code is ErrorCode.CAMERAS_UNUSABLE
    assert "view_00.png" in error.text


def named(folder: Path, *names: str) -> None:
    """The frames get these names."""
    path = folder / "images" / "transforms.json"
    content = json.loads(path.read_text())
    content["frames"] = [{**f, "file_path": n} for f, n in zip(content["frames"], names, strict=False)]
    path.write_text(json.dumps(content))


def test_a_number_behind_a_dot_belongs_to_the_name(folder: Path) -> None:
    """As in the names of sequences, which many write without what they are written as."""
    named(folder, "train/frame.0001", "train/frame.0002", "0.5.jpeg")
    assert rendered(folder, "surface") == ("frame.0001.png", "frame.0002.png", "0.5.png")


@pytest.mark.parametrize("name", ["", ".", "..", "a\0b", "x" * 300, "\ud800"])
def test_a_name_that_no_file_can_have_is_told(name: str, folder: Path) -> None:
    named(folder, "a", name)
    error = refusal(folder, job="surface")
    assert error.code is ErrorCode.CAMERAS_UNUSABLE
    assert "No picture can be named" in error.text


def test_a_file_without_cameras_is_told(folder: Path) -> None:
    named(folder)
    error = refusal(folder, job="surface")
    assert error.code is ErrorCode.CAMERAS_UNUSABLE
    assert error.text == "transforms.json holds no cameras."


def test_stopped_nothing_is_left(folder: Path) -> None:
    told: list[float] = []

    def listen(fraction: float, _text: str) -> None:
        told.append(fraction)
        if fraction > 0.3:
            raise Cancelled

    with pytest.raises(Cancelled):
        render_job(folder / "nerf", folder / "images" / "transforms.json", folder / "pictures", "cpu", listen)
    assert told == sorted(told)
    assert not (folder / "pictures").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
def test_a_reader_that_has_seen_enough_is_no_failure(folder: Path) -> None:
    """As in `| head -1`: the pictures are there all the same."""
    reader, writer = os.pipe()
    os.close(reader)
    options = ["--cameras", folder / "images" / "transforms.json", "--output", folder / "pictures"]
    program = [sys.executable, "-m", "backend", "render", folder / "surface", *options]
    run = subprocess.run(program, cwd=ROOT, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert run.returncode == 0, run.stderr
    assert "Broken" not in run.stderr
    assert (folder / "pictures" / "view_00.png").is_file()


@pytest.mark.skipif(sys.platform == "win32", reason="descriptors of POSIX")
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_streams_that_are_closed_are_no_failure(folder: Path, closed: str) -> None:
    options = ["--cameras", folder / "images" / "transforms.json", "--output", folder / "pictures"]
    program = [sys.executable, "-m", "backend", "render", folder / "surface", *options]
    run = subprocess.run(
        ["sh", "-c", f'"$@" {closed}', "sh", *program], cwd=ROOT, capture_output=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert b"rror" not in run.stderr
    assert sorted(path.name for path in (folder / "pictures").glob("*.png"))[0] == "view_00.png"


def test_on_the_wire_it_names_its_pictures(folder: Path) -> None:
    options = ["--cameras", folder / "images" / "transforms.json", "--output", folder / "pictures", "--wire"]
    with subprocess.Popen(
        [sys.executable, "-m", "backend", "render", folder / "surface", *options],
        cwd=ROOT,
        stdin=subprocess.PIPE,  # its end would stop the program
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        assert process.stdout is not None
        said = [decode(line) for line in process.stdout]
    assert process.returncode == 0
    assert isinstance(said[0], Hello)
    assert [message for message in said if isinstance(message, Stage)] == [
        Stage(name="render", index=1, count=1)
    ]
    shares = [message.fraction for message in said if isinstance(message, WireProgress)]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    names = tuple(f"view_{index:02d}.png" for index in range(3))
    assert said[-1] == Finished(output=str(folder / "pictures"), files=names)
    assert all((folder / "pictures" / name).is_file() for name in names)


@pytest.mark.slow
def test_from_photographs_to_a_field_and_from_it_to_pictures(tmp_path: Path) -> None:
    """In six seconds of fitting little is learned, but all is there, and a second run takes it up.

    (In two it is a foam of a million faces, which takes longer than the rest.)
    """
    write_scene(photographed(ring_cameras(6, 48)), tmp_path)
    words = ("--preset", "nerf", "--budget-seconds", "6")
    first = program("reconstruct", tmp_path / "images", tmp_path, *words, output=tmp_path / "job")
    assert str(tmp_path / "job" / RADIANCE) in first.stdout.split()
    report = json.loads((tmp_path / "job" / "report.json").read_text())
    assert report["num_stereo_points"] == 0
    said = {decision["what"]: decision["because"] for decision in report["decisions"]}
    assert said["field"] == "6 s given"
    assert "a density has no surface of its own" in said["surface"]
    again = program("reconstruct", tmp_path / "images", tmp_path, *words, output=tmp_path / "job")
    assert "Resuming: photos, cameras, region, stereo, train, mesh are done" in again.stderr
    program("render", tmp_path / "job", tmp_path, output=tmp_path / "pictures")
    assert pixels(tmp_path / "pictures" / "view_05.png").shape == (36, 48, 4)
