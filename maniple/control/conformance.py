"""What every implementation of a layer has to keep, as checks that give the counterexample.

Each suite takes what the layer's factory takes. Inputs are drawn from named streams: the same every time.
"""

import gc
import math
import random
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from maniple.control.kinematics import Kinematics
from maniple.control.limits import Velocity, curvature_max
from maniple.control.parts import (
    AvoidanceFactory,
    CompensationFactory,
    FormationFactory,
    KinematicsFactory,
    Planner,
)
from maniple.control.returns import Returns
from maniple.control.unicycle import control_point
from maniple.core.geometry import Floats, Pose
from maniple.core.scenario.types import Avoidance, Compensation, Controller, RobotModel
from maniple.core.streams import stream

STEP_S = 0.1
"""Between the steps of a layer."""

STEPS = 100
"""Of a run in a check."""

HUGE = 1e6
"""m, m/s: more than any robot does, and no reason to fail."""

_STANDING = Velocity()

Check: TypeAlias = Callable[[], str | None]
"""None if the property holds, else the counterexample."""


class Finding(NamedTuple):
    """One property and whether it holds."""

    name: str
    """The property."""
    counterexample: str
    """Empty if it holds."""

    @property
    def holds(self) -> bool:
        """Whether no counterexample was found."""
        return not self.counterexample


def avoidance(factory: AvoidanceFactory, parameters: Avoidance, model: RobotModel) -> list[Finding]:
    """The properties of an avoidance law."""
    inputs = _avoidance_inputs(model)

    def outputs(steps: Sequence[tuple[Any, ...]] = inputs) -> list[Any]:
        law = factory(parameters, model)
        return [law.step(*arguments) for arguments in steps]

    def extra_steps() -> str | None:
        still = [(wanted, seen, 0.0) for wanted, seen, _ in inputs]
        twice = outputs([one for pair in zip(inputs, still, strict=True) for one in pair])[0::2]
        return _first_difference(twice, outputs(), inputs, off=1e-9)

    def rest() -> str | None:
        for seen in (None, _returns(np.empty(0), np.empty(0))):
            for told in outputs([(_STANDING, seen, STEP_S)] * STEPS):
                if any(told):
                    return f"told to stand, with nothing near, it gave {told}"
        return None

    def ahead() -> str | None:
        wanted = Velocity(0.5 * model.u_max_mps, 0.0)
        seen = _returns(np.array([0.4]), np.array([0.0]))
        told = outputs([(wanted, seen, STEP_S)] * STEPS)[-1]
        if told[0] > wanted.u:
            return f"with something 0.4 m dead ahead it makes u = {told[0]} of u = {wanted.u}"
        return None

    def huge() -> str | None:
        near = _returns(np.array([0.0, 1e-9, HUGE]), np.array([0.0, 1.0, -1.0]))
        steps = [(Velocity(s * HUGE, HUGE), near, dt) for s in (-1, 1) for dt in (STEP_S, HUGE)]
        return _first_unsound(outputs(steps), steps)

    return _findings(
        {
            "leaves its inputs as they are": lambda: _changes(outputs, inputs),
            "gives three finite numbers": lambda: _first_unsound(outputs(), inputs),
            "gives them for huge and for vanishing inputs": huge,
            "same inputs, same outputs": lambda: _first_difference(outputs(), outputs(), inputs),
            "a step of no time changes nothing": extra_steps,
            "stays at rest where nothing is near": rest,
            "does not speed up towards what is dead ahead": ahead,
            **_pure(outputs),
        }
    )


def compensation(factory: CompensationFactory, parameters: Compensation, model: RobotModel) -> list[Finding]:
    """The properties of a compensation law."""
    inputs = _compensation_inputs(model)

    def outputs(steps: Sequence[tuple[Any, ...]] = inputs) -> list[Any]:
        law = factory(parameters, model)
        return [law.step(*arguments) for arguments in steps]

    def learnt() -> str | None:
        law = factory(parameters, model)
        count = len(law.parameters)
        for arguments in inputs:
            law.step(*arguments)
            found = law.parameters
            if len(found) != count or not all(map(math.isfinite, found)):
                return f"after {_shown(arguments)} the parameters are {found}; there were {count}"
        return None

    def rest() -> str | None:
        steps = [(_STANDING, _STANDING, True, STEP_S if k else 0.0) for k in range(STEPS)]
        told = next((told for told in outputs(steps) if any(told)), None)
        return f"told to stand, and standing, it gave {told}" if told else None

    def huge() -> str | None:
        steps = [
            (Velocity(s * HUGE, HUGE), Velocity(-s * HUGE, HUGE), True, dt)
            for s in (-1, 1)
            for dt in (0.0, 1e-9, STEP_S, 1.0)
        ]
        return _first_unsound(outputs(steps), steps)

    def follows() -> str | None:
        desired = Velocity(0.4 * model.u_max_mps, 0.2 * model.w_max_radps)
        law = factory(parameters, model)
        bare = _settled(model, desired, lambda *_: desired)
        found = _settled(model, desired, law.step)
        if found > bare + 1e-3:
            return f"after 300 s at {desired} the drive is off by {found:.4f}, and by {bare:.4f} without it"
        return None

    return _findings(
        {
            "gives three finite numbers": lambda: _first_unsound(outputs(), inputs),
            "gives them for huge inputs": huge,
            "shows finite parameters, always as many": learnt,
            "same inputs, same outputs": lambda: _first_difference(outputs(), outputs(), inputs),
            "stays at rest": rest,
            "the drive follows a constant speed no worse than without": follows,
            **_pure(outputs),
        }
    )


def formation_law(factory: FormationFactory, parameters: Controller) -> list[Finding]:
    """The properties of a formation law."""
    draw = stream(0, "conformance/formation-law")
    sizes = [1, 4, 4, 1, 10, 2] * 10
    inputs = [
        (draw.normal(size=(m, 6)) * 0.1, draw.normal(size=(m, 6)), STEP_S if k else 0.0)
        for k, m in enumerate(sizes)
    ]

    def outputs(steps: Sequence[tuple[Any, ...]] = inputs) -> list[Any]:
        law = factory(parameters)
        return [law.rates(*arguments) for arguments in steps]

    def shapes() -> str | None:
        return _first_wrong(outputs(), inputs)

    def huge() -> str | None:
        steps = [(np.zeros((2, 6)), np.full((2, 6), s * HUGE), dt) for s in (-1, 1) for dt in (0.0, STEP_S)]
        return _first_wrong(outputs(steps), steps)

    def equilibrium() -> str | None:
        for desired, _, _ in inputs:
            rates = factory(parameters).rates(desired, np.zeros_like(desired), STEP_S)
            if not np.allclose(rates, desired, rtol=0.0, atol=1e-9):
                return f"without errors it makes {rates.tolist()} of q_des' = {desired.tolist()}"
        return None

    def direction() -> str | None:
        for desired, error, _ in inputs:
            added = np.asarray(factory(parameters).rates(desired, error, STEP_S)) - desired
            if not (added * error).sum() > 0.0:
                return f"the errors {error.tolist()} would grow: it adds {added.tolist()} to q_des'"
        return None

    def settles() -> str | None:
        law, error = factory(parameters), np.array([[0.5, -0.5, 0.5, -0.3, 0.3, -0.5]])
        for k in range(3000):
            error = error - STEP_S * np.asarray(law.rates(np.zeros((1, 6)), error, STEP_S if k else 0.0))
        off = float(np.abs(error).max())
        return None if off < 0.02 else f"after 300 s errors of 0.5 are still {error.tolist()}"

    return _findings(
        {
            "leaves its inputs as they are": lambda: _changes(outputs, inputs),
            "gives finite rates of the shape of the errors": shapes,
            "gives them for huge errors": huge,
            "same inputs, same outputs": lambda: _first_difference(outputs(), outputs(), inputs),
            "without errors it asks for the desired rates": equilibrium,
            "what it adds makes the errors smaller": direction,
            "errors of ideal robots fade": settles,
            **_pure(outputs),
        }
    )


def planner(plan: Planner) -> list[Finding]:
    """The properties of a planner."""
    draw = stream(0, "conformance/planner")
    inputs: list[tuple[Floats, Floats]] = [
        (draw.normal(size=(n, 2)) * 3.0, draw.normal(size=(n, 2)) * 3.0) for n in (3, 4, 6, 12, 12)
    ]
    line = np.stack([np.arange(5.0), np.zeros(5)], axis=1)
    inputs += [(np.zeros((4, 2)), line[:4]), (line, line[::-1].copy()), (line, np.zeros((5, 2)))]

    def outputs(steps: Sequence[tuple[Any, ...]] = inputs) -> list[list[int]]:
        return [[int(index) for index in plan(*arguments)] for arguments in steps]

    def permutation() -> str | None:
        for arguments, order in zip(inputs, outputs(), strict=True):
            if sorted(order) != list(range(len(arguments[0]))):
                return f"of {len(arguments[0])} robots it makes {order}"
        return None

    return _findings(
        {
            "leaves its inputs as they are": lambda: _changes(outputs, inputs),
            "every robot gets one place": permutation,
            "same inputs, same outputs": lambda: _first_difference(outputs(), outputs(), inputs),
            **_pure(outputs),
        }
    )


def kinematics(factory: KinematicsFactory, model: RobotModel, control_point_m: float) -> list[Finding]:
    """The properties of the kinematics of a type of robot."""
    draw = stream(0, "conformance/kinematics")
    inputs = [
        (float(psi), *map(float, draw.normal(size=2) * model.u_max_mps), float(turn))
        for psi, turn in draw.uniform(-math.pi, math.pi, size=(STEPS, 2))
    ]

    def made() -> Kinematics:
        return factory(model, control_point_m)

    def outputs(steps: Sequence[tuple[Any, ...]] = inputs) -> list[Any]:
        law = made()
        return [law.inverse(*arguments) for arguments in steps]

    def huge() -> str | None:
        steps = [(psi, s * HUGE, HUGE, HUGE) for psi in (-math.pi, 0.0, math.pi) for s in (-1, 1)]
        return _first_unsound(outputs(steps), steps)

    def inverse() -> str | None:
        for psi, velocity in _reachable(model):
            law = made()
            wanted = law.forward(psi, velocity)
            told = law.inverse(psi, *wanted, velocity.w)
            found = law.forward(psi, told)
            if not np.allclose(found, wanted, rtol=1e-9, atol=1e-9):
                return f"at psi = {psi:.4f} it gives {told} for {wanted}, which moves the point at {found}"
        return None

    def rest() -> str | None:
        told = made().inverse(0.3, 0.0, 0.0, 0.0)
        return f"for a point that is to stand it gave {told}" if any(told) else None

    def place() -> str | None:
        pose = Pose(1.0, 2.0, 0.5)
        found, wanted = made().point(pose), control_point(pose, control_point_m)
        return None if np.allclose(found, wanted) else f"of {pose} it is {found}, and not {wanted}"

    def motion() -> str | None:
        law, dt_s = made(), 1e-6
        for psi, velocity in _reachable(model):
            u, w, v = velocity
            aside = Pose(0.0, 0.0, psi).rotate(0.0, v * dt_s)
            before = Pose(1.0, 2.0, psi)
            after = before.advance(u * dt_s, w * dt_s)
            after = after._replace(x=after.x + aside[0], y=after.y + aside[1])
            moved = (np.array(law.point(after)) - law.point(before)) / dt_s
            if not np.allclose(moved, law.forward(psi, velocity), rtol=1e-4, atol=1e-4):
                return f"{velocity} at psi = {psi:.4f} moves `point` at {moved}, not as `forward` says"
        return None

    return _findings(
        {
            "gives three finite numbers": lambda: _first_unsound(outputs(), inputs),
            "gives them for huge velocities": huge,
            "inverse undoes forward where the robot can go": inverse,
            "forward is how point moves": motion,
            "point is where the scenario has it, straight ahead": place,
            "stands where the point is to stand": rest,
            "same inputs, same outputs": lambda: _first_difference(outputs(), outputs(), inputs),
            **_pure(outputs),
        }
    )


def _findings(checks: Mapping[str, Check]) -> list[Finding]:
    return [Finding(name, _tried(check)) for name, check in checks.items()]


def _tried(check: Check) -> str:
    try:
        return check() or ""
    except Exception as error:  # noqa: BLE001 - a user's layer may raise anything
        return f"raised {type(error).__name__}: {error}"


def _pure(run: Callable[[], object]) -> dict[str, Check]:
    def global_random() -> str | None:
        before = _random_state()
        run()
        return None if before == _random_state() else "it draws from a global random source"

    def outside() -> str | None:
        with watched(_FORBIDDEN) as called:
            run()
        return f"it calls {', '.join(sorted(called))}" if called else None

    return {
        "draws nothing from a global random source": global_random,
        "reads no clock and no file": outside,
    }


def _random_state() -> tuple[object, ...]:
    """Of the global random sources of Python and NumPy."""
    _, keys, position, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 - that is what is looked for
    return random.getstate(), np.asarray(keys).tobytes(), position, *rest


_FORBIDDEN = {
    *(name for name in dir(time) if name.startswith(("time", "monotonic", "perf_counter", "process_time"))),
    *("sleep", "now", "utcnow", "today", "urandom", "getrandom", "open", "connect", "select"),
}
"""Functions written in C by which a layer could see what is not among its inputs."""


@contextmanager
def watched(forbidden: Collection[str]) -> Iterator[set[str]]:
    """Those of the forbidden functions, written in C, that are called in the block, however they were
    imported. The garbage collector stands still: what listens to it may look at the clock, and is not of what
    is watched."""
    called: set[str] = set()

    def note(_: FrameType, event: str, function: Any) -> None:
        if event == "c_call":
            name = getattr(function, "__name__", "")
            if name in forbidden:
                called.add(f"{getattr(function, '__module__', None) or 'datetime'}.{name}")

    before, collects = sys.getprofile(), gc.isenabled()
    gc.disable()
    sys.setprofile(note)
    try:
        yield called
    finally:
        sys.setprofile(before)
        if collects:
            gc.enable()


def _first_unsound(found: Sequence[Any], inputs: Sequence[tuple[Any, ...]]) -> str | None:
    for told, arguments in zip(found, inputs, strict=True):
        if len(tuple(told)) != 3 or not all(map(math.isfinite, told)):
            return f"for {_shown(arguments)} it gave {told}"
    return None


def _first_wrong(found: Sequence[Any], inputs: Sequence[tuple[Any, ...]]) -> str | None:
    for rates, (_, error, *_rest) in zip(found, inputs, strict=True):
        if np.shape(rates) != error.shape:
            return f"for errors of shape {error.shape} it gave rates of shape {np.shape(rates)}"
        if not np.isfinite(rates).all():
            return f"for the errors {error.tolist()} it gave {np.asarray(rates).tolist()}"
    return None


def _first_difference(
    some: Sequence[Any], others: Sequence[Any], inputs: Sequence[tuple[Any, ...]], off: float = 0.0
) -> str | None:
    for one, other, arguments in zip(some, others, inputs, strict=True):
        if np.shape(one) != np.shape(other) or not np.allclose(one, other, rtol=off, atol=off):
            return f"for {_shown(arguments)} it gave {one} and {other}"
    return None


def _changes(
    run: Callable[[Sequence[tuple[Any, ...]]], object], inputs: Sequence[tuple[Any, ...]]
) -> str | None:
    before = repr(inputs)
    run(inputs)
    return None if repr(inputs) == before else "it writes to the arrays it is given"


def _shown(arguments: tuple[Any, ...]) -> str:
    text = ", ".join(repr(one) for one in arguments)
    return " ".join(text.split()) if len(text) < 300 else " ".join(text.split())[:297] + "..."


def _returns(distance: Floats, bearing: Floats) -> Returns:
    return Returns(distance, bearing, True, False)


def _avoidance_inputs(model: RobotModel) -> list[tuple[Velocity, Returns | None, float]]:
    """What a robot wants among things that come and go."""
    draw = stream(0, "conformance/avoidance")
    inputs: list[tuple[Velocity, Returns | None, float]] = []
    for k in range(STEPS):
        u, w = draw.uniform(-1.0, 1.0, size=2)
        count = int(draw.integers(0, 180))
        bearing = np.sort(draw.uniform(-math.pi, math.pi, size=count))
        seen = None if k % 7 == 3 else _returns(draw.uniform(0.0, 5.0, size=count), bearing)
        wanted = Velocity(float(u) * model.u_max_mps, float(w) * model.w_max_radps)
        inputs.append((wanted, seen, STEP_S if k else 0.0))
    return inputs


def _compensation_inputs(model: RobotModel) -> list[tuple[Velocity, Velocity, bool, float]]:
    """Desired and measured velocities that have little to do with each other, with gaps and cuts."""
    draw = stream(0, "conformance/compensation")
    most = np.array([model.u_max_mps, model.w_max_radps, model.v_max_mps or 0.0])
    inputs = []
    for k in range(STEPS):
        desired, measured = draw.uniform(-1.0, 1.0, size=(2, 3)) * most
        dt_s = 0.0 if k % 20 == 0 else STEP_S
        inputs.append((Velocity(*desired.tolist()), Velocity(*measured.tolist()), k % 5 != 0, dt_s))
    return inputs


def _settled(model: RobotModel, desired: Velocity, told: Callable[..., Any]) -> float:
    """|u~| + |w~| of a drive after 300 s of being told what a law makes of the same desired velocity."""
    th1, th2, th3, th4, th5, th6 = model.theta
    u, w, finer = 0.0, 0.0, 20
    dt_s = STEP_S / finer
    for k in range(3000):
        u_ref, w_ref, _ = told(desired, Velocity(u, w), True, STEP_S if k else 0.0)
        for _ in range(finer):
            du, dw = (th3 * w * w - th4 * u + u_ref) / th1, (-th5 * u * w - th6 * w + w_ref) / th2
            u, w = u + du * dt_s, w + dw * dt_s
    return abs(desired.u - u) + abs(desired.w - w)


def _reachable(model: RobotModel) -> Iterator[tuple[float, Velocity]]:
    """Headings (rad) and velocities that a robot of this type can have."""
    draw = stream(0, "conformance/reachable")
    for _ in range(STEPS):
        psi, u, w, v = (draw.uniform(-1.0, 1.0, size=4)).tolist()
        u, w = u * model.u_max_mps, w * model.w_max_radps
        if model.drive == "car":
            most = min(model.w_max_radps, curvature_max(model) * abs(u))
            w = max(min(w, most), -most)
        yield psi * math.pi, Velocity(u, w, v * (model.v_max_mps or 0.0))
