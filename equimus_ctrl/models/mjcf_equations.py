"""The equations of motion of a MuJoCo model of hinges and slides: MuJoCo's own laws without its time step.

Soft constraints are those of MuJoCo's documentation (*Computation*, "Constraint model"): a limit, a contact without
friction or an equality with violation r has the impedance d(r) and the softness R = (1 − d)/d·A, A being the inverse
inertia that it sees in the model's own pose, and asks for the acceleration −b·ṙ − k·d·r. Dry friction is no soft
constraint here: what sticks stands still.
"""

from __future__ import annotations

import casadi as ca

from equimus_ctrl.models.actuator_laws import Law, actuator_law
from equimus_ctrl.models.parts import Actuation, Held, Inside, Limit, Rubbing
from equimus_ctrl.models.symbolic_model import SymbolicModel
from equimus_ctrl.models.tree import Equations, Link, Spot, Tree, equations
from equimus_ctrl.robots.mjcf.form import ActuatorForm, SpotForm, TreeForm
from equimus_ctrl.robots.mjcf.packing import TINY
from equimus_ctrl.robots.mjcf.parts import SOLIMP

LEAST = 1e-300
"""Keeps roots of sums of squares differentiable at nothing."""
NEAREST = 1e-24
"""The same of a length, which is divided by to the third power [m²]."""


def mjcf_equations(form: TreeForm) -> SymbolicModel:
    """The equations of a form, see ``robots.mjcf.form``; parameters stay symbols."""
    return _Builder(form).model()


class _Builder:
    def __init__(self, form: TreeForm) -> None:
        self.form, n = form, len(form.links)
        self.n = n
        self.q, self.v, self.p = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("p", form.n_parameters)
        self.inside = ca.SX.sym("y", form.n_inside)
        self.places = form.layout
        own = sum(len(a.states) for a in form.actuators)
        # Of drives that turn by themselves: by how much they are ahead of their joints, and their rates.
        self.drives = [self.parameters(f"drive {i}") for i in range(n)] if form.flexible else []
        loose = ca.vertcat(*[drive[0] for drive in self.drives]) if form.flexible else ca.SX(n, 1)
        states = self.inside[own:] if form.flexible else ca.SX(2 * n, 1)
        self.ahead, self.faster, self.turning = loose * states[:n], loose * (states[n:] - self.v), states[n:]

    def parameters(self, block: str) -> list[ca.SX]:
        return [self.p[k] for k in self.places[block]]

    def model(self) -> SymbolicModel:
        form, n, q, v = self.form, self.n, self.q, self.v
        gravity = ca.vertcat(*self.parameters("gravity"))
        links = []
        for i, own in enumerate(form.links):
            link, joint = self.parameters(f"link {i}"), self.parameters(f"joint {i}")
            floated = ca.vertcat(*self.parameters(f"float {i}")) if i in form.floats else None
            masses = link[0], ca.vertcat(*link[1:4]), ca.vertcat(*link[4:])
            place, turn = ca.SX(ca.DM(own.place)), _matrix(own.turn)
            links.append(Link(own.parent, place, turn, own.slides, *masses, joint[0], own.reference, floated))
        rigid = equations(Tree(links, gravity), q, v)
        frames = rigid.frames
        self.frames = frames
        mass, bias = rigid.mass, rigid.bias
        tendons = [self._tendon(t) for t in range(len(form.tendons))]
        self.tendons = tendons
        potential = self._weight(rigid, gravity)
        for i in range(n):
            _, *damping = self.parameters(f"joint {i}")[:4]
            *stiffness, rest = self.parameters(f"joint {i}")[4:8]
            bias[i] += _cubic_damping(damping, v[i]) + _cubic_spring(stiffness, q[i] - rest)
            potential += _stored(stiffness, q[i] - rest)
        for t, (length, row) in enumerate(tendons):
            armature, *damping = self.parameters(f"tendon {t}")[:4]
            *stiffness, low, high = self.parameters(f"tendon {t}")[4:9]
            rate = row @ v
            beyond = ca.fmax(length - high, 0) + ca.fmin(length - low, 0)
            along = _cubic_damping(damping, rate) + _cubic_spring(stiffness, beyond)
            potential += _stored(stiffness, beyond)
            bias += row.T * (along + armature * ca.jtimes(row @ v, q, v))
            mass += armature * _related(form, row.T @ row)
        for i in range(n) if form.tethered else ():
            tether, length, *ends = self.parameters(f"tether {i}")
            hook = Spot(i, ca.vertcat(*ends[:3]))
            away = frames.position(hook) - ca.vertcat(*ends[3:])
            distance = ca.sqrt(ca.sumsqr(away) + NEAREST)
            bias += tether * (1 - length / distance) * (frames.jacobian(hook).T @ away)
            potential += tether * (distance - length) ** 2 / 2
        for k, (first, second) in enumerate(form.coupled):
            _, _, *dampings = self.parameters(f"coupling {k}")
            for sign, size in zip((1, -1), dampings, strict=True):
                row = self._coupled(first, second, sign)
                bias += row.T * (size * (row @ v))
        off_joint = {j for j, through in form.clamped if through}
        through = ca.SX(n, 1)
        for i in range(n):
            if i in off_joint:
                through[i] = rigid.floated[i]
            else:
                bias[i] -= rigid.floated[i]
        actuation, lengths = self._actuation(through if off_joint else None)
        limits = [limit for k in range(len(form.limits)) for limit in self._limit(k)]
        limits += [self._surface()] if form.surfaced else []
        held = [self._equality(k) for k in range(len(form.equalities))]
        rubbing = [Rubbing(kind, i, self._row(kind, i), self.p[at]) for (kind, i), at in form.friction_at.items()]
        return SymbolicModel.assembled(
            q, v, self.p, mass=mass, bias=bias, actuation=actuation, lengths=lengths,
            rest_length=ca.SX(len(form.actuators), 1), limits=limits, held=held, rubbing=rubbing,
            foot=ca.SX(3, 1), knots=ca.horzcat(ca.SX(3, 1), *frames.origin), potential=potential, inside=self.own,
            commands=form.n_commands,
        )  # fmt: skip

    def _coupled(self, first: int, second: int, sign: float | ca.SX) -> ca.SX:
        """(1, n) derivative of the sum of two coordinates, the second counted with a sign."""
        return _unit(self.n, first) + sign * _unit(self.n, second)

    def _row(self, kind: str, i: int) -> ca.SX:
        """(1, n) derivative of the coordinate of a place that can have dry friction."""
        if kind == "coupling":
            return self._coupled(*self.form.coupled[i], self.parameters(f"coupling {i}")[0])
        return self._coordinate(kind, i)[1]

    def _weight(self, rigid: Equations, gravity: ca.SX) -> ca.SX:
        """Potential of gravity, less that of what is held up [J]."""
        whole = ca.SX(0)
        for i in range(self.n):
            link = self.parameters(f"link {i}")[:4]
            if i in self.form.floats:
                link = [a - b for a, b in zip(link, self.parameters(f"float {i}"), strict=True)]
            at = link[0] * rigid.frames.origin[i] + rigid.frames.rotation[i] @ ca.vertcat(*link[1:])
            whole -= ca.dot(gravity, at)
        return whole

    def _tendon(self, t: int) -> tuple[ca.SX, ca.SX]:
        """Length and (1, n) its slope."""
        own = self.form.tendons[t]
        if own.joints:
            row = ca.SX(1, self.n)
            for j, coefficient in own.joints:
                row[j] += coefficient
            return row @ self.q, row
        length, row = ca.SX(0), ca.SX(1, self.n)
        for divisor, spots in own.branches:
            places = [self.frames.position(_spot(s)) for s in spots]
            arms = [self.frames.jacobian(_spot(s)) for s in spots]
            for k in range(len(spots) - 1):
                way = places[k + 1] - places[k]
                long = ca.sqrt(ca.sumsqr(way))
                length += long / divisor
                row += (way / long).T @ (arms[k + 1] - arms[k]) / divisor
        return length, row

    def _actuation(self, through: ca.SX | None) -> tuple[Actuation, ca.SX]:
        form, n = self.form, self.n
        lengths: list[ca.SX] = []
        rows: list[ca.SX] = []
        gains: list[ca.SX] = []
        lows: list[ca.SX] = []
        highs: list[ca.SX] = []
        laws: list[Law] = []
        for i, own in enumerate(form.actuators):
            parameters = self.parameters(f"actuator {i}")
            length, row = self._transmission(own)
            low, high = parameters[6:8] if own.law == "affine" else parameters[30:32]
            for column, entry in ((lengths, length), (rows, row), (lows, low), (highs, high)):
                column.append(entry)
            inside = self.inside[sum(len(a.states) for a in form.actuators[:i]) :][: len(own.states)]
            ahead, faster = (self.ahead, self.faster) if own.transmission == "joint" else (ca.SX(n, 1), ca.SX(n, 1))
            laws.append(actuator_law(own, parameters, length + row @ ahead, row @ (self.v + faster), inside))
            gains.append(laws[-1].gain)
        shared = []
        for t in form.clamped_tendons:
            members = [i for i, a in enumerate(form.actuators) if a.transmission == "tendon" and a.target == t]
            if members:
                low, high = self.parameters(f"clamp tendon {t}")
                shared.append((members, low, high))
        joints = []
        for j, _ in form.clamped:
            low, high = self.parameters(f"clamp {j}")
            joints.append((j, low, high))
        none, controls = ca.SX(0, 1), [range(a.control, a.control + len(a.inputs)) for a in form.actuators]

        def along(u: ca.SX) -> ca.SX:
            return ca.vertcat(*[law.force([u[k] for k in own]) for law, own in zip(laws, controls, strict=True)], none)

        def rate(u: ca.SX) -> ca.SX:
            found = [law.rates([u[k] for k in own]) for law, own in zip(laws, controls, strict=True)]
            moving = self._drive_rates(actuation.drive(u)[0]) if form.flexible else none
            return ca.vertcat(*[r for part in found for r in part], moving)

        motors = any(a.law == "dcmotor" for a in form.actuators)
        beside = ca.vertcat(*[law.beside for law in laws], none) if motors else None
        kept = [state for law in laws for state in law.kept]
        rest = ca.SX.zeros(self.inside.numel())
        if form.flexible:
            kept += ca.vertsplit(self.inside[len(kept) :])
            rest[-n:] = self.v
        self.own = Inside(self.inside, rate, rest, ca.vertcat(*kept, none), self._quickness_of_drives())
        actuation = Actuation(
            ca.vertcat(*rows, ca.SX(0, n)), ca.vertcat(*gains, none), ca.SX(len(rows), 1), along,
            (ca.vertcat(*lows, none), ca.vertcat(*highs, none)), beside, shared, joints, through,
            [i for i, a in enumerate(form.actuators) if a.transmission == "joint"],
            self._felt if form.flexible else None,
        )  # fmt: skip
        return actuation, ca.vertcat(*lengths, none)

    def _springs(self) -> list[ca.SX]:
        """What drives that turn by themselves exert on their joints: a spring and a damper, or the ends of a play."""
        found = []
        for i, (_, _, stiffness, damping, play, hard, dull, _) in enumerate(self.drives):
            ahead, faster = self.ahead[i], self.faster[i]
            beyond = ca.fmax(ahead - play, 0) + ca.fmin(ahead + play, 0)
            end = hard * beyond + dull * faster * (ca.fabs(ahead) > play)
            at_end = ca.if_else(beyond > 0, ca.fmax(end, 0), ca.fmin(end, 0))
            found.append(stiffness * ahead + damping * faster + at_end)
        return found

    def _felt(self, torque: ca.SX) -> ca.SX:
        loose = ca.vertcat(*[drive[0] for drive in self.drives])
        return (1 - loose) * torque + loose * ca.vertcat(*self._springs())

    def _drive_rates(self, torque: ca.SX) -> ca.SX:
        rates = [
            drive[0] * (torque[i] - spring) / drive[1]
            for i, (drive, spring) in enumerate(zip(self.drives, self._springs(), strict=True))
        ]
        return ca.vertcat(self.faster, *rates)

    def _quickness_of_drives(self) -> ca.SX:
        fastest = ca.SX(0)
        for loose, _, stiffness, damping, _, hard, dull, inverse in self.drives:
            by_spring = ca.sqrt((stiffness + hard) * inverse)
            fastest = ca.fmax(fastest, loose * ca.fmax(by_spring, (damping + dull) * inverse))
        return fastest

    def _transmission(self, own: ActuatorForm) -> tuple[ca.SX, ca.SX]:
        """Length and (1, n) moment arms, gear included."""
        frames, gear = self.frames, own.gear
        if own.transmission == "joint":
            return gear[0] * self.q[own.target], gear[0] * _unit(self.n, own.target)
        if own.transmission == "tendon":
            length, row = self.tendons[own.target]
            return gear[0] * length, gear[0] * row
        straight, round_about = ca.DM(gear[:3]), ca.DM(gear[3:])
        spots = [_spot(s) for s in own.spots]
        places = [frames.position(s) for s in spots]
        arms = [frames.jacobian(s) for s in spots]
        turns = [frames.turn_jacobian(s.link) for s in spots]
        axes = [frames.of(s.link)[0] @ _matrix(f.turn) for s, f in zip(spots, own.spots, strict=True)]
        if own.transmission == "site":
            return ca.SX(0), (axes[0] @ straight).T @ arms[0] + (axes[0] @ round_about).T @ turns[0]
        if own.transmission == "between":
            way = axes[1].T @ (places[0] - places[1])
            length = ca.dot(straight, way)
            if any(gear[3:]):
                length = length + ca.dot(round_about, _rotation_vector(axes[1].T @ axes[0]))
            row = (axes[1] @ straight).T @ (arms[0] - arms[1]) + (axes[1] @ round_about).T @ (turns[0] - turns[1])
            # MuJoCo ignores the joints that carry both.
            for k in set(frames.carriers(spots[0].link)) & set(frames.carriers(spots[1].link)):
                row[k] = 0
            return length, row
        rod, axis = places[0] - places[1], axes[1][:, 2]
        along = ca.dot(rod, axis)
        square = along**2 + own.rod**2 - ca.sumsqr(rod)
        length = gear[0] * (along - ca.sqrt(ca.fmax(square, LEAST)))
        return length, ca.jacobian(length, self.q)

    def _coordinate(self, kind: str, index: int) -> tuple[ca.SX, ca.SX]:
        return (self.q[index], _unit(self.n, index)) if kind == "joint" else self.tendons[index]

    def _limit(self, k: int) -> list[Limit]:
        own = self.form.limits[k]
        low, high, margin, stiffness, damping, *impedance, inverse = self.parameters(f"limit {k}")
        x, row = self._coordinate(own.kind, own.index)
        soft = stiffness, damping, impedance, own.power, inverse
        return [self._soft_limit(short - margin, side, *soft) for short, side in ((x - low, row), (high - x, -row))]

    def _surface(self) -> Limit:
        """MuJoCo's contact without friction of the one point that may touch a surface."""
        *up, height, stiffness, damping, least, most, width, middle, inverse = self.parameters("surface")
        above, row = -height, ca.SX(1, self.n)
        for i in range(self.n):
            touches, *point = self.parameters(f"touch {i}")
            spot = Spot(i, ca.vertcat(*point))
            above += touches * ca.dot(ca.vertcat(*up), self.frames.position(spot))
            row += touches * (ca.vertcat(*up).T @ self.frames.jacobian(spot))
        return self._soft_limit(above, row, stiffness, damping, [least, most, width, middle], SOLIMP[4], inverse)

    def _soft_limit(
        self, short: ca.SX, row: ca.SX, stiffness: ca.SX, damping: ca.SX, impedance: list[ca.SX], power: float,
        inverse: ca.SX,
    ) -> Limit:  # fmt: skip
        """A limit of which a coordinate is so far short that has this derivative."""
        d = _impedance(ca.fabs(short), impedance, power)
        return Limit(
            -short,
            row,
            target=-damping * (row @ self.v) - stiffness * d * short,
            softness=ca.fmax((1 - d) / d * inverse, TINY),
            quickness=ca.fmax(damping, ca.sqrt(ca.fmax(stiffness, 0))),
        )

    def _equality(self, k: int) -> Held:
        own = self.form.equalities[k]
        c0, *c = self.parameters(f"equality {k}")[:5]
        stiffness, damping, *impedance, inverse = self.parameters(f"equality {k}")[5:]
        x, row = self._coordinate(own.kind, own.first)
        off = x - own.rest[0] - c0
        if own.second >= 0:
            other, slope = self._coordinate(own.kind, own.second)
            y = other - own.rest[1]
            off = off - y * (c[0] + y * (c[1] + y * (c[2] + y * c[3])))
            row = row - slope * (c[0] + y * (2 * c[1] + y * (3 * c[2] + y * 4 * c[3])))
        d = _impedance(ca.fabs(off), impedance, own.power)
        target = -damping * (row @ self.v) - stiffness * d * off
        return Held(row, target, ca.fmax((1 - d) / d * inverse, TINY))


def _matrix(rows: tuple[float, ...]) -> ca.SX:
    return ca.SX(ca.DM([list(rows[3 * k : 3 * k + 3]) for k in range(3)]))


def _spot(own: SpotForm) -> Spot:
    return Spot(own.link, ca.SX(ca.DM(own.place)))


def _unit(n: int, i: int) -> ca.SX:
    row = ca.SX(1, n)
    row[i] = 1
    return row


def _cubic_damping(c: list[ca.SX], rate: ca.SX) -> ca.SX:
    return rate * (c[0] + ca.fabs(rate) * (c[1] + ca.fabs(rate) * c[2]))


def _cubic_spring(c: list[ca.SX], x: ca.SX) -> ca.SX:
    return x * (c[0] + x * (c[1] + x * c[2]))


def _stored(c: list[ca.SX], x: ca.SX) -> ca.SX:
    return x * x * (c[0] / 2 + x * (c[1] / 3 + x * c[2] / 4))


def _related(form: TreeForm, square: ca.SX) -> ca.SX:
    """A tendon's part of the mass matrix without the entries between branches, which MuJoCo has no place for."""
    above = []
    for i in range(len(form.links)):
        own, k = {i}, form.links[i].parent
        while k >= 0:
            own.add(k)
            k = form.links[k].parent
        above.append(own)
    for i in range(len(above)):
        for j in range(len(above)):
            if i not in above[j] and j not in above[i]:
                square[i, j] = 0
    return square


def _impedance(violation: ca.SX, parameters: list[ca.SX], power: float) -> ca.SX:
    """MuJoCo's d(r) of a violation's size; see its documentation, "Solver parameters"."""
    least, most, width, middle = parameters
    x = ca.fmin(violation / width, 1)
    if power == 1:
        return least + x * (most - least)
    rising = x**power / middle ** (power - 1)
    falling = 1 - (1 - x) ** power / (1 - middle) ** (power - 1)
    return least + ca.if_else(x <= middle, rising, falling) * (most - least)


def _rotation_vector(turn: ca.SX) -> ca.SX:
    """(3,) axis times angle of a rotation matrix, the angle within ±π."""
    twice = ca.vertcat(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    sine = ca.sqrt(ca.sumsqr(twice) + LEAST)
    return twice * (ca.atan2(sine, ca.trace(turn) - 1) / sine)
