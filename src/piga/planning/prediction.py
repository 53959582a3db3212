"""Predict the result of a test: calibration of its noiseless record, with the covariance of the estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from piga.calibration.budget.uncertainty import contributions
from piga.calibration.fit.servo import settled_design
from piga.calibration.model.design import Design
from piga.calibration.model.identifiability import examine, refuse_if_confounded
from piga.calibration.model.solution import name_coefficients, solve
from piga.calibration.noise.weighting import reduce_segments, weighting_mode
from piga.errors import IdentifiabilityError
from piga.planning.candidates import Candidate, model_request, noise_of, run_of
from piga.planning.plan_file import PlanRequest
from piga.records.calibration import Coefficient
from piga.records.run import Run
from piga.results import Result
from piga.stand import Composite, simulate_test
from piga.stand.write_run import given_values

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Visit:
    """A candidate held for ``dwell`` [s]."""

    candidate: Candidate
    dwell: float


@dataclass(frozen=True, eq=False, repr=False)
class Prediction(Result):
    """Predicted result of a test.

    ``coefficients`` have standard uncertainties of Type A with ``covariance``. ``type_b`` (n,) is the standard
    uncertainty by the stand. File units. ``refusal`` gives the reason if there is no result.
    """

    name: str
    visits: tuple[Visit, ...]
    duration: float
    coefficients: tuple[Coefficient, ...] = ()
    covariance: Array | None = None
    type_b: Array | None = None
    refusal: str = ""

    @property
    def recorded(self) -> float:
        """Sum of the dwells [s]."""
        return sum(visit.dwell for visit in self.visits)

    def std(self, name: str) -> float:
        """Type A standard uncertainty of a coefficient; infinite if it is not determined."""
        stds = [c.std for c in self.coefficients if c.name == name and c.segment is None]
        return stds[0] if stds else float("inf")

    def combined(self, name: str) -> float:
        """Combined standard uncertainty of a coefficient."""
        for k, c in enumerate(self.coefficients):
            if c.name == name and c.segment is None:
                return float(np.hypot(c.std, 0.0 if self.type_b is None else self.type_b[k]))
        return float("inf")


def duration_of(visits: tuple[Visit, ...], move: float) -> float:
    """Time of a test with a move between visits [s]."""
    return sum(visit.dwell for visit in visits) + move * (len(visits) - 1)


def predict(
    request: PlanRequest, name: str, visits: tuple[Visit, ...], *, type_b: bool = True, refuse: bool = False
) -> Prediction:
    """Predicted uncertainty of a test, from the estimator itself.

    Raises
    ------
    IdentifiabilityError
        With ``refuse``, if the test cannot determine the terms; otherwise the result holds the reason.
    """
    run = noiseless_run(request, visits)
    duration = duration_of(visits, request.move)
    noise, wish = noise_of(request), model_request(request)
    design = Design(run, wish, run.scale_factor)
    mode = weighting_mode(design, "information")
    try:
        design = settled_design(design, mode, noise)
        summaries = reduce_segments(design, mode, noise)
        refuse_if_confounded(examine(design, summaries))
    except IdentifiabilityError as error:
        if refuse:
            raise IdentifiabilityError(
                error.message.replace("record", "plan", 1), remedy=error.remedy
            ) from None
        return Prediction(name, visits, duration, refusal=error.message.replace("record", "plan", 1))
    solution = solve(design, summaries)
    coefficients, covariance = name_coefficients(design, solution, solution.covariance)
    if design.point:
        covariance = covariance * (noise.walk / request.scenario.electronics.interval)
        std = np.sqrt(np.diag(covariance))
        coefficients = tuple(replace(c, std=float(s)) for c, s in zip(coefficients, std, strict=True))
    base = np.array([c.value for c in coefficients])

    def estimate(moved: Run) -> Array:
        again = settled_design(Design(moved, wish, run.scale_factor), mode, noise)
        moved_solution = solve(again, reduce_segments(again, mode, noise))
        named, _ = name_coefficients(again, moved_solution, moved_solution.covariance)
        values = np.array([c.value for c in named])
        turns = np.array([c.name == "phi" for c in named])
        return np.where(turns, base + np.angle(np.exp(1j * (values - base))), values)

    squares = np.zeros(base.size)
    if type_b:
        for _, change in contributions(run, base, estimate):
            squares += np.sum(change**2, axis=0)
    return Prediction(name, visits, duration, coefficients, covariance, np.sqrt(squares))


def noiseless_run(request: PlanRequest, visits: tuple[Visit, ...]) -> Run:
    """The record of the test without noise and imperfections, with the data for its budget."""
    stand = Composite(tuple(visit.candidate.stand(visit.dwell, request) for visit in visits), request.move)
    e = request.scenario.electronics
    quiet = replace(
        e,
        kind="rate" if e.kind == "rate" else "angle",
        angle_noise=0.0,
        angle_random_walk=0.0,
        clock_offset=0.0,
        clock_jitter=0.0,
        counter_bits=None,
    )
    log = simulate_test(stand, request.scenario.specimen, quiet).log
    run = run_of(request, log.t, log.output, log.reference, log.base_rate, log.segment)
    return replace(
        run, uncertainty=request.uncertainty, stand=stand_table(request, visits), source=str(request.path)
    )


def stand_table(request: PlanRequest, visits: tuple[Visit, ...]) -> dict[str, Any]:
    """``[stand]`` of a scenario that visits these candidates: a composite with one part each."""
    parts = []
    for visit in visits:
        table = msgspec.structs.replace(visit.candidate.table, dwell=f"{visit.dwell!r} s")
        parts.append(given_values(msgspec.to_builtins(table)))
    return {"kind": "composite", "pause": f"{request.move!r} s", "parts": parts}
