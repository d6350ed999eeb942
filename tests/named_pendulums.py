"""A search that has come to some laws at a pendulum's hinge, whatever there truly is."""

from __future__ import annotations

from collections.abc import Sequence

from pendulum_runs import MOTOR, PENDULUM, recorded

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Split, split
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part, default_free_parameters
from equimus_ctrl.diagnosis.policy import SearchSettings
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchState
from equimus_ctrl.effects import Effect
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot

ROBOT = MjcfRobot("arm", PENDULUM.format(drive=MOTOR))


def fitted_law(*truth: Effect, named: Sequence[str] = ("viscous_friction:hinge",)) -> tuple[Search, SearchState, Split]:
    free = default_free_parameters(Model(ROBOT))
    parts = split(free.model, recorded(Model(ROBOT, truth), count=4, dt=1e-3))
    data = Data(free, parts.train, reduced_simulator(threads=1))
    search = Search(data, candidates(free.model, parts.train), SearchSettings(many_minima=True))
    base = data.base()
    chosen = [next(c for c in search.pool if c.label == label) for label in named]

    def fitted(some: Sequence[Candidate]) -> Fitted:
        hypothesis = tuple(Part(c, {own.name: 0.05 for own in c.parameters}) for c in some)
        begin = (data.theta_of(base.fit.theta, hypothesis), base.fit.starts)
        return data.converge(data.coarse_fit(hypothesis, [begin], base.noise, 15)) if some else base

    without = tuple(fitted([c for c in chosen if c is not left]) for left in chosen)
    return search, SearchState(base, fitted(chosen), without, tuple(() for _ in chosen)), parts
