"""Which robot is to be where: the places of the desired formation, who has which, and their chain."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from central_controller.chain import Chain
from central_controller.planning import Straight, rechain, relabel
from central_controller.reference import Reference
from central_controller.supervisor import exchange
from maniple.control.parts import Planner
from maniple.core.geometry import Floats, Pose
from maniple.core.messages import pack_floats
from maniple.core.scenario import outline
from maniple.core.scenario.types import Point, Scenario


class Lineup:
    """The places of a formation and the chain of triangles over the robots that are there.

    Every robot keeps its place while it is lost; `robots` is the chain's order of those that are not.
    """

    def __init__(self, scenario: Scenario, planner: Planner) -> None:
        self._signed = scenario.controller.angle == "signed"
        self._neighbours = scenario.controller.reference == "neighbours"
        self._planner = planner
        self._relabel = scenario.planning.relabel
        self._ids = tuple(robot.id for robot in scenario.robots)
        self.exchanges = scenario.supervisor.exchange
        """Whether robots of one kind may have each other's places."""
        self._robots = {robot.id: robot for robot in scenario.robots}
        self._model_of = scenario.model_of
        self._place_of: dict[str, int] = {}
        self._building: Straight | None = None
        self._elapsed_s = 0.0
        self.set_points(scenario.formation.points)

    @property
    def building(self) -> bool:
        """Whether the desired places are still on their way."""
        return self._building is not None

    @property
    def built_from(self) -> tuple[Point, ...]:
        """Where the control points of `robots` began, in the formation's frame, while they are on their
        way."""
        building = self._building
        return () if building is None else tuple((x, y) for x, y in building.start.tolist())

    @property
    def built_s(self) -> float:
        """For how long they have been on their way, s."""
        return 0.0 if self._building is None else self._elapsed_s

    @property
    def places(self) -> Floats:
        """Where the control points of `robots` are to be in the end, (k, 2) in m in the formation's frame."""
        return self._targets

    @property
    def points(self) -> Floats:
        """Where they are to be now, likewise."""
        return self._targets if self._building is None else self._building.at(self._elapsed_s)[0]

    @property
    def reach_m(self) -> float:
        """How far the outermost place is from the formation's origin."""
        return float(np.hypot(*self._places.T).max())

    def set_points(self, points: Sequence[Point]) -> None:
        """A new shape, a place for every robot of the scenario; robot k takes place k until it is planned."""
        places = np.array(points, dtype=np.float64)
        self._places = places[list(relabel(places, self._signed))] if self._relabel else places
        self._place_of = {name: place for place, name in enumerate(self._ids)}
        self.chain_up(self._ids)

    def place_of(self, name: str) -> int:
        """The index of the place that a robot has, be it lost or not."""
        return self._place_of[name]

    def recall(
        self,
        places: Mapping[str, int],
        there: Sequence[str],
        built_from: Sequence[Point],
        built_s: float,
        speed_mps: float,
    ) -> None:
        """Go on where another line-up of the same points was: who has which place, the robots that are there,
        and how far the building is, by `built_from` and `built_s`."""
        self._place_of = dict(places)
        self.chain_up(there)
        if built_from and len(built_from) == len(self.robots):
            self._building = Straight(np.array(built_from), self.places, speed_mps)
            self._elapsed_s = built_s

    def plan(self, points: Mapping[str, Point]) -> None:
        """Let the planner decide who of the robots whose control points are at `points`, in the formation's
        frame, takes which of the places that are not kept for others."""
        names = [name for name in self._ids if name in points]
        places = sorted(self._place_of[name] for name in names)
        order = self._planner(np.array([points[name] for name in names]), self._places[places])
        for place, index in zip(places, order, strict=True):
            self._place_of[names[index]] = place
        self.chain_up(names)

    def exchange(self, order: Sequence[int]) -> None:
        """Let robot `order[k]` of the chain take the place of robot k."""
        places = [self._place_of[name] for name in self.robots]
        for place, index in zip(places, order, strict=True):
            self._place_of[self.robots[index]] = place
        self.chain_up(self.robots)

    def sort_out(self, points: Mapping[str, Point]) -> bool:
        """Let robots of one kind whose control points, given in the formation's own frame, would be led
        through each other have each other's places; whether any do."""
        robots = [self._robots[name] for name in self.robots]
        kinds = [(robot.model, robot.sensor, robot.control_point_m) for robot in robots]
        alike = np.array([[one == other for other in kinds] for one in kinds])
        reach = max(outline.radius(self._model_of(robot)) + robot.control_point_m for robot in robots)
        here = np.array([points[name] for name in self.robots])
        order = exchange(here, self.places, range(len(robots)), alike, 2.0 * reach)
        if order is not None:
            self.exchange(order)
        return order is not None

    def chain_up(self, names: Sequence[str]) -> None:
        """Make the chain of triangles over these robots, each at its place; at most two make none."""
        robots = sorted(names, key=lambda name: self._place_of[name])
        places = self._places[[self._place_of[name] for name in robots]]
        if len(robots) >= 3:
            order = rechain(places, self._signed)
            robots, places = [robots[index] for index in order], places[list(order)]
            self.chain = Chain(places, self._signed, self._neighbours)
        self.robots = tuple(robots)
        self._targets = places
        self._building = None
        self._packed = pack_floats(self.places)

    def build(self, points: Mapping[str, Point], speed_mps: float) -> None:
        """Let the desired places start at `points`, in the formation's frame, and go straight to where they
        are to be, all arriving at once."""
        start = np.array([points[name] for name in self.robots])
        self._building = Straight(start, self.places, speed_mps)
        self._elapsed_s = 0.0

    def advance(self, elapsed_s: float) -> None:
        """Let the desired places move on."""
        if self._building is None:
            return
        self._elapsed_s += elapsed_s
        if self._elapsed_s >= self._building.duration_s:
            self._building = None

    def places_at(self, frame: Pose) -> Floats:
        """`points` where the formation's own frame is at `frame`, (k, 2) in m."""
        return np.asarray(self.points @ _turned(frame.psi) + (frame.x, frame.y))

    def packed(self) -> bytes:
        """`points` as the wire has them."""
        return self._packed if self._building is None else pack_floats(self.points)

    def ways_at(self, target: Reference) -> tuple[Floats, Floats]:
        """While the formation is being built: where the control points are to be, (k, 2) in m, and how fast
        they are to move, (k, 2) in m/s, when the formation's frame follows `target`."""
        assert self._building is not None
        points = self.places_at(target.pose)
        _, ways = self._building.at(self._elapsed_s)
        vx, vy, turning = target.velocity
        arms = points - (target.pose.x, target.pose.y)
        carried = turning * np.column_stack([-arms[:, 1], arms[:, 0]]) + (vx, vy)
        return points, ways @ _turned(target.pose.psi) + carried


def fitted(points: Floats, places: Floats) -> Pose:
    """Where the formation's frame is if its `places` are to be nearest to `points`, both (n, 2) in m in the
    order of the robots: the rigid motion of least squares (Kabsch 1976, doi 10.1107/S0567739476001873)."""
    middle, own = points.mean(axis=0), places.mean(axis=0)
    to, of = points - middle, places - own
    cross = float((of[:, 0] * to[:, 1] - of[:, 1] * to[:, 0]).sum())
    turned = Pose(0.0, 0.0, math.atan2(cross, float((of * to).sum())))
    dx, dy = turned.rotate(float(own[0]), float(own[1]))
    return Pose(float(middle[0]) - dx, float(middle[1]) - dy, turned.psi)


def _turned(angle: float) -> Floats:
    """What turns row vectors counter-clockwise."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s], [-s, c]])
