"""Renders sparse views of a scene with exact cameras and the true mesh.

    python -m blender_scenes.render_views --scene monkey --views 6 --output DIR
    blender --background --python blender_scenes/render_views.py -- --scene monkey --views 6 --output DIR

Writes images/NNN.png, transforms.json (as nerfstudio), truth.ply, scene.json, with `--passes` also
depth/NNN.npy and normals/NNN.npy. The same arguments give the same bytes.
"""

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

if not __package__:  # started by `blender --python`, which knows the file and not the package
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from addon.view_layout import LayoutKind, Lens, ViewLayout, place_cameras
from blender_scenes.lighting import light_scene
from blender_scenes.rendering import SENSOR_WIDTH_MM, add_camera, render_view, set_up_cycles
from blender_scenes.scenes import OWN_SURFACE, SCENES, BuiltScene, build_from_file, build_scene
from blender_scenes.surfaces import SURFACES
from blender_scenes.truth import bounding_sphere, depth_and_normals, ray_caster, true_mesh, write_ply

MESH_PREFIX = "mesh:"
log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RenderJob:
    """Everything that decides what is rendered."""

    scene: str
    """A name from SCENES, or mesh:PATH."""
    surface: str
    """Of a mesh file: its own, or a name from SURFACES."""
    turn_deg: float
    """Of a mesh file: about the vertical, to bring its front to the light, on -y."""
    layout: ViewLayout
    lens: Lens
    samples: int
    exposure_stops: float
    """Brightness of the picture, in powers of two; below 0 for models that are nearly white."""
    seed: int
    passes: bool


def render_views(job: RenderJob, output: Path) -> None:
    """Builds the scene in an emptied Blender, renders it and writes the folder.

    Raises ValueError where the scene or the mesh file cannot be used.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    built = _build(job)
    subject = true_mesh(built.subjects)
    centre, radius = bounding_sphere(subject)
    framed = centre + built.framing * (subject.vertices - centre)
    poses = place_cameras(job.layout, job.lens, points=framed)
    for folder in ("images", *(("depth", "normals") if job.passes else ())):
        (output / folder).mkdir(parents=True, exist_ok=True)
    write_ply(output / "truth.ply", subject)
    if built.surroundings:
        write_ply(output / "surroundings.ply", true_mesh(built.surroundings))
    _write_json(output / "transforms.json", transforms(job.lens, poses))
    _write_json(output / "scene.json", _description(job, centre=centre, radius=radius))
    light_scene(centre=centre, radius=radius)
    set_up_cycles(
        job.lens,
        samples=job.samples,
        exposure_stops=job.exposure_stops,
        transparent=not built.surroundings,
    )
    camera = add_camera(job.lens, distance=float(np.linalg.norm(poses[0, :3, 3] - centre)))
    for index, pose in enumerate(poses):
        path = output / "images" / f"{index:03d}.png"
        render_view(path, camera, pose, noise_seed=1000 * job.seed + index)
        log.info("view %d of %d: %s", index + 1, len(poses), path)
    if job.passes:
        _write_passes(job.lens, built, poses, output)


def transforms(lens: Lens, poses: NDArray[np.float64]) -> dict[str, Any]:
    """The cameras as nerfstudio writes them; poses are (views, 4, 4) world_from_camera, OpenGL axes."""
    return {
        "camera_model": "PINHOLE",
        "w": lens.width,
        "h": lens.height,
        "fl_x": lens.focal_px,
        "fl_y": lens.focal_px,
        "cx": lens.width / 2,
        "cy": lens.height / 2,
        "frames": [
            {"file_path": f"images/{index:03d}.png", "transform_matrix": pose.tolist()}
            for index, pose in enumerate(poses)
        ],
    }


def _build(job: RenderJob) -> BuiltScene:
    if job.scene.startswith(MESH_PREFIX):
        path = Path(job.scene.removeprefix(MESH_PREFIX))
        return build_from_file(path, turn_deg=job.turn_deg, surface_name=job.surface, seed=job.seed)
    return build_scene(SCENES[job.scene](job.scene, job.seed))


def _write_passes(lens: Lens, built: BuiltScene, poses: NDArray[np.float64], output: Path) -> None:
    tree = ray_caster(true_mesh(built.subjects + built.surroundings))
    for index, pose in enumerate(poses):
        depth, normals = depth_and_normals(tree, lens, pose)
        np.save(output / "depth" / f"{index:03d}.npy", depth)
        np.save(output / "normals" / f"{index:03d}.npy", normals)


def _description(job: RenderJob, *, centre: NDArray[np.float64], radius: float) -> dict[str, Any]:
    """What was rendered; of a mesh file the name alone, so that the folder can move to another machine."""
    facts = asdict(job)
    if job.scene.startswith(MESH_PREFIX):
        facts["scene"] = MESH_PREFIX + Path(job.scene.removeprefix(MESH_PREFIX)).name
    bounds = {"centre_m": centre.tolist(), "radius_m": radius}
    return {**facts, "bounding_sphere": bounds, "blender": bpy.app.version_string}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _scene_name(text: str) -> str:
    """An argument type: a known scene or an existing mesh file."""
    if text.startswith(MESH_PREFIX):
        if not Path(text.removeprefix(MESH_PREFIX)).is_file():
            raise argparse.ArgumentTypeError(f"there is no mesh file {text.removeprefix(MESH_PREFIX)}")
    elif text not in SCENES:
        raise argparse.ArgumentTypeError(f"unknown scene {text!r}; known: {', '.join(SCENES)}, mesh:PATH")
    return text


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="render_views", description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--scene", type=_scene_name, required=True, help=f"{', '.join(SCENES)}, or mesh:PATH")
    add("--surface", choices=(OWN_SURFACE, *SURFACES), default=OWN_SURFACE, help="of a mesh file")
    add("--turn-deg", type=float, default=0.0, help="of a mesh file, to bring its front to -y, the light")
    add("--views", type=int, default=6)
    add("--layout", type=LayoutKind, choices=tuple(LayoutKind), default=LayoutKind.ARC)
    add("--arc-deg", type=float, default=120.0)
    add("--azimuth-deg", type=float, default=0.0, help="middle of the arc; 0 is the front, 90 the right")
    add("--elevation-deg", type=float, default=20.0)
    add("--jitter", type=float, default=1.0, help="irregularity of the cameras, 0 to 1")
    add("--seed", type=int, default=0)
    add("--width", type=int, default=800)
    add("--height", type=int, default=600)
    add("--focal-mm", type=float, default=50.0, help="for a picture 36 mm wide on its longer side")
    add("--samples", type=int, default=32)
    add("--exposure-stops", type=float, default=0.0, help="below 0 for models that are nearly white")
    add("--passes", action="store_true", help="depth and normals as well")
    add("--output", type=Path, required=True)
    return parser


def _job(arguments: argparse.Namespace) -> RenderJob:
    """Raises ValueError where the numbers make no sense."""
    if min(arguments.width, arguments.height, arguments.samples) < 1 or arguments.focal_mm <= 0:
        raise ValueError("width, height, samples and focal length must be positive")
    focal_px = arguments.focal_mm / SENSOR_WIDTH_MM * max(arguments.width, arguments.height)
    return RenderJob(
        scene=arguments.scene,
        surface=arguments.surface,
        turn_deg=arguments.turn_deg,
        layout=ViewLayout(
            kind=arguments.layout,
            num_views=arguments.views,
            arc_deg=arguments.arc_deg,
            azimuth_deg=arguments.azimuth_deg,
            elevation_deg=arguments.elevation_deg,
            jitter=arguments.jitter,
            seed=arguments.seed,
        ),
        lens=Lens(width=arguments.width, height=arguments.height, focal_px=focal_px),
        samples=arguments.samples,
        exposure_stops=arguments.exposure_stops,
        seed=arguments.seed,
        passes=arguments.passes,
    )


def main(words: Sequence[str]) -> int:
    """Exit code 0, or 2 with a sentence on stderr for arguments that cannot be used."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    parser = _parser()
    arguments = parser.parse_args(words)
    try:
        render_views(_job(arguments), arguments.output)
    except ValueError as error:
        parser.error(str(error))
    return 0


def own_words(command_line: Sequence[str]) -> list[str]:
    """The arguments meant for this program: after `--` where Blender was started, else all."""
    given = list(command_line[1:])
    return given[given.index("--") + 1 :] if "--" in given else given


if __name__ == "__main__":
    sys.exit(main(own_words(sys.argv)))
