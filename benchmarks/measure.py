"""Speed against error: every case with every preset, as one Markdown table.

    python benchmarks/measure.py --scenes build/benchmark/scenes --output build/benchmark [--photos FOLDER]

A scene is a folder that blender_scenes.render_views wrote (images, transforms.json, truth.ply). With
--photos, the sets of real photographs that are found there are measured too.
"""

import argparse
import json
import logging
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

logger = logging.getLogger(__name__)
COLUMNS = (
    "case | preset | cameras s | stereo s | field s | mesh s | memory GB | Chamfer visible % | whole % | "
    "F@1% visible | normals | PSNR dB"
)


@dataclass(frozen=True, kw_only=True)
class Case:
    """One set of photographs, as words of the command line."""

    name: str
    words: tuple[str, ...]


def scene_cases(folder: Path) -> list[Case]:
    """The rendered scenes in a folder."""
    return [
        Case(
            name=scene.name,
            words=(
                *(str(scene / "images"), "--cameras", str(scene / "transforms.json")),
                *("--truth", str(scene / "truth.ply")),
            ),
        )
        for scene in sorted(folder.iterdir())
        if (scene / "truth.ply").is_file()
    ]


def photo_cases(folder: Path) -> list[Case]:
    """The sets of real photographs that are there."""

    def files(name: str, pattern: str, first: int, last: int) -> tuple[str, ...]:
        return tuple(str(path) for path in sorted((folder / name).glob(pattern))[first:last])

    def known(name: str, photos: tuple[str, ...], *more: str) -> tuple[str, ...]:
        return (*photos, "--cameras", str(folder / name / "transforms.json"), *more)

    dtu, temple, walnut = "photos_dtu_scan118_3view", "photos_temple_sparse_ring", "photos_robovision_1"
    fountain, banana, berlin = "photos_fountain_p11", "photos_banana", "photos_berlin3"
    masks = ("--masks", str(folder / dtu / "mask"))
    reference = ("--truth", str(folder / walnut / "reference.ply"))
    found = [
        (dtu, "statuette, 3, masks", known(dtu, files(dtu, "image/*.png", 0, 3), *masks)),
        (
            temple,
            "temple, 6",
            known(temple, (*files(temple, "images/*.png", 5, 10), *files(temple, "images/*.png", 0, 1))),
        ),
        (walnut, "walnut, 6", known(walnut, files(walnut, "images/*.png", 0, 6), *reference)),
        (fountain, "fountain, 3, cameras unknown", files(fountain, "images/*.jpg", 3, 6)),
        (fountain, "fountain, 11, cameras unknown", files(fountain, "images/*.jpg", 0, 11)),
        (banana, "banana, 6, cameras unknown", files(banana, "images/*.JPG", 0, 6)),
        (berlin, "portal, 3, cameras unknown", files(berlin, "images/*.jpg", 0, 3)),
    ]
    return [Case(name=name, words=words) for subfolder, name, words in found if (folder / subfolder).is_dir()]


def measured(case: Case, preset: str, output: Path) -> str:
    """One line of the table; the run is done from nothing."""
    shutil.rmtree(output, ignore_errors=True)
    command = [sys.executable, "-m", "backend", "reconstruct", *case.words, "--preset", preset]
    done = subprocess.run([*command, "--output", str(output)], capture_output=True, text=True, check=False)
    if done.returncode:
        return f"| {case.name} | {preset} | failed: {done.stderr.strip().splitlines()[-1]} |" + " |" * 9
    report = json.loads((output / "report.json").read_text())
    seconds = {stage["name"]: stage["seconds"] for stage in report["stages"]}
    error = report.get("error") or {}
    visible, whole = error.get("visible") or {}, error.get("whole") or {}
    times = " | ".join(f"{seconds[name]:.1f}" for name in ("cameras", "stereo", "train", "mesh"))
    numbers = [
        f"{report['peak_memory_bytes'] / 1e9:.2f}",
        _number(visible.get("chamfer_percent"), 3),
        _number(whole.get("chamfer_percent"), 3),
        _number(visible.get("f_score_at_one_percent"), 3),
        _number(visible.get("normal_consistency"), 3),
        _number(report["mean_psnr_db"], 1),
    ]
    return f"| {case.name} | {preset} | {times} | {' | '.join(numbers)} |"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def main() -> int:
    """Measure, and leave the table in OUTPUT/table.md."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--presets", nargs="+", default=["fast", "balanced"])
    words = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    cases = scene_cases(words.scenes) + (photo_cases(words.photos) if words.photos else [])
    lines = [f"| {COLUMNS} |", "|" + "---|" * (COLUMNS.count("|") + 1)]
    for case in cases:
        for preset in words.presets:
            name = f"{case.name}-{preset}".replace(" ", "_").replace(",", "")
            lines.append(measured(case, preset, words.output / "runs" / name))
            logger.info("%s", lines[-1])
    (words.output / "table.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
