"""What a benchmark runs on: cases as data.

Standard library only: Blender's Python reads it to render the scenes.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from ..wire.photographs import photographs_in


@dataclass(frozen=True, kw_only=True)
class Rendering:
    """How blender_scenes.render_views makes a case's folder."""

    scene: str
    """A name that it knows, or the path of a mesh file under the folder of shared data."""
    words: tuple[str, ...]
    """Its other options."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """One set of photographs, some given and some held out; paths are relative to the case's folder."""

    name: str
    """Unique in a suite."""
    folder: str
    """Under the folder of rendered scenes or, without a rendering, that of photo sets."""
    given: tuple[int, ...]
    """Which images are reconstructed from, counted in the order of their names."""
    held_out: tuple[int, ...] = ()
    """Which images the mesh is compared with and nothing else; none, or at least two with cameras."""
    images: str = "images"
    cameras: str | None = "transforms.json"
    """None where they are to be estimated."""
    masks: str | None = None
    truth: str | None = None
    surroundings: str | None = None
    """The true mesh of what is in the pictures beside the subject; not part of `truth`."""
    without_ground: bool = False
    """Reconstructed so; then the whole mesh counts, against the subject alone."""
    rendering: Rendering | None = None
    """None for real photographs."""

    @property
    def files(self) -> tuple[str, ...]:
        """All that is read beside the images."""
        named = (self.cameras, self.masks, self.truth, self.surroundings)
        return tuple(name for name in named if name is not None)

    def __post_init__(self) -> None:
        if set(self.given) & set(self.held_out):
            raise ValueError(f"{self.name}: images are both given and held out")
        if self.held_out and (self.cameras is None or len(self.held_out) < 2):
            raise ValueError(f"{self.name}: held-out images need known cameras, and there must be two")
        if self.surroundings is not None and (self.truth is None or self.cameras is None):
            raise ValueError(f"{self.name}: surroundings need a truth to be told from, and known cameras")


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Cases that are measured together."""

    name: str
    cases: tuple[Case, ...]


@dataclass(frozen=True, kw_only=True)
class Found:
    """A suite's cases on this machine."""

    cases: tuple[tuple[Case, Path], ...]
    """Each with its folder."""
    missing: tuple[str, ...]
    """Names of those whose files are not there."""


def find_cases(suite: Suite, scenes: Path | None, photos: Path | None) -> Found:
    """The suite's cases that are in the folder of rendered scenes or in that of photo sets."""
    here: list[tuple[Case, Path]] = []
    missing: list[str] = []
    for case in suite.cases:
        root = photos if case.rendering is None else scenes
        if root is not None and _is_complete(case, root / case.folder):
            here.append((case, root / case.folder))
        else:
            missing.append(case.name)
    return Found(cases=tuple(here), missing=tuple(missing))


def image_paths(case: Case, folder: Path, indices: tuple[int, ...]) -> tuple[Path, ...]:
    """The images with these numbers; IndexError where there are fewer."""
    images = _all_images(case, folder)
    return tuple(images[index] for index in indices)


def with_budget(preset: str, budget_s: float | None) -> str:
    """As tables show it: `balanced`, or `balanced@10s`."""
    return preset if budget_s is None else f"{preset}@{budget_s:g}s"


def _all_images(case: Case, folder: Path) -> list[Path]:
    return sorted(photographs_in(folder / case.images))


def _is_complete(case: Case, folder: Path) -> bool:
    if not (folder / case.images).is_dir() or not all((folder / name).exists() for name in case.files):
        return False
    return len(_all_images(case, folder)) > max(case.given + case.held_out)


def rendered_case(
    scene: str,
    num_given: int,
    *,
    name: str | None = None,
    words: tuple[str, ...] = (),
    surroundings: str | None = None,
    hold_out: bool = True,
) -> Case:
    """Views along an arc (3 over 40 degrees, 6 over 120) or a ring, and between them any held out."""
    is_ring, step = num_given > 6, 2 if hold_out else 1
    total = step * num_given if is_ring else step * (num_given - 1) + 1
    arc_deg = "40" if num_given <= 3 else "120"
    layout = ("--layout", "ring") if is_ring else ("--layout", "arc", "--arc-deg", arc_deg)
    full_name = f"{name or scene}_{num_given}"
    return Case(
        name=full_name,
        folder=full_name,
        given=tuple(range(0, total, step)),
        held_out=tuple(range(1, total, step)) if hold_out else (),
        truth="truth.ply",
        surroundings=surroundings,
        rendering=Rendering(scene=scene, words=("--views", str(total), *layout, *words)),
    )


_SCENES = ("monkey", "glossy", "plaster", "thin", "genus2", "spots", "house")
_MESHES = (
    # The cow looks the other way and is nearly white.
    ("cow", "mesh_spot/spot.obj", ("--turn-deg", "180", "--exposure-stops", "-0.6")),
    ("duck", "mesh_bob/bob_tri.obj", ()),
    # The next two would show their ends.
    ("bottle", "mesh_fuze/fuze.obj", ("--turn-deg", "90")),
    ("rocker", "mesh_untextured/rocker-arm.obj", ("--turn-deg", "90", "--surface", "plain")),
    ("avocado", "mesh_avocado/Avocado.gltf", ()),
    # Its back is flat.
    ("fandisk", "mesh_untextured/fandisk.obj", ("--turn-deg", "180", "--surface", "fine")),
    ("toy", "mesh_untextured/cheburashka.obj", ("--surface", "spots")),
)
_NUM_VIEWS = (3, 6, 12)

_FINE, _OWN = ("--surface", "fine"), ()
_SIDES = (
    ("cow_fine", "mesh_spot/spot.obj", _FINE),
    ("duck_fine", "mesh_bob/bob_tri.obj", _FINE),
    ("toy_fine", "mesh_untextured/cheburashka.obj", _FINE),
    ("rocker_fine", "mesh_untextured/rocker-arm.obj", _FINE),
    ("bottle_fine", "mesh_fuze/fuze.obj", _FINE),
    ("fandisk_fine", "mesh_untextured/fandisk.obj", _FINE),
    ("cow", "mesh_spot/spot.obj", ("--exposure-stops", "-0.6")),
    ("duck", "mesh_bob/bob_tri.obj", _OWN),
    ("toy", "mesh_untextured/cheburashka.obj", ("--surface", "spots")),
)
"""The first six with fine texture, the others painted."""
_TURNS_DEG = (0, 60, 120, 180)

_SIMULATED = "cloud_points2surf_abc"
_PARTS = (
    ("flange", f"{_SIMULATED}/00011084_gt.ply"),
    ("clamp", f"{_SIMULATED}/00016513_gt.ply"),
    ("plate", f"{_SIMULATED}/00994122_gt.ply"),
)
"""Parts of machines: flat faces, sharp edges, bores. No number was chosen by them before 2026-11-27."""
_PART_SURFACES = (("fine", 3), ("fine", 6), ("plain", 6))
"""And how many views."""

_DTU, _TEMPLE, _WALNUT = "photos_dtu_scan118_3view", "photos_temple_sparse_ring", "photos_robovision_1"
_FOUNTAIN, _BANANA, _BERLIN = "photos_fountain_p11", "photos_banana", "photos_berlin3"
_OLD = "photos_kermit_et"

_PHOTO_CASES = (
    Case(name="statuette_3_masks", folder=_DTU, given=(0, 1, 2), images="image", masks="mask"),
    # Its ring is numbered out of order: these are 23 degrees apart, those held out lie beyond either end.
    Case(name="temple_6", folder=_TEMPLE, given=(0, 5, 6, 7, 8, 9), held_out=(1, 14)),
    Case(
        name="temple_14",
        folder=_TEMPLE,
        given=(*range(6), 7, *range(9, 16)),
        held_out=(6, 8),
    ),
    # 30 degrees apart: between them there is none to hold out, so those beyond either end are.
    Case(name="walnut_3", folder=_WALNUT, given=(0, 1, 2), held_out=(3, 11), truth="reference.ply"),
    Case(name="walnut_6", folder=_WALNUT, given=tuple(range(6)), held_out=(6, 11), truth="reference.ply"),
    Case(name="walnut_12", folder=_WALNUT, given=tuple(range(12)), truth="reference.ply"),
    # Dark and of little texture: the usual features find no cameras.
    Case(name="walnut_3_cameras_unknown", folder=_WALNUT, given=(0, 1, 2), cameras=None),
    Case(name="fountain_3", folder=_FOUNTAIN, given=(3, 5, 7), held_out=(4, 6)),
    Case(name="fountain_3_cameras_unknown", folder=_FOUNTAIN, given=(3, 4, 5), cameras=None),
    Case(name="fountain_11_cameras_unknown", folder=_FOUNTAIN, given=tuple(range(11)), cameras=None),
    Case(name="banana_6_cameras_unknown", folder=_BANANA, given=tuple(range(6)), cameras=None),
    Case(name="portal_3_cameras_unknown", folder=_BERLIN, given=(0, 1, 2), cameras=None),
    Case(name="frog_11_cameras_unknown", folder=_OLD, given=tuple(range(11)), images="kermit", cameras=None),
    Case(name="et_9_cameras_unknown", folder=_OLD, given=tuple(range(9)), images="ET", cameras=None),
)

SUITES = MappingProxyType(
    {
        suite.name: suite
        for suite in (
            Suite(name="quick", cases=(rendered_case("monkey", 3), rendered_case("plaster", 6))),
            Suite(
                name="scenes",
                cases=(
                    *(rendered_case(scene, count) for scene in _SCENES for count in _NUM_VIEWS),
                    *(rendered_case("table", n, surroundings="surroundings.ply") for n in _NUM_VIEWS),
                    *(
                        replace(rendered_case("table", n), name=f"table_alone_{n}", without_ground=True)
                        for n in _NUM_VIEWS
                    ),
                    *(
                        rendered_case(path, count, name=name, words=words)
                        for name, path, words in _MESHES
                        for count in _NUM_VIEWS
                    ),
                ),
            ),
            Suite(
                name="sides",
                cases=tuple(
                    rendered_case(
                        scene,
                        3,
                        name=f"{name}_{turn_deg}",
                        words=("--turn-deg", str(turn_deg), *words),
                        hold_out=False,
                    )
                    for name, scene, words in _SIDES
                    for turn_deg in _TURNS_DEG
                ),
            ),
            Suite(
                name="parts",
                cases=tuple(
                    rendered_case(mesh, count, name=f"{part}_{surface}", words=("--surface", surface))
                    for part, mesh in _PARTS
                    for surface, count in _PART_SURFACES
                ),
            ),
            Suite(name="photos", cases=_PHOTO_CASES),
        )
    }
)
"""By name."""

CASES = MappingProxyType({case.name: case for suite in SUITES.values() for case in suite.cases})
"""All of them, by name."""
