"""The report of the cameras: what they rest on, how well they fit, and how sure each of them is.

`build_camera_report` measures, `camera_report_html` makes one page that needs nothing but itself,
`camera_report_numbers` the same facts for programs, with units in the keys.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64

from ...maths.angles import triangulation_angle_deg
from ...maths.sampling import mean_colours
from ...report_page.diagrams import Bar, histogram, match_graph, thumbnail, top_view
from ...report_page.template import filled
from ...scene import CameraEvidence, Region, SolvedCameras
from .confirmation import unconfirmed

WEAK_PAIR, STRONG_PAIR = 30, 100
"""Verified matches: with fewer than the first, a photograph is not placed by another at the first attempt;
with the second, two photographs may be the pair that all begins with."""

ANGLE_STEPS_DEG = (0, 2, 5, 10, 20, 30, 45, 60, 90, 180)
FLAT_ANGLE_DEG, GOOD_ANGLE_DEG = 2.0, 5.0
LARGE_ERROR_PX = 1.0
UNSURE_PLACE_PERCENT = 1.0
"""Of the subject's diameter."""


@dataclass(frozen=True, kw_only=True)
class PhotoFacts:
    """What is known of one photograph's camera; None where nothing is."""

    name: str
    why_unplaced: str | None = None
    """None where it was placed."""
    num_features: int | None = None
    most_verified: int | None = None
    """Verified matches with the photograph that it shares most with."""
    num_points: int | None = None
    """Sparse points seen."""
    median_error_px: float | None = None
    high_error_px: float | None = None
    """95 % of the features are nearer to their points."""
    turn_sigma_deg: float | None = None
    """Standard deviation of the orientation, about the axis where it is least sure."""
    place_sigma_percent: float | None = None
    """Standard deviation of the centre where it is least sure, of the region's diameter."""


@dataclass(frozen=True, kw_only=True)
class PairFacts:
    """Two photographs that share features."""

    one: int
    other: int
    """Places among the photographs."""
    num_matched: int
    num_verified: int


@dataclass(frozen=True, kw_only=True)
class CameraReport:
    """All that the page shows."""

    job_name: str
    seed: int
    versions: dict[str, str]
    solved: SolvedCameras
    region: Region
    photos: tuple[PhotoFacts, ...]
    """All that were given, in their order."""
    pairs: tuple[PairFacts, ...]
    """Those with verified matches, most first."""
    track_lengths: tuple[int, ...]
    """How many points are seen by exactly two photographs, three, ..."""
    angle_counts: tuple[int, ...]
    """Points by the widest angle of their rays, in the steps of ANGLE_STEPS_DEG."""
    median_angle_deg: float | None
    median_error_px: float | None
    point_sigma_percent: float | None
    """Median standard deviation of the points where they are least sure, of the region's diameter."""
    remarks: tuple[str, ...]
    """What is weak and what helps; empty where nothing is."""


def build_camera_report(
    solved: SolvedCameras, region: Region, *, job_name: str, seed: int, versions: dict[str, str]
) -> CameraReport:
    """Measure what the stage of the cameras found."""
    evidence, diameter = solved.evidence, 2 * region.radius_world
    angles_deg = point_angles_deg(solved)
    num_views = len(solved.views)
    lengths = np.bincount(solved.sparse_visibility.sum(axis=1), minlength=num_views + 1)[2:]
    counts, _ = np.histogram(angles_deg, ANGLE_STEPS_DEG)
    seen_errors = np.zeros(0) if evidence is None else evidence.error_px[solved.sparse_visibility]
    sigmas = None if evidence is None else evidence.point_sigma_world
    photos = _photos(solved, diameter)
    median_angle_deg = float(np.median(angles_deg)) if len(angles_deg) else None
    return CameraReport(
        job_name=job_name,
        seed=seed,
        versions=versions,
        solved=solved,
        region=region,
        photos=photos,
        pairs=() if evidence is None else _pairs(evidence),
        track_lengths=tuple(lengths.tolist()),
        angle_counts=tuple(counts.tolist()),
        median_angle_deg=median_angle_deg,
        median_error_px=float(np.median(seen_errors)) if len(seen_errors) else None,
        point_sigma_percent=None if sigmas is None else 100 * float(np.median(sigmas)) / diameter,
        remarks=_remarks(solved, photos, median_angle_deg),
    )


def point_angles_deg(solved: SolvedCameras) -> Float64[np.ndarray, "points"]:
    """For each sparse point, the widest angle between the rays to the cameras that see it."""
    centres = np.array([view.camera.position for view in solved.views])
    points = zip(solved.sparse_positions, solved.sparse_visibility, strict=True)
    angles = (triangulation_angle_deg(position, centres[seen]) for position, seen in points)
    return np.fromiter(angles, np.float64)


def _photos(solved: SolvedCameras, diameter: float) -> tuple[PhotoFacts, ...]:
    """In the order in which they were given, where that is known; else the unplaced ones last."""
    evidence = solved.evidence
    why = {photo.name: photo.why for photo in solved.unplaced}
    view_of = {view.name: index for index, view in enumerate(solved.views)}
    names = (*view_of, *why) if evidence is None else evidence.names
    photos = []
    for index, name in enumerate(names):
        facts = PhotoFacts(name=name, why_unplaced=why.get(name))
        if evidence is not None:
            facts = dataclasses.replace(
                facts,
                num_features=int(evidence.num_features[index]),
                most_verified=int(evidence.num_verified[index].max()),
            )
        view = view_of.get(name)
        if view is not None:
            facts = dataclasses.replace(facts, **_view_facts(solved, view, diameter))
        photos.append(facts)
    return tuple(photos)


def _view_facts(solved: SolvedCameras, view: int, diameter: float) -> dict[str, Any]:
    """Of a photograph that was placed."""
    evidence, seen = solved.evidence, solved.sparse_visibility[:, view]
    facts: dict[str, Any] = {"num_points": int(seen.sum())}
    if evidence is None:
        return facts
    if seen.any():
        middle, high = np.quantile(evidence.error_px[seen, view], [0.5, 0.95])
        facts |= {"median_error_px": float(middle), "high_error_px": float(high)}
    if evidence.pose_covariance is not None:
        covariance = evidence.pose_covariance[view]
        turn, place = (
            float(np.sqrt(np.linalg.eigvalsh(c)[-1])) for c in (covariance[:3, :3], covariance[3:, 3:])
        )
        facts |= {"turn_sigma_deg": float(np.degrees(turn)), "place_sigma_percent": 100 * place / diameter}
    return facts


def _pairs(evidence: CameraEvidence) -> tuple[PairFacts, ...]:
    found = [
        PairFacts(
            one=int(one),
            other=int(other),
            num_matched=int(evidence.num_matched[one, other]),
            num_verified=int(evidence.num_verified[one, other]),
        )
        for one, other in np.argwhere(np.triu(evidence.num_verified) > 0)
    ]
    return tuple(sorted(found, key=lambda pair: -pair.num_verified))


def _remarks(
    solved: SolvedCameras, photos: tuple[PhotoFacts, ...], median_angle_deg: float | None
) -> tuple[str, ...]:
    """What is weak, and what helps."""
    remarks = [f"{p.name} could not be placed: {p.why_unplaced}." for p in photos if p.why_unplaced]
    if doubt := unconfirmed(solved):
        remarks.append(doubt)
    placed = [photo for photo in photos if photo.why_unplaced is None]
    for photo in placed:
        if photo.most_verified is not None and photo.most_verified < STRONG_PAIR:
            remarks.append(
                f"{photo.name} hangs on few matches: {photo.most_verified} with its best partner. "
                "A photograph between the two would tie it down."
            )
        if photo.median_error_px is not None and photo.median_error_px > LARGE_ERROR_PX:
            remarks.append(
                f"{photo.name} fits to {photo.median_error_px:.1f} pixels only. "
                "It may be blurred, or something in it has moved."
            )
        if photo.place_sigma_percent is not None and photo.place_sigma_percent > UNSURE_PLACE_PERCENT:
            remarks.append(
                f"Where {photo.name} was taken is sure to {photo.place_sigma_percent:.1f} % of the subject. "
                "Texture around the subject, or a further photograph beside it, would help."
            )
    if median_angle_deg is not None and median_angle_deg < GOOD_ANGLE_DEG:
        remarks.append(
            f"The photographs are close together: half of the points are seen under less than "
            f"{median_angle_deg:.1f} degrees. A wider step aside between photographs makes depth surer."
        )
    return tuple(remarks)


def camera_report_html(report: CameraReport) -> str:
    """One page without anything outside itself: styles inline, diagrams as SVG."""
    solved = report.solved
    colours = mean_colours(solved.views, solved.sparse_positions, solved.sparse_visibility)
    pictures = {view.name: thumbnail(view.image_srgb) for view in solved.views}
    covariance = None if solved.evidence is None else solved.evidence.pose_covariance
    place_covariances = None if covariance is None else covariance[:, 3:, 3:]
    return filled(
        "cameras.html.j2",
        report=report,
        solved=solved,
        graph=match_graph(
            [(photo.name, pictures.get(photo.name)) for photo in report.photos],
            [(pair.one, pair.other, pair.num_verified, strength(pair.num_verified)) for pair in report.pairs],
        ),
        tracks=histogram(
            [
                Bar(str(n), count, "weak" if n == 2 else "measured")
                for n, count in enumerate(report.track_lengths, 2)
            ],
            "photographs that see a point",
        ),
        angles=histogram(_angle_bars(report), "widest angle between the rays to a point, degrees"),
        map=top_view(solved.views, solved.sparse_positions, colours, report.region, place_covariances),
        weak_pair=WEAK_PAIR,
        strong_pair=STRONG_PAIR,
        flat_angle=FLAT_ANGLE_DEG,
        good_angle=GOOD_ANGLE_DEG,
    )


def strength(num_verified: int) -> str:
    """The class of a pair, as the page colours it."""
    return "guessed" if num_verified < WEAK_PAIR else "weak" if num_verified < STRONG_PAIR else "measured"


def _angle_bars(report: CameraReport) -> list[Bar]:
    bars = []
    for low, high, count in zip(ANGLE_STEPS_DEG[:-1], ANGLE_STEPS_DEG[1:], report.angle_counts, strict=True):
        kind = "guessed" if high <= FLAT_ANGLE_DEG else "weak" if high <= GOOD_ANGLE_DEG else "measured"
        bars.append(Bar(f"{low}–{high}", count, kind))
    return bars


def camera_report_numbers(report: CameraReport) -> dict[str, object]:
    """The report's facts as JSON knows them (no NaN, no infinity), with units in the keys."""
    evidence = report.solved.evidence
    covariances = None if evidence is None or evidence.pose_covariance is None else evidence.pose_covariance
    names = [photo.name for photo in report.photos]
    return {
        "job": report.job_name,
        "seed": report.seed,
        "versions": dict(report.versions),
        "estimated": report.solved.estimated,
        "reprojection_error_px": report.solved.reprojection_error_px,
        "median_error_px": report.median_error_px,
        "median_angle_deg": report.median_angle_deg,
        "point_sigma_percent": report.point_sigma_percent,
        "region_diameter_world": 2 * report.region.radius_world,
        "num_points": len(report.solved.sparse_positions),
        "photos": [dataclasses.asdict(photo) for photo in report.photos],
        "pairs": [
            {**dataclasses.asdict(pair), "one": names[pair.one], "other": names[pair.other]}
            for pair in report.pairs
        ],
        "track_lengths": {str(n): count for n, count in enumerate(report.track_lengths, 2)},
        "angle_steps_deg": list(ANGLE_STEPS_DEG),
        "angle_counts": list(report.angle_counts),
        "pose_covariance_gauge": "the cameras as a whole",
        "pose_covariance_lenses": None if evidence is None else "free" if evidence.lenses_free else "held",
        "pose_covariance_rad_world": None
        if covariances is None
        else {v.name: c.tolist() for v, c in zip(report.solved.views, covariances, strict=True)},
        "decisions": [dataclasses.asdict(decision) for decision in report.solved.decisions],
        "remarks": list(report.remarks),
    }
