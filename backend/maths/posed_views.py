"""Several cameras whose poses and focal lengths are being sought: what they show, and how that changes.

Each camera has six numbers of its own, a turn and a shift in its own axes (R <- exp(w) R, t <- exp(w) t + v),
and each lens the logarithm of its focal length.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from ..scene import Camera
from .gauge import cross_matrix

POSE = 6


@dataclass(frozen=True, kw_only=True)
class PosedViews:
    """Pinhole cameras with square pixels; some may share a lens."""

    rotation: Float64[np.ndarray, "views 3 3"]
    """Camera from world."""
    translation: Float64[np.ndarray, "views 3"]
    focal_px: Float64[np.ndarray, "views"]
    centre_px: Float64[np.ndarray, "views 2"]
    lens: Int64[np.ndarray, "views"]
    """Number of each view's lens, from 0 on."""

    @property
    def num_unknowns(self) -> int:
        """Numbers that a step has: six for each view, then one for each lens."""
        return POSE * len(self.rotation) + int(self.lens.max()) + 1

    @property
    def positions(self) -> Float64[np.ndarray, "views 3"]:
        """Centres of projection, world frame."""
        return np.asarray(-np.einsum("vji,vj->vi", self.rotation, self.translation))

    def moved(self, step: Float64[np.ndarray, "unknowns"]) -> "PosedViews":
        """The views after a step."""
        poses = step[: POSE * len(self.rotation)].reshape(-1, POSE)
        turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        return replace(
            self,
            rotation=turn @ self.rotation,
            translation=np.einsum("vij,vj->vi", turn, self.translation) + poses[:, 3:],
            focal_px=self.focal_px * np.exp(step[POSE * len(self.rotation) :])[self.lens],
        )

    def rays(
        self, view: Int64[np.ndarray, "rays"], pixels: Float64[np.ndarray, "rays 2"]
    ) -> Float64[np.ndarray, "rays 3"]:
        """Of depth 1, in the axes of each pixel's view."""
        across = (pixels - self.centre_px[view]) / self.focal_px[view, None]
        return np.concatenate([across, np.ones((len(pixels), 1))], axis=1)

    def directions(
        self, view: Int64[np.ndarray, "rays"], pixels: Float64[np.ndarray, "rays 2"]
    ) -> Float64[np.ndarray, "rays 3"]:
        """Of the same rays, world frame."""
        return self._turned_back(view, self.rays(view, pixels))

    def places(
        self,
        view: Int64[np.ndarray, "rays"],
        pixels: Float64[np.ndarray, "rays 2"],
        depth: Float64[np.ndarray, "rays"],
    ) -> Float64[np.ndarray, "rays 3"]:
        """At that depth on the pixels' rays, world frame."""
        return self._turned_back(view, depth[:, None] * self.rays(view, pixels) - self.translation[view])

    def shown(
        self, view: Int64[np.ndarray, "places"], places: Float64[np.ndarray, "places 3"]
    ) -> tuple[Float64[np.ndarray, "places 2"], Float64[np.ndarray, "places"]]:
        """The pixel at which each place's view shows it, and its depth; nonsense unless that is > 0."""
        in_camera = self._in_camera(view, places)
        across = in_camera[:, :2] / _in_front(in_camera)
        return self.focal_px[view, None] * across + self.centre_px[view], in_camera[:, 2]

    def change_of_shown(
        self, view: Int64[np.ndarray, "places"], places: Float64[np.ndarray, "places 3"]
    ) -> tuple[Float64[np.ndarray, "places 2 unknowns"], Float64[np.ndarray, "places 2 3"]]:
        """How the pixel changes with a step of the views, the places held, and with the place."""
        in_camera = self._in_camera(view, places)
        across = in_camera[:, :2] / _in_front(in_camera)
        change = np.zeros((len(view), 2, 3))
        change[:, 0, 0] = change[:, 1, 1] = 1.0
        change[:, :, 2] = -across
        change *= (self.focal_px[view, None] / _in_front(in_camera))[:, :, None]
        by_step = np.zeros((len(view), 2, self.num_unknowns))
        _add(by_step, POSE * view, -change @ cross_matrix(in_camera))
        _add(by_step, POSE * view + 3, change)
        _add(by_step, self._lens_column(view), (self.focal_px[view, None] * across)[:, :, None])
        return by_step, change @ self.rotation[view]

    def change_of_places(
        self,
        view: Int64[np.ndarray, "rays"],
        pixels: Float64[np.ndarray, "rays 2"],
        depth: Float64[np.ndarray, "rays"],
    ) -> Float64[np.ndarray, "rays 3 unknowns"]:
        """How the places at that depth on the rays change with a step of the views."""
        in_camera = depth[:, None] * self.rays(view, pixels)
        back = self.rotation[view].transpose(0, 2, 1)
        by_step = np.zeros((len(view), 3, self.num_unknowns))
        _add(by_step, POSE * view, back @ cross_matrix(in_camera))
        _add(by_step, POSE * view + 3, -back)
        in_camera[:, 2] = 0.0
        _add(by_step, self._lens_column(view), -back @ in_camera[:, :, None])
        return by_step

    def _turned_back(
        self, view: Int64[np.ndarray, "places"], vectors: Float64[np.ndarray, "places 3"]
    ) -> Float64[np.ndarray, "places 3"]:
        """From the axes of their views to the world's."""
        return np.asarray(np.einsum("kji,kj->ki", self.rotation[view], vectors))

    def _in_camera(
        self, view: Int64[np.ndarray, "places"], places: Float64[np.ndarray, "places 3"]
    ) -> Float64[np.ndarray, "places 3"]:
        turned = np.einsum("kij,kj->ki", self.rotation[view], places)
        return np.asarray(turned + self.translation[view])

    def _lens_column(self, view: Int64[np.ndarray, "places"]) -> Int64[np.ndarray, "places"]:
        return np.asarray(POSE * len(self.rotation) + self.lens[view])


def posed_views(cameras: Sequence[Camera]) -> PosedViews:
    """The cameras, each with a lens of its own whose focal length is the mean of its two."""
    return PosedViews(
        rotation=np.array([camera.camera_from_world[:3, :3] for camera in cameras]),
        translation=np.array([camera.camera_from_world[:3, 3] for camera in cameras]),
        focal_px=np.array([(camera.fx_px + camera.fy_px) / 2 for camera in cameras]),
        centre_px=np.array([[camera.cx_px, camera.cy_px] for camera in cameras]),
        lens=np.arange(len(cameras)),
    )


def _add(
    to: Float64[np.ndarray, "rows values unknowns"],
    first: Int64[np.ndarray, "rows"],
    block: Float64[np.ndarray, "rows values columns"],
) -> None:
    """Add to each row's columns from `first` on."""
    columns = first[:, None] + np.arange(block.shape[2])
    rows = np.arange(len(first))[:, None]
    to[rows, :, columns] += block.transpose(0, 2, 1)


def _in_front(in_camera: Float64[np.ndarray, "places 3"]) -> Float64[np.ndarray, "places 1"]:
    """Depths; 1 for what is not in front, which no division is to make infinite."""
    return np.where(in_camera[:, 2:] > 0, in_camera[:, 2:], 1.0)
