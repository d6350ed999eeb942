"""Parameters of a model from poses at rest under known pressures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, lsq_linear

from equimus_ctrl.effects.base import require_simulated
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.sensors import SCALE, sensor_settings, shown
from equimus_ctrl.effects.valves import shaped_commands
from equimus_ctrl.engines.encoding import encode
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.uncertainty import Uncertainty, uncertainty
from equimus_ctrl.models.augmented import Laws, augmented_model
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.models.symbolic import build
from equimus_ctrl.robots.elastic.morphology import Phase, structure
from equimus_ctrl.robots.mechanics import Structure
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

STATIC_KINDS = ("stiffness", "area", "rest_length")
NEWTON_STEPS = 60
START_DAMPING = 1.0
"""[N·m/rad]"""
FOLDS = 6
REST_TORQUE = 1e-10
"""Torque [N·m] below which a pose counts as at rest."""
EXACT = 1e-9
"""Residuals [rad] this small leave nothing to search for; scipy divides by them."""
LOST = 3.0
"""Residual of a pose for which the model has no stable equilibrium nearby [rad]."""
STOP_MARGIN = 0.04
"""A joint measured this near a stop may lean on it: stops give way, and where they begin is known no better [rad]."""


@lru_cache(maxsize=16)
def _balance(form: Structure, phase: Phase, laws: Laws) -> ca.Function:
    """(q, P, p) → torque at rest (nj) and ∂/∂q; dry friction takes no part."""
    m = augmented_model(form, phase, laws)
    mass = ca.substitute(build(form, phase).mass, build(form, phase).p, m.p[: build(form, phase).p.numel()])
    still = ca.substitute(mass @ m.acceleration, m.z, m.rest_state) if m.z.numel() else mass @ m.acceleration
    for symbol in (m.v, m.phi):
        still = ca.substitute(still, symbol, ca.SX.zeros(symbol.shape))
    return ca.Function("balance", [m.q, m.pressure, m.p], [still, ca.jacobian(still, m.q)])


@lru_cache(maxsize=16)
def _by_parameters(form: Structure, phase: Phase, laws: Laws) -> ca.Function:
    """(q, P, p) → ∂torque/∂p (nj, np)."""
    balance = _balance(form, phase, laws)
    symbols = balance.sx_in()
    return ca.Function("by_parameters", symbols, [ca.jacobian(balance(*symbols)[0], symbols[2])])


def static_names(model: Model) -> list[str]:
    """Parameters that poses at rest identify: stiffness, area and rest length of every actuator."""
    return [f"{a.name}.{key}" for key in STATIC_KINDS for a in model.morphology.actuators]


@dataclass(frozen=True, eq=False, repr=False)
class RestPoses(Short):
    """Where a model rests under given pressures.

    Attributes:
        position: (n, nj) measured angles, sensors included [rad].
        angles: (n, nj) joint angles [rad].
        found: (n,) whether a stable equilibrium was found.
        unstable: (n,) whether an unstable equilibrium was found.
        by_parameter: (n, nj, np) ∂position/∂p of the parameter vector.
    """

    position: Array
    angles: Array
    found: NDArray[np.bool_]
    unstable: NDArray[np.bool_]
    by_parameter: Array


def rest_poses(model: Model, pressure: Array, guess: Array) -> RestPoses:
    """Equilibria under constant pressures, by Newton's method damped as a motion through honey would be.

    Steps solve (δ − ∂τ/∂q) Δq = τ, with δ shrinking as the torque τ does, which leads to stable equilibria and copes
    with the kinks that joint stops make (pseudo-transient continuation, Kelley and Keyes, 1998).

    Args:
        model: whose; its dry friction is ignored.
        pressure: (n, na) commanded [Pa].
        guess: (n, nj) angles to look from [rad].
    """
    require_simulated(model.effects, f"{model.name}: statics")
    m = model.morphology
    encoded = encode([model])
    laws, parameters = encoded.laws, encoded.parameters[0]
    reached = shaped_commands(model.effects, m.actuator_names, pressure)
    n, nj = guess.shape
    form = structure(m)
    balance = _balance(form, model.phase, laws).map(n)
    columns = np.tile(parameters[:, None], (1, n))

    def at(q: Array) -> tuple[Array, Array, Array]:
        torque, slope = balance(q.T, reached.T, columns)
        found = np.array(torque).T
        return found, np.array(slope).reshape(nj, n, nj).transpose(1, 0, 2), np.abs(found).max(axis=1)

    q = np.array(guess)
    torque, slope, size = at(q)
    damping = np.full(n, START_DAMPING)
    for _ in range(NEWTON_STEPS):
        if np.all(size < REST_TORQUE):
            break
        step = np.linalg.solve(damping[:, None, None] * np.eye(nj) - slope, torque[:, :, None])[:, :, 0]
        q = q + step * np.minimum(1.0, 0.3 / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
        past = size
        torque, slope, size = at(q)
        damping = np.clip(damping * size / np.maximum(past, 1e-300), 1e-12, 1e3)
    still = size < 1e-6
    # At rest the slope is that of forces from a potential; without one the symmetric part decides.
    stable = np.linalg.eigvalsh((slope + slope.transpose(0, 2, 1)) / 2).max(axis=1) < 0
    found = still & stable
    slope[~found] = -np.eye(nj)  # no derivative where nothing rests
    by_p = _by_parameters(form, model.phase, laws).map(n)(q.T, reached.T, columns)
    by_parameter = -np.linalg.solve(slope, np.array(by_p).reshape(nj, n, -1).transpose(1, 0, 2))
    sensor = sensor_settings(model.effects, m.joint_names)
    position = shown(sensor, q)
    by_parameter[~found] = 0.0
    return RestPoses(position, q, found, still & ~stable, by_parameter * sensor[:, SCALE][None, :, None])


@dataclass(frozen=True, eq=False, repr=False)
class StaticFit(Short):
    """Parameters found from poses at rest.

    Attributes:
        parameters: what was free.
        theta: (p,) found.
        linear: (p,) where a linear regression of the torques began, or the model's own values.
        model: with ``theta``.
        residuals: (n, nj) measured − resting angles [rad].
        before: the same of the initial model.
        heldout: (n, nj) residual of each pose under parameters fitted without it and its fold [rad].
        folds: how many such fits were made.
        pressure_error: (n, na) pressures that would hold the measured poses, less those commanded [Pa]; nan where a
            joint may lean on a stop.
        uncertainty: of ``theta``.
        at_bound: (p,) −1, 0, 1.
    """

    parameters: FreeParameters
    theta: Array
    linear: Array
    model: Model
    residuals: Array
    before: Array
    heldout: Array
    folds: int
    pressure_error: Array
    uncertainty: Uncertainty
    at_bound: Array

    @property
    def rmse(self) -> Array:
        """(nj,) [rad]."""
        return np.asarray(np.sqrt((self.residuals**2).mean(axis=0)))


def fit_static(
    parameters: FreeParameters,
    pressure: Array,
    position: Array,
    *,
    confidence: float = 0.95,
    notify: Callable[[float], None] = lambda share: None,
) -> StaticFit:
    """Least squares between measured and resting angles, from a linear regression of the torque balance.

    Where stiffness, area and rest length of actuators are free the balance Σ Jᵀ(s P − k l + k l0) = ∂V/∂q is linear
    in s, k and k·l0; its solution starts the search, which itself measures errors as angles.

    Args:
        parameters: what is free.
        pressure: (n, na) [Pa].
        position: (n, nj) measured [rad].
        confidence: of the intervals.
        notify: called with the share done.

    Raises:
        ConfigError: where there are too few poses, or nothing is free.
    """
    model = parameters.model
    n, nj = position.shape
    p = len(parameters.free)
    if not p:
        raise ConfigError(f"{model.name}: no parameter is free, so there is nothing to identify")
    if n * nj <= p + 1:
        raise ConfigError(f"{n} poses are too few to identify {p} parameters from; expected more than {(p + 1) // nj}")
    before = pose_residuals(model, pressure, position)
    linear = _linear_start(parameters, pressure, position)
    starts = [linear] if np.array_equal(linear, parameters.start) else [linear, parameters.start]
    thetas = [_search(parameters, pressure, position, start) for start in starts]
    theta = min(thetas, key=lambda x: _cost(parameters, pressure, position, x))
    resting = rest_poses(parameters.model_at(theta), pressure, position)
    residuals = _residuals(resting, position)
    heldout = np.empty_like(residuals)
    folds = min(FOLDS, n)
    for k in range(folds):
        own = np.arange(n) % folds == k
        others = _search(parameters, pressure[~own], position[~own], theta)
        heldout[own] = pose_residuals(parameters.model_at(others), pressure[own], position[own])
        notify((k + 1) / folds)
    slopes = _by_theta(parameters, theta, resting)
    known = uncertainty(
        [slopes[[k]] for k in range(n)],
        [residuals[[k]] for k in range(n)],
        [np.zeros((1, nj, 0))] * n,
        parameters.names,
        parameters.scale,
        theta,
        confidence,
    )
    fitted = parameters.model_at(theta)
    kinematics = Kinematics(changed_bodies(fitted.effects, fitted.morphology), model.phase)
    shaped = shaped_commands(fitted.effects, model.robot.actuator_names, pressure)
    needed = np.array([kinematics.static_pressure(q) for q in position])
    needed[pressed(model, position)] = np.nan
    spread = parameters.high - parameters.low
    low, high = theta - parameters.low < 1e-6 * spread, parameters.high - theta < 1e-6 * spread
    return StaticFit(
        parameters, theta, linear, fitted, residuals, before, heldout, folds, needed - shaped, known,
        high.astype(int) - low.astype(int),
    )  # fmt: skip


def pressed(model: Model, position: Array) -> NDArray[np.bool_]:
    """(n,) poses in which a joint may lean on a stop, which then carries an unknown part of the load."""
    low, high = changed_bodies(model.effects, model.morphology).joint_range
    return np.asarray(np.any((position < low + STOP_MARGIN) | (position > high - STOP_MARGIN), axis=1))


def _cost(parameters: FreeParameters, pressure: Array, position: Array, theta: Array) -> float:
    return float((pose_residuals(parameters.model_at(theta), pressure, position) ** 2).sum())


def pose_residuals(model: Model, pressure: Array, position: Array) -> Array:
    """(n, nj) measured − resting angles of a model [rad]; ``LOST`` where it rests nowhere near."""
    return _residuals(rest_poses(model, pressure, position), position)


def _residuals(resting: RestPoses, position: Array) -> Array:
    residuals = np.clip(position - resting.position, -LOST, LOST)
    residuals[~resting.found] = LOST
    return np.asarray(residuals)


def _by_theta(parameters: FreeParameters, theta: Array, resting: RestPoses) -> Array:
    """(n, nj, p) ∂position/∂θ; a free number enters the parameter vector as it stands."""
    base = encode([parameters.model_at(theta)]).parameters[0]
    columns = []
    for i, scale in enumerate(parameters.scale):
        step = 1e-3 * scale * (1 if theta[i] + 1e-3 * scale <= parameters.high[i] else -1)
        moved = theta.copy()
        moved[i] += step
        changed = encode([parameters.model_at(moved)]).parameters[0]
        # Stops that are absent are at infinity and stay there.
        columns.append(np.subtract(changed, base, out=np.zeros_like(base), where=np.isfinite(base)) / step)
    return np.asarray(resting.by_parameter @ np.array(columns).T)


def _search(parameters: FreeParameters, pressure: Array, position: Array, start: Array) -> Array:
    scale = parameters.scale
    inside = 1e-9 * (parameters.high - parameters.low)

    def value(x: Array) -> Array:
        resting = rest_poses(parameters.model_at(parameters.at(x)), pressure, position)
        return _residuals(resting, position).ravel()

    def slope(x: Array) -> Array:
        resting = rest_poses(parameters.model_at(parameters.at(x)), pressure, position)
        rows = -_by_theta(parameters, parameters.at(x), resting) * scale
        rows[~resting.found] = 0.0
        return np.asarray(rows.reshape(-1, len(scale)))

    begin = np.clip(start, parameters.low + inside, parameters.high - inside) / scale
    if np.abs(value(begin)).max() < EXACT:
        return np.asarray(start)
    found = least_squares(
        value,
        begin,
        jac=slope,
        bounds=(parameters.low / scale, parameters.high / scale),
        x_scale="jac",
        xtol=1e-10,
        ftol=1e-10,
        gtol=None,
    )
    return parameters.at(found.x)


def _linear_start(parameters: FreeParameters, pressure: Array, position: Array) -> Array:
    """Parameters from the torque balance where it is linear in them; the model's own values where it is not."""
    model = parameters.model
    if set(parameters.names) != set(static_names(model)) or model.effects:
        return parameters.start
    m = model.morphology
    rows, target = [], []
    quiet = model.with_parameters({f"{a.name}.stiffness": 0.0 for a in m.actuators}).morphology
    loose = ~pressed(model, position)
    if np.count_nonzero(loose) * position.shape[1] <= len(parameters.free):
        return parameters.start
    for q, given in zip(position[loose], pressure[loose], strict=True):
        kinematics = Kinematics(m, model.phase)
        jacobian, lengths = kinematics.jacobian(q), kinematics.lengths(q)
        rows.append(np.hstack([jacobian.T * given, -jacobian.T * lengths, jacobian.T]))
        still, _ = Kinematics(quiet, model.phase).rest_torque(q)
        target.append(-still)
    (k_low, s_low, l_low), (k_high, s_high, l_high) = (
        np.array([dict(zip(parameters.names, side, strict=True))[name] for name in static_names(model)]).reshape(3, -1)
        for side in (parameters.low, parameters.high)
    )
    bounds = np.concatenate([s_low, k_low, k_low * l_low]), np.concatenate([s_high, k_high, k_high * l_high])
    area, stiffness, product = np.split(lsq_linear(np.vstack(rows), np.concatenate(target), bounds).x, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = dict(zip(static_names(model), np.concatenate([stiffness, area, product / stiffness]), strict=True))
    found = np.array([values[name] for name in parameters.names])
    return np.clip(np.where(np.isfinite(found), found, parameters.start), parameters.low, parameters.high)
