"""Plans that look where they lead, for the sampling control of robots that cannot follow any path.

Some joint has no actuator, something may touch, or no equations of motion hold the robot. What plans are stands in
``predictive.policies``. One costs

    Σ ½ T (|e/s|² + r² |δu/h|²)  +  H (½ |e_N/s|² + w ((E_N − E*)/ΔE)²)  +  min(½ eᵀ_N P e_N, H)

over a horizon of H: errors e in the robot's own scales s (``predictive.measures``), commands beyond what the reference
asks for in half their ranges h, what energy is lacking at the end, where actuators cannot do any motion, and what the
regulator would cost from there on, as far as a linear model holds. Nothing but options says how many plans
are tried, so that a run gives the same bits each time, however quick the computer is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from equimus_ctrl.controllers.inverse import SMOOTHING
from equimus_ctrl.controllers.sampling_settings import SamplingSettings
from equimus_ctrl.effects.sensors import SENSOR_DELAY, behind, sensor_settings
from equimus_ctrl.effects.valves import shaped_commands, shaping_effects
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.errors import ControllerError, NotAvailable
from equimus_ctrl.estimation.predicted import Known, Predicted
from equimus_ctrl.models.dynamics import Dynamics
from equimus_ctrl.models.model import Model
from equimus_ctrl.predictive.costs import Wanted
from equimus_ctrl.predictive.energy import Energy
from equimus_ctrl.predictive.forward import Forward, make_forward, slopes_of
from equimus_ctrl.predictive.measures import Measures, measures_of
from equimus_ctrl.predictive.policies import Path, Plans, Policies, Settler, Valves, drawn, settler
from equimus_ctrl.predictive.sampling import Memory, Method, Spread
from equimus_ctrl.predictive.splines import Spline
from equimus_ctrl.types import Array, Observation, PlantSpec, Reference, frozen_array

Penalty = Callable[[Array, Array, Array, Wanted], Array]
"""(times (n + 1,) [s], states (m, n + 1, 2 nj), commands (m, n, na), what is wanted) → (m,) what is added to costs."""

SPARING = 1.0
"""Effort of the second regulator: a command of half its range costs as much as an error of a whole scale. It asks least
of actuators, so that it works farthest from a pose within their limits."""
QUARTERS = 4.0
"""Knots to a period of the fastest motion: a swing is accelerated and braked on either side."""
MOST_STEPS = 400
"""Of a horizon: no motion is looked ahead over more control periods."""
LACKING = 1e-6
"""Smallest singular value of M⁻¹B, as a share of the largest, that moves anything."""
BESIDE = 1e-6
"""Share of a robot's scales by which rollouts that slopes are differences of begin beside each other."""
SAME = 1e-6
"""Share of a control period by which two instants may differ that are one."""


@dataclass(frozen=True, eq=False)
class Waiting:
    """A robot of which nobody has said yet where it is to be.

    Attributes:
        settings: of the controller.
        spec: of its plant.
        observation: the first.
        model: what is known of it.
        forward: the same a control period on.
        dynamics: its equations of motion, None where none hold it.
        note: by what plans are rolled out, for a person to read.
    """

    settings: SamplingSettings
    spec: PlantSpec
    observation: Observation
    model: Model
    forward: Forward
    dynamics: Dynamics | None
    note: str


@dataclass(frozen=True, eq=False)
class PolicyTools:
    """What is made once for a plant."""

    model: Model
    policies: Policies
    dynamics: Dynamics | None
    filter: Predicted
    sensor: Array
    steps: int


@dataclass(frozen=True, eq=False)
class PolicyState:
    """What the controller carries from step to step.

    Attributes:
        known: of the robot.
        behind: (na,) what is behind its valves.
        under_way: (m, na) commands that may still be on their way, the oldest first.
        plan: the one that is followed, as seen when it was found.
        age: for how many control periods.
        memory: of the method.
        cost: (samples,) of the latest plans, the nominal one first; infinite where a rollout was lost.
        ahead: (first instant [s], states wanted (n, 2 nj), commands (n, na)) of the reference that are known.
        count: how many instants there have been, which the generator's numbers follow from.
        status: ``"sampled"`` where a plan of this instant or of the latest that one was looked for stands behind the
            command, ``"shifted"`` where none could be rolled out then.
        note: by what plans are rolled out, and what is lacking, for a person to read.
        tools: made for the plant once.
        settings: of the controller.
    """

    known: Known
    behind: Array
    under_way: Array
    plan: Plans
    age: int
    memory: Memory
    cost: Array
    ahead: tuple[float, Array, Array] | None
    count: int
    status: str
    note: str
    tools: PolicyTools
    settings: SamplingSettings


def begin(settings: SamplingSettings, spec: PlantSpec, observation: Observation) -> Waiting:
    """The state of a robot at rest.

    Args:
        settings: of the controller.
        spec: of the plant.
        observation: the first.

    Raises:
        ControllerError: where the robot cannot be rolled out.
        ConfigError: where the engine does not hold something of it.
    """
    model = Model(spec.model, spec.effects, spec.phase)
    if not np.all(np.isfinite(observation.position)):
        raise ControllerError(f"the first measured positions are {observation.position.tolist()}, expected numbers")
    try:
        forward = make_forward(model, settings.samples, spec.control_dt, settings.engine, settings.compiled)
    except NotAvailable as error:
        raise ControllerError(str(error)) from None
    called = "exact equations of motion" if forward.name == "exact" else "XML in MuJoCo"
    note = f"plans are rolled out by the {called}: {forward.why}"
    try:
        return Waiting(settings, spec, observation, model, forward, Dynamics(model), note)
    except NotAvailable:
        note += "; no regulator ends them and no energy guides them, for no equations of motion hold the robot"
        return Waiting(settings, spec, observation, model, forward, None, note)


def _begun(method: Method, state: Waiting, pose: Array) -> PolicyState:
    """The same once it is known where it is to be, (nj,): what plans are measured by is that of this pose."""
    s, spec, model, forward, dynamics = state.settings, state.spec, state.model, state.forward, state.dynamics
    observation, dt = state.observation, spec.control_dt
    own = measures_of(spec, pose, forward, dynamics)
    valves = _valves(model, dt)
    settlers, energy, span = _guides(s, model, dynamics, own, valves, dt, pose)
    note = state.note
    if dynamics is not None and not settlers:
        note += "; no regulator ends them, for the actuators cannot make the robot stable about the wanted pose"
    steps = int(np.clip(round((s.horizon or 2 * np.pi / own.rate) / dt), 4, MOST_STEPS))
    knots = s.knots or int(np.clip(math.ceil(QUARTERS * steps * dt * own.fastest / (2 * np.pi)), 4, steps))
    spline = Spline(s.spline, knots, steps * dt)
    low, high = np.array(spec.command_low), np.array(spec.command_high)
    policies = Policies(forward, valves, own, spline, dt, low, high, settlers, energy, span)
    strongest = own.position * own.rate**2
    if dynamics is not None:
        drive = dynamics.authority(pose, np.zeros_like(pose))[0]
        pushed = np.abs(np.linalg.solve(dynamics.mass(pose), drive)) @ own.command
        strongest = np.where(pushed > LACKING * pushed.max(initial=0.0), pushed, strongest)
    sensor = sensor_settings(model.effects, spec.joints)
    late, seen = sensor[:, SENSOR_DELAY], s.observer
    follower = Predicted(dt, spec.joints, s.unexplained * strongest, seen.noise, late, seen.patience)
    q = behind(sensor, np.array(observation.position))
    command = np.array(observation.command)
    arriving = valves.shaped(command[None])[0]
    known = follower.begin(forward.begin(q, np.zeros_like(q), arriving), q, observation.time, observation.stamp)
    shape = (knots, len(low))
    tools = PolicyTools(model, policies, dynamics, follower, sensor, steps)
    return PolicyState(
        known, arriving, np.tile(command, (valves.memory, 1)), Plans.none(*shape), 0, method.begin(shape, _spread(s)),
        np.empty(0), None, 0, "sampled", note, tools, s,
    )  # fmt: skip


def _valves(model: Model, dt: float) -> Valves:
    """What arrives of the commands of a model."""
    valve, names, ranges = realise(model).valve, model.robot.actuator_names, model.robot.command_ranges
    if not shaping_effects(model.effects):
        return Valves(valve, dt)
    return Valves(valve, dt, lambda rows: shaped_commands(model.effects, names, rows, ranges))


def _spread(s: SamplingSettings) -> Spread:
    return Spread(s.least_deviation, s.deviation, s.temperature, s.elites)


def _guides(
    s: SamplingSettings,
    model: Model,
    dynamics: Dynamics | None,
    own: Measures,
    valves: Valves,
    dt: float,
    pose: Array,
) -> tuple[tuple[Settler, ...], Energy | None, float]:
    """Regulators about a pose, and the energy where actuators cannot do any motion, with ΔE [J]."""
    if dynamics is None:
        return (), None, 1.0
    linear = dynamics.linear(pose)
    efforts: list[Array] = [own.command / effort for effort in sorted({s.effort, SPARING})]
    found = [settler(linear, valves, dt, own.state, effort) for effort in efforts]
    settlers = tuple(one for one in found if one is not None)
    moved = np.linalg.svd(np.linalg.solve(linear.mass, linear.drive * own.command), compute_uv=False)
    ways = int((moved > LACKING * moved.max(initial=0.0)).sum())
    if ways == len(pose) or not ways or not s.energy:
        return settlers, None, 1.0
    energy = Energy(model, s.samples, s.compiled)
    span = energy.span(pose, own.position, *dynamics.robot.joint_range)
    return settlers, energy if span > 0 else None, span or 1.0


def step(
    method: Method,
    penalty: Penalty | None,
    observation: Observation,
    reference: Reference,
    state: PolicyState | Waiting,
) -> tuple[Array, PolicyState]:
    """The next command, within the plant's limits, and the next state.

    Raises:
        ControllerError: where a joint was not measured for too long.
    """
    s = state.settings
    if isinstance(state, Waiting):
        state = _begun(method, state, np.array(reference.position(observation.time)))
    else:
        state = _observed(observation, state)
    t = state.tools
    p = t.policies
    ahead = _ahead(reference, observation.time, state)
    energy = math.nan if p.energy is None else float(p.energy(ahead[1][t.steps][None])[0][0])
    path = Path(ahead[1], ahead[2], energy)
    if state.count == 0 or state.age >= s.every:
        nominal = state.plan.later(state.age * p.period, p.spline)
        state = _planned(s, method, penalty, nominal, path, state)
    x, under_way = p.forward.joints(state.known.state)[None], state.under_way[None]
    at = state.age * p.period
    command = p.commands(state.plan, at, x, under_way, path, p.splines(state.plan, np.array([at]))[:, 0])[0]
    return frozen_array(command), replace(state, age=state.age + 1, ahead=ahead, count=state.count + 1)


def _observed(observation: Observation, state: PolicyState) -> PolicyState:
    """What is known a control period later, in which the command that is observed was in force."""
    t = state.tools
    p = t.policies
    sent = np.concatenate([state.under_way, np.array(observation.command)[None]])
    mean, held = p.valves.through(state.behind[None], p.valves.arriving(sent[None]))
    ahead = p.forward(state.known.state[None], mean)[0]
    if not np.all(np.isfinite(ahead)):
        raise ControllerError(
            f"{t.model.name}: the model that predicts its motion diverged at {observation.time:.3f} s"
        )
    slopes = slopes_of(p.forward, state.known.state, mean[0], ahead, BESIDE * p.measures.state)
    y = behind(t.sensor, np.array(observation.position))
    measured = observation.time, observation.stamp, y
    known = t.filter.corrected(state.known, ahead, slopes, p.forward.joints, p.forward.placed, measured)
    return replace(state, known=known, behind=held[0], under_way=sent[1:])


def _ahead(reference: Reference, now: float, state: PolicyState) -> tuple[float, Array, Array]:
    """Where the robot is to be from now on (steps + 1, 2 nj), and commands for that (steps, na); each read once."""
    t = state.tools
    dt = t.policies.period

    def wanted(time: float) -> tuple[Array, Array]:
        before, here, after = (
            np.array(reference.position(max(time + side * SMOOTHING, 0.0)), dtype=np.float64) for side in (-1, 0, 1)
        )
        v, a = (after - before) / (2 * SMOOTHING), (after - 2 * here + before) / SMOOTHING**2
        feed = np.zeros(len(t.policies.low))
        if t.dynamics is not None:
            feed = t.dynamics.commands(here, v, t.dynamics.needed(here, v, a))
        return np.concatenate([here, v]), np.clip(feed, t.policies.low, t.policies.high)

    known = state.ahead
    if known is not None and abs(known[0] + dt - now) < SAME * dt:
        state_then, _ = last = wanted(now + t.steps * dt)
        feed = wanted(now + (t.steps - 1) * dt)[1] if not np.array_equal(state_then, known[1][-1]) else known[2][-1]
        return now, np.vstack([known[1][1:], last[0]]), np.vstack([known[2][1:], feed])
    found = [wanted(now + k * dt) for k in range(t.steps + 1)]
    return now, np.array([own for own, _ in found]), np.array([own for _, own in found[:-1]])


def _planned(
    s: SamplingSettings,
    method: Method,
    penalty: Penalty | None,
    nominal: Plans,
    path: Path,
    state: PolicyState,
) -> PolicyState:
    """The state with the plan of this instant, or with that of before, shifted, where all rollouts are lost."""
    p = state.tools.policies
    rng = np.random.Generator(np.random.Philox(key=s.seed, counter=[0, 0, 0, state.count]))
    horizon, memory, cost = len(path.feed) * p.period, state.memory, state.cost
    feed = path.feed[np.minimum(p.spline.times / p.period, len(path.feed) - 1).astype(int)]
    # Knots beyond the limits of commands would cost the same as those at them.
    low, high = ((end - feed) / p.measures.command for end in (p.low, p.high))
    status = "sampled"
    for _ in range(s.iterations):
        knots = method.draw(rng, nominal.knots[0], memory, s.samples - 1, _spread(s))
        knots = np.clip(np.concatenate([nominal.knots, knots]), low, high)
        plans = drawn(rng, nominal, knots, horizon, p.energy is not None, len(p.settlers))
        cost = _cost(s, penalty, plans, path, state)
        if not np.isfinite(cost).any():
            status = "shifted"
            break
        own, memory = method.update(knots, cost, memory, _spread(s))
        nominal = plans.one(int(np.argmin(cost)), own)
    return replace(state, plan=nominal, age=0, memory=memory, cost=frozen_array(cost), status=status)


def _cost(s: SamplingSettings, penalty: Penalty | None, plans: Plans, path: Path, state: PolicyState) -> Array:
    """(n,) of plans; infinite where a rollout is lost."""
    p = state.tools.policies
    with np.errstate(all="ignore"):  # what diverges may overflow
        states, sent = p.rolled(plans, state.known.state, state.behind, state.under_way, path)
        errors = p.measures.errors(states[:, 1:], path.states[1:])
        efforts = s.effort * (sent - path.feed) / p.measures.command
        scaled = (errors / p.measures.state) ** 2
        found: Array = 0.5 * p.period * (scaled.sum(axis=(1, 2)) + (efforts**2).sum(axis=(1, 2)))
        horizon = len(path.feed) * p.period
        found += horizon * 0.5 * scaled[:, -1].sum(axis=1)
        if p.energy is not None:
            lacking = (p.energy(np.array(states[:, -1]))[0] - path.energy) / p.span
            found += horizon * s.energy * lacking**2
        if p.settlers:
            # Of the regulator that asks least of actuators: its cost grows with what is beyond their means.
            behind_it = 0.5 * np.einsum("ni,ij,nj->n", errors[:, -1], p.settlers[-1].cost, errors[:, -1])
            found += np.minimum(behind_it, horizon)
        if penalty is not None:
            times = np.asarray(p.period * np.arange(len(path.states)), dtype=np.float64)
            found += penalty(times, states, sent, Wanted(path.states, path.feed, np.zeros((0, 0))))
    return np.where(np.isfinite(found), found, np.inf)
