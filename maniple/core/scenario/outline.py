"""Exact distances between outlines: what is too near at the start of a run. Scalar: corners are few."""

import math
from collections.abc import Sequence
from itertools import pairwise, product

from maniple.core.geometry import Pose
from maniple.core.scenario.types import Box, Circle, Obstacle, Point, Polygon, RobotModel, Wall

Corners = Sequence[Point]
"""Corners of a filled simple polygon in order (m), or the two ends of a segment."""


def rectangle(pose: Sequence[float], length: float, width: float) -> Corners:
    """Corners of a rectangle centred on `pose` (x m, y m, heading rad), counter-clockwise."""
    frame = Pose(*pose)
    x, y = 0.5 * length, 0.5 * width
    return [frame.compose(Pose(a, b, 0.0))[:2] for a, b in ((x, y), (-x, y), (-x, -y), (x, -y))]


def body(pose: Sequence[float], model: RobotModel) -> Corners:
    """Corners of a robot whose middle of the axle is at `pose`."""
    middle = Pose(*pose).compose(Pose(model.body_offset_m, 0.0, 0.0))
    return rectangle(middle, model.length_m, model.width_m)


def radius(model: RobotModel, centre_m: float = 0.0) -> float:
    """Of the circle around a robot's body whose middle is `centre_m` ahead of the middle of the axle, m."""
    return math.hypot(0.5 * model.length_m + abs(model.body_offset_m - centre_m), 0.5 * model.width_m)


def circle(model: RobotModel) -> tuple[float, float]:
    """The circle around a robot's body that its guard keeps clear: how far ahead of the middle of the axle
    its middle is, and its radius, m.

    It is centred on the axle, so that the robot may turn on the spot in it. A car can't, and its axle is far
    from its middle: its circle is centred on the body.
    """
    ahead = model.body_offset_m if model.drive == "car" else 0.0
    return ahead, radius(model, ahead)


def corners_of(obstacle: Box | Polygon | Wall) -> Corners:
    """Corners of an obstacle that has some; the two ends of a wall."""
    match obstacle:
        case Box(centre=(x, y), size=(length, width), angle_rad=angle):
            return rectangle((x, y, angle), length, width)
        case Polygon(points=points):
            return points
        case Wall(start=start, end=end):
            return start, end


def box_around(obstacle: Obstacle) -> Corners:
    """Lower left and upper right corner of the smallest upright box around an obstacle."""
    if isinstance(obstacle, Circle):
        (x, y), r = obstacle.centre, obstacle.radius_m
        return (x - r, y - r), (x + r, y + r)
    xs, ys = zip(*corners_of(obstacle), strict=True)
    return (min(xs), min(ys)), (max(xs), max(ys))


def gap_to(corners: Corners, obstacle: Obstacle) -> float:
    """Distance (m) from a filled polygon to an obstacle; 0 where they touch or overlap."""
    if isinstance(obstacle, Circle):
        return max(0.0, distance_to(corners, obstacle.centre) - obstacle.radius_m)
    return gap(corners, corners_of(obstacle))


def gap(first: Corners, second: Corners) -> float:
    """Distance (m) between two filled polygons or segments; 0 where they touch or overlap."""
    if any(crossing(*a, *b) for a, b in product(edges(first), edges(second))):
        return 0.0
    return min(
        min(distance_to(first, point) for point in second), min(distance_to(second, point) for point in first)
    )


def distance_to(corners: Corners, point: Point) -> float:
    """Distance (m) from a point to a filled polygon or a segment; 0 inside."""
    if len(corners) > 2 and inside(corners, point):
        return 0.0
    return min(_to_segment(point, a, b) for a, b in edges(corners))


def inside(corners: Corners, point: Point) -> bool:
    """Whether a point is strictly inside a simple polygon: a ray from it leaves an odd number of times."""
    x, y = point
    result = False
    for (x1, y1), (x2, y2) in edges(corners):
        if (y1 > y) != (y2 > y) and x < x1 + (y - y1) * (x2 - x1) / (y2 - y1):
            result = not result
    return result


def edges(corners: Corners) -> list[tuple[Point, Point]]:
    """The edges of a polygon, the last one closing it; the one edge of a segment."""
    return list(pairwise([*corners, corners[0]] if len(corners) > 2 else corners))


def crossing(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the segments ab and cd cross at a point inside both."""
    return _turn(a, b, c) * _turn(a, b, d) < 0 and _turn(c, d, a) * _turn(c, d, b) < 0


def area(corners: Corners) -> float:
    """Signed area (m^2) of a simple polygon, positive counter-clockwise."""
    return 0.5 * sum(x1 * y2 - x2 * y1 for (x1, y1), (x2, y2) in edges(corners))


def self_contact(corners: Corners) -> tuple[int, int] | None:
    """Two edges of a polygon, by index, that meet where they should not; None for a simple polygon.

    Neighbouring edges meet at their common corner and may not fold back on each other.
    """
    sides = edges(corners)
    count = len(sides)
    for i, (a, b) in enumerate(sides):
        if a == b:
            return i, i
    for i, (a, b) in enumerate(sides):
        for j in range(i + 1, count):
            c, d = sides[j]
            if j == i + 1 or (i == 0 and j == count - 1):
                corner, p, q = (b, a, d) if j == i + 1 else (a, b, c)
                if _turn(p, corner, q) == 0 and _dot(p, corner, q) > 0:
                    return i, j
            elif gap((a, b), (c, d)) == 0.0:
                return i, j
    return None


def _turn(a: Point, b: Point, c: Point) -> float:
    """Twice the signed area of the triangle abc: positive where the way a, b, c turns left."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _dot(a: Point, corner: Point, b: Point) -> float:
    return (a[0] - corner[0]) * (b[0] - corner[0]) + (a[1] - corner[1]) * (b[1] - corner[1])


def _to_segment(point: Point, a: Point, b: Point) -> float:
    """Distance (m) from a point to the segment ab."""
    ex, ey = b[0] - a[0], b[1] - a[1]
    px, py = point[0] - a[0], point[1] - a[1]
    square = ex * ex + ey * ey
    share = min(1.0, max(0.0, (px * ex + py * ey) / square)) if square > 0.0 else 0.0
    return math.hypot(px - share * ex, py - share * ey)


def triangulated(corners: Corners) -> list[tuple[int, int, int]]:
    """The triangles, by index of their corners, that a simple polygon is made of; ears are cut off one by
    one."""
    rest = list(range(len(corners)))
    if area(corners) < 0.0:
        rest.reverse()
    triangles = []
    while len(rest) > 3:
        ears = [(rest[k - 1], rest[k], rest[(k + 1) % len(rest)]) for k in range(len(rest))]
        ear = next((one for one in ears if _is_ear(corners, rest, one)), ears[0])
        triangles.append(ear)
        rest.remove(ear[1])
    return [*triangles, (rest[0], rest[1], rest[2])]


def _is_ear(corners: Corners, rest: Sequence[int], ear: tuple[int, int, int]) -> bool:
    """Whether a corner between its neighbours sticks out, with no other corner in it."""
    a, b, c = (corners[index] for index in ear)
    others = (corners[index] for index in rest if index not in ear)
    return _turn(a, b, c) > 0 and not any(
        _turn(a, b, p) >= 0 and _turn(b, c, p) >= 0 and _turn(c, a, p) >= 0 for p in others
    )
