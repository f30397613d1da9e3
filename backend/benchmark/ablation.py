"""What each part is worth: the stages after the cameras, with one part changed at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ..errors import ReconstructionError
from ..maths.metrics import TrueSurface, load_truth, surface_error
from ..presets import PRESETS, Settings
from ..scene import SurfaceMesh
from ..stages.report import error_numbers
from ..stages.stereo import StereoResult
from ..stages.stereo_config import StereoConfig
from .measuring import Measurement, flat_errors
from .one_by_one import Placed, extract, fit, match, place, surface_configs
from .suites import Case
from .summary import Column

PRESET = "balanced"
_NEXT_TO_NOTHING = 1e-6
"""For weights of the linear fit that replace the prior's: at 0 a node would have none, and no value."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """The preset with one part changed."""

    name: str
    setting: str | None = None
    """Its dotted name in Settings; None where none is changed."""
    value: object = None
    with_masks: bool = True
    """Without them the region stays the one that they gave."""

    def of(self, settings: Settings) -> Settings:
        """The settings with the change. Raises AttributeError or TypeError where there is no such setting."""
        if self.setting is None:
            return settings
        changed: Settings = _changed(settings, self.setting, self.value)
        return changed


VARIANTS = (
    Variant(name="as it is"),
    Variant(name="without growth", setting="stereo.growth_rounds", value=(0, 0, 0)),
    Variant(name="small pieces kept", setting="stereo.min_piece_px", value=0),
    Variant(name="without rims", setting="train.linear.rims", value=0.0),
    Variant(name="without the pull of silhouettes", setting="train.linear.silhouettes", value=0.0),
    Variant(
        name="without free space off silhouettes",
        setting="train.linear.free_space",
        value=_NEXT_TO_NOTHING,
    ),
    Variant(
        name="without carving by measured depth",
        setting="train.linear.seen_through",
        value=_NEXT_TO_NOTHING,
    ),
    Variant(name="five rounds of inequalities", setting="train.rounds", value=(5, 5, 5)),
    Variant(name="with 100 steps of rendering", setting="train.steps", value=(0, 0, 100)),
    Variant(name="full size alone", setting="stereo.trust_of_half_size", value=0.0),
    Variant(name="masks ignored", with_masks=False),
)

COLUMNS = (
    Column(heading="visible Chamfer %", number="visible_chamfer_percent", digits=3),
    Column(heading="visible F@1%", number="visible_f_score_at_one_percent", digits=3),
    Column(heading="visible normals", number="visible_normal_consistency", digits=3),
    Column(heading="whole Chamfer %", number="whole_chamfer_percent", digits=3),
    Column(heading="stereo s", number="stereo_s", digits=1),
    Column(heading="field s", number="train_s", digits=1),
    Column(heading="mesh s", number="mesh_s", digits=1),
)


def is_random(settings: Settings) -> bool:
    """Whether another seed gives another surface: only rendering draws by lot."""
    return any(surface_configs(settings)[1].steps)


def measure_variants(
    case: Case, folder: Path, variants: Sequence[Variant], *, num_seeds: int, device: torch.device
) -> Iterator[Measurement]:
    """Each variant on a case, once for each seed where it is random; its name stands for the preset's.

    A stereo result is used again where its settings are the same: then `stereo_s` is None. Raises
    ReconstructionError where the cameras or the region can not be found; what fails later is told in the
    measurement.
    """
    default = PRESETS[PRESET]
    placed = place(case, folder, case.given, default)
    truth = None if case.truth is None else load_truth(folder / case.truth)
    known: dict[tuple[StereoConfig, bool], StereoResult] = {}
    for variant in variants:
        settings = variant.of(default)
        shown = placed if variant.with_masks else placed.without_masks()
        for seed in range(num_seeds if is_random(settings) else 1):
            done = partial(Measurement, case=case.name, preset=variant.name, seed=seed, versions={})
            stereo_s: float | None = None
            key = (surface_configs(settings)[0], variant.with_masks)
            try:
                if key not in known:
                    known[key], stereo_s = match(shown, settings, device)
                surface, train_s = fit(shown, known[key], settings, seed=seed, device=device)
                mesh, mesh_s = extract(shown, known[key], surface, settings)
            except ReconstructionError as error:
                yield done(numbers={}, failure=error.text)
                continue
            numbers = {"stereo_s": stereo_s, "train_s": train_s, "mesh_s": mesh_s}
            yield done(numbers=numbers if truth is None else numbers | _errors(mesh, truth, shown, seed))


def _errors(mesh: SurfaceMesh, truth: TrueSurface, placed: Placed, seed: int) -> dict[str, float | None]:
    """As a report has them, by the names that a benchmark gives them."""
    cameras = [view.camera for view in placed.views]
    num_samples = PRESETS[PRESET].report.error_samples
    error = surface_error(mesh, truth, cameras=cameras, seed=seed, num_samples=num_samples)
    return flat_errors(error_numbers(error))


def _changed(settings: Any, name: str, value: object) -> Any:
    first, _, rest = name.partition(".")
    return replace(settings, **{first: _changed(getattr(settings, first), rest, value) if rest else value})
