"""Where effects act that forces are not linear in, such as a spring's end in the room, found in the torque domain.

The torque domain takes a candidate at its guesses, linear in its size (``torque_screening``). Far from the right place
no size explains much, and other laws look better. Inverse dynamics take milliseconds, so all parameters are fitted
there, from several guesses, beside the parameters of the model:

    min over δ and the effect's parameters v of ‖r − J δ − f(v)‖²,    δ eliminated (variable projection)
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, model_of
from equimus_ctrl.diagnosis.richer_laws import holds
from equimus_ctrl.diagnosis.torque_columns import Along, columns_of, usual_laws
from equimus_ctrl.diagnosis.torque_screening import TorqueDomain
from equimus_ctrl.effects.force import ForceEffect
from equimus_ctrl.engines.mjcf_inverse import inverse_dynamics
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.types import Array

EVALUATIONS = 20
"""Most evaluations of a fit, derivatives not counted; of the best one as many again."""
FAR = 3.0
"""So many times what noise makes is far above it."""
WORST = 1e3
"""Times the largest missing force: what is left where a robot cannot have the effect so."""

Left = Callable[[Mapping[str, float]], Array]
"""What an effect's parameters leave of the missing forces."""


def refined_guesses(data: Data, domain: TorqueDomain, pool: Sequence[Candidate]) -> dict[str, dict[str, float]]:
    """Further guesses, by candidates' labels, for effects whose forces are not linear in all parameters.

    Only of effects that can sit at one place: at several each would have to be fitted beside all others.

    Args:
        data: what was measured.
        domain: the same in the torque domain.
        pool: the candidates.
    """
    free, check = data.free, data.budget.check
    model = free.model_at(free.start)
    along = Along.of(model, domain.motions, domain.width)
    _, columns, _, sigma = columns_of(free, free.start, domain.motions, domain.width, usual_laws(pool), check)
    whole = (columns / sigma[:, None]).reshape(-1, columns.shape[2])
    beside = Nuisance.of(whole[:, : len(free.start)])
    missing = beside.project_out(whole[:, -1])
    best = dict[str, tuple[Candidate, dict[str, float]]]()
    shaped = [c for c in pool if _is_shaped(c)]
    places = Counter(c.effect.name for c in shaped)
    for candidate in sorted(shaped, key=lambda c: c.n_parameters):
        if places[candidate.effect.name] > 1:
            continue

        def left(values: Mapping[str, float], own: Candidate = candidate) -> Array:
            check()
            try:
                change = along.changed(model_of(model, (Part(own, values),)))
            except (ConfigError, ModelError):
                return np.full(len(missing), WORST * np.abs(missing).max(initial=1.0))
            return np.asarray(missing - beside.project_out((change / sigma).ravel()))

        starts = [*candidate.guesses]
        for simple, values in best.values():
            if holds(candidate, simple):
                starts += candidate.effect.begun_at(values, candidate.guesses)[:1]
        _, found = min((_fitted(candidate, start, left) for start in starts), key=lambda one: one[0])
        best[candidate.label] = candidate, _fitted(candidate, found, left)[1]
    return {label: values for label, (_, values) in best.items()}


def far_above_noise(data: Data, domain: TorqueDomain, left: Array) -> bool:
    """Whether forces (nj,) that are left, by their standard deviations, are far larger than noise of positions makes.

    Noise of that size is added to the measured motions, from a fixed seed.
    """
    model, rng = data.free.model_at(data.free.start), np.random.default_rng(0)
    along = Along.of(model, domain.motions, domain.width)
    noisy = [replace(m, position=m.position + m.noise * rng.standard_normal(m.position.shape)) for m in domain.motions]
    after = inverse_dynamics(model, noisy, domain.width)
    change = along.rows_of([two.missing - one.missing for one, two in zip(along.at, after, strict=True)])
    made = np.sqrt((change**2).sum(axis=0) / np.maximum(along.counts.sum(axis=0), 1))
    return bool(np.any(left > FAR * made))


def _is_shaped(candidate: Candidate) -> bool:
    """Whether an effect at one place has a size and further parameters that its forces are not linear in."""
    effect = candidate.effect
    one = len(candidate.locations) == 1 and not candidate.own and not candidate.absent
    of_bodies = effect.in_torques and not issubclass(effect, ForceEffect) and effect.side == "force"
    return one and of_bodies and len(candidate.grows_from()) == 1 and candidate.n_parameters > 1 and not effect.delays


def _fitted(candidate: Candidate, start: Mapping[str, float], left: Left) -> tuple[float, dict[str, float]]:
    """χ² and the parameters' values that explain most, from a guess on, within bounds."""
    names, info = list(start), candidate.effect.parameter_info()
    low = np.array([float(info[own.key]["low"]) for own in candidate.parameters])
    most = candidate.most
    high = np.array([min(float(info[o.key]["high"]), most.get(o.key, np.inf)) for o in candidate.parameters])
    at = np.clip(np.array([start[name] for name in names]), low, high)
    scale = np.maximum(np.abs(at), 0.1 * np.abs(at[1:]).max(initial=1e-9))
    found = least_squares(
        lambda x: left(dict(zip(names, x.tolist(), strict=True))),
        np.clip(at, low + 1e-9 * (high - low), high - 1e-9 * (high - low)),
        bounds=(low, high), x_scale=scale, max_nfev=EVALUATIONS, ftol=1e-4,
    )  # fmt: skip
    return 2.0 * float(found.cost), dict(zip(names, found.x.tolist(), strict=True))
