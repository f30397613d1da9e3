"""The stereo stage: photographs matched, once more where their cameras were off, and without the ground."""

from dataclasses import replace
from functools import partial

import torch

from ...scene import Progress, Region, SolvedCameras, StereoResult
from .camera_refinement import find_patches, misplaced_px, refine_cameras, with_cameras, with_refined
from .config import StereoConfig
from .ground import told_of_ground, without_ground
from .multi_view_stereo import match_views, unmatched


def match_solved(
    solved: SolvedCameras,
    region: Region,
    config: StereoConfig | None,
    *,
    device: torch.device,
    progress: Progress,
) -> StereoResult:
    """Stereo of the photographs; where their cameras were estimated and turn out to be off, once more.

    Given cameras are taken at their word, but held against the surface as well. Without a config nothing is
    compared: what is fitted does not ask.
    Raises what `match_views` does.
    """
    if config is None:
        return unmatched(solved.views)
    work = partial(match_views, region=region, config=config, device=device)
    found = work(solved.views, progress=progress)
    if solved.estimated:
        refined = refine_cameras(solved.views, region, found.points, device=device)
        if refined.cameras is not None:
            views = with_cameras(solved.views, refined.cameras)
            found = work(views, progress=lambda share, text: progress(share, f"{text}, again"))
        decisions = (*found.decisions, refined.decision)
        found = replace(found, refined_cameras=refined.cameras, decisions=decisions)
    else:
        with torch.no_grad():
            seen = find_patches(solved.views, region, found.points, device=device)
        beside_lines_px = misplaced_px([view.camera for view in solved.views], seen)
        found = replace(found, beside_lines_px=beside_lines_px)
    views = with_refined(solved, found).views
    if not config.without_ground:
        return told_of_ground(found, views, region)
    return without_ground(found, views, region, config, progress=progress)
