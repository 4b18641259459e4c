"""Outline of the car's body and its clearance to the cones.

Body frame: origin at the rear-axle centre, x ahead, y to the left (ISO 8855). The outline is the body's rectangle and,
where the mirrors stand out, a second, short rectangle for them. Clearance is the signed distance from the outline to a
cone's axis: negative when the axis is inside.
"""

from collections.abc import Sequence
from math import cos, inf, sin, sqrt
from typing import Any, NamedTuple, Protocol

MIRROR_HALF_LENGTH_M = 0.10
"""Half of the length over which the mirrors stand out, along the car (assumed; door mirrors are about 0.2 m long)."""


class BodyDimensions(Protocol):
    """What the outline needs of a vehicle; all in m."""

    @property
    def wheelbase_m(self) -> float: ...  # noqa: D102
    @property
    def front_overhang_m(self) -> float: ...  # noqa: D102
    @property
    def rear_overhang_m(self) -> float: ...  # noqa: D102
    @property
    def body_width_m(self) -> float: ...  # noqa: D102
    @property
    def mirror_width_m(self) -> float: ...  # noqa: D102
    @property
    def mirror_from_rear_axle_m(self) -> float: ...  # noqa: D102


class Outline(NamedTuple):
    """The body's rectangle and the mirrors' rectangle in the body frame, m; both symmetric about the x axis.

    A car whose mirrors do not stand out has `mirror_half_width_m == half_width_m`.
    """

    rear_m: float
    front_m: float
    half_width_m: float
    mirror_rear_m: float
    mirror_front_m: float
    mirror_half_width_m: float


def outline_of(vehicle: BodyDimensions) -> Outline:
    """Outline of a vehicle at its nominal dimensions."""
    return Outline(
        rear_m=-vehicle.rear_overhang_m,
        front_m=vehicle.wheelbase_m + vehicle.front_overhang_m,
        half_width_m=0.5 * vehicle.body_width_m,
        mirror_rear_m=vehicle.mirror_from_rear_axle_m - MIRROR_HALF_LENGTH_M,
        mirror_front_m=vehicle.mirror_from_rear_axle_m + MIRROR_HALF_LENGTH_M,
        mirror_half_width_m=0.5 * vehicle.mirror_width_m,
    )


def clearance_m(
    outline: Outline, x_m: float, y_m: float, yaw_rad: float, cones: Sequence[Sequence[float]]
) -> tuple[float, int]:
    """Signed distance in m from the outline to the axis of the nearest cone, and that cone's index.

    `x_m, y_m, yaw_rad` is the pose of the rear-axle centre in the frame of `cones` (pairs of x and y in m). Exact
    outside; inside, where the two rectangles overlap, the depth is that of the deeper one. No cones: (inf, -1).
    """
    rear, front, half_width, mirror_rear, mirror_front, mirror_half_width = outline
    c = cos(yaw_rad)
    s = sin(yaw_rad)
    nearest = inf
    nearest_index = -1
    for index in range(len(cones)):  # by places: an array's rows cannot be unpacked when compiled
        dx = cones[index][0] - x_m
        dy = cones[index][1] - y_m
        ahead = c * dx + s * dy
        aside = c * dy - s * dx
        if aside < 0.0:
            aside = -aside
        out_x = ahead - front if ahead - front > rear - ahead else rear - ahead
        out_y = aside - half_width
        if out_x > 0.0 and out_y > 0.0:
            distance = sqrt(out_x * out_x + out_y * out_y)
        else:
            distance = out_x if out_x > out_y else out_y
        if mirror_half_width > half_width:
            out_x = ahead - mirror_front if ahead - mirror_front > mirror_rear - ahead else mirror_rear - ahead
            out_y = aside - mirror_half_width
            if out_x > 0.0 and out_y > 0.0:
                mirror_distance = sqrt(out_x * out_x + out_y * out_y)
            else:
                mirror_distance = out_x if out_x > out_y else out_y
            if mirror_distance < distance:
                distance = mirror_distance
        if distance < nearest:
            nearest = distance
            nearest_index = index
    return nearest, nearest_index


def clearance_array_m(outline: Outline, x_m: Any, y_m: Any, yaw_rad: Any, cones: Any) -> Any:
    """Return the same signed distances for many poses at once, with numpy, for path design and plots.

    `x_m, y_m, yaw_rad`: arrays of shape (n,) or scalars; `cones`: shape (k, 2). Returns float64 of shape (n, k), m.
    """
    import numpy as np  # noqa: PLC0415  the plant itself runs without numpy

    x, y, yaw = np.atleast_1d(x_m)[:, None], np.atleast_1d(y_m)[:, None], np.atleast_1d(yaw_rad)[:, None]
    cones = np.asarray(cones, dtype=float).reshape(-1, 2)
    dx, dy = cones[:, 0] - x, cones[:, 1] - y
    ahead = np.cos(yaw) * dx + np.sin(yaw) * dy
    aside = np.abs(np.cos(yaw) * dy - np.sin(yaw) * dx)

    def to_rectangle(rear: float, front: float, half_width: float) -> Any:
        out_x = np.maximum(ahead - front, rear - ahead)
        out_y = aside - half_width
        outside = np.sqrt(np.maximum(out_x, 0.0) ** 2 + np.maximum(out_y, 0.0) ** 2)
        return np.where((out_x > 0.0) & (out_y > 0.0), outside, np.maximum(out_x, out_y))

    distance = to_rectangle(outline.rear_m, outline.front_m, outline.half_width_m)
    if outline.mirror_half_width_m > outline.half_width_m:
        mirrors = to_rectangle(outline.mirror_rear_m, outline.mirror_front_m, outline.mirror_half_width_m)
        distance = np.minimum(distance, mirrors)
    return distance


def polygon(outline: Outline, x_m: float, y_m: float, yaw_rad: float) -> list[tuple[float, float]]:
    """Corners (x, y) in m of the outline with its mirrors, counter-clockwise from the right rear, for plots."""
    rear, front, half, mirror_rear, mirror_front, mirror_half = outline
    right = [(rear, -half)]
    if mirror_half > half:
        right += [(mirror_rear, -half), (mirror_rear, -mirror_half)]
        right += [(mirror_front, -mirror_half), (mirror_front, -half)]
    right.append((front, -half))
    corners = right + [(ahead, -aside) for ahead, aside in reversed(right)]
    c, s = cos(yaw_rad), sin(yaw_rad)
    return [(x_m + c * ahead - s * aside, y_m + s * ahead + c * aside) for ahead, aside in corners]
