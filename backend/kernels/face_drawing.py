"""Triangles drawn into a picture: which pixels' centres lie in which of them, compiled for the CPU.

The same as casting a ray through each pixel at the triangles laid flat, several times as fast.
"""

import math

import numpy as np

from .compiled import Doubles, Floats, Ints, compiled


@compiled
def draw_faces(rows: tuple[int, int], corners: Doubles, face: Ints, weights: Floats) -> None:
    """Write the number of a face, and the weights of its first two corners, into some rows of a picture.

    `corners` (faces, 3, 2) are in pixels; pixels of no face stay as they are; of several the last counts.
    """
    width = face.shape[1]
    for number in range(corners.shape[0]):
        ax, ay = corners[number, 0, 0], corners[number, 0, 1]
        bx, by = corners[number, 1, 0], corners[number, 1, 1]
        cx, cy = corners[number, 2, 0], corners[number, 2, 1]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        top = max(rows[0], math.ceil(min(ay, by, cy) - 0.5))
        bottom = min(rows[1] - 1, math.floor(max(ay, by, cy) - 0.5))
        left = max(0, math.ceil(min(ax, bx, cx) - 0.5))
        right = min(width - 1, math.floor(max(ax, bx, cx) - 0.5))
        if area == 0:
            continue
        for row in range(top, bottom + 1):
            y = row + 0.5
            for column in range(left, right + 1):
                x = column + 0.5
                first = ((bx - x) * (cy - y) - (by - y) * (cx - x)) / area
                second = ((cx - x) * (ay - y) - (cy - y) * (ax - x)) / area
                if first >= 0 and second >= 0 and first + second <= 1:
                    face[row, column] = number
                    weights[row, column, 0], weights[row, column, 1] = first, second


def error_of_a_half() -> float:
    """How far a pixel's middle is from where its weights say, in half a square; inf if it is not drawn."""
    corners = np.array([[[0, 0], [8, 0], [0, 8]]], np.float64)
    face, weights = np.full((8, 8), -1, np.int32), np.zeros((8, 8, 2), np.float32)
    draw_faces((0, 8), corners, face, weights)
    if face[2, 4] != 0 or face[5, 5] != -1:
        return np.inf
    first, second = weights[2, 4]
    found = first * corners[0, 0] + second * corners[0, 1] + (1 - first - second) * corners[0, 2]
    return float(np.abs(found - [4.5, 2.5]).max())
