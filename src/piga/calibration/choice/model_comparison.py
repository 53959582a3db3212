"""What a comparison of term sets holds, and its form in calibration.json."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from piga.calibration.choice.cross_validation import Prediction
from piga.records.calibration import Coefficient


@dataclass(frozen=True)
class TermSet:
    """One set of terms in the comparison; figures are None where ``reason`` says why there are none.

    Attributes
    ----------
    terms:
        The terms.
    reason:
        Why the record does not determine the set, or cannot predict with it; empty when it does.
    parameters:
        Number of coefficients, phases included.
    chi_square, log_likelihood, bic, aic:
        Of the whitened residual; Gaussian, all weights those common to the sets.
    weight:
        Share ``exp(-BIC/2)`` among the sets that are determined.
    prediction:
        What the set says of parts of the record that were left out.
    coefficients, changes:
        Estimates of type A, and how far each lies from that of the best set, in the standard uncertainties of
        that.
    """

    terms: tuple[str, ...]
    reason: str = ""
    parameters: int = 0
    chi_square: float | None = None
    log_likelihood: float | None = None
    bic: float | None = None
    aic: float | None = None
    weight: float | None = None
    prediction: Prediction | None = None
    coefficients: tuple[Coefficient, ...] = ()
    changes: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class ModelComparison:
    """Term sets in the order asked; ``best`` and ``best_prediction`` are indices into ``sets``.

    ``best`` has the least BIC. ``best_prediction`` has the fewest coefficients of all sets whose prediction is
    within one standard error of the best one. ``noise_terms`` is the set with which the common noise levels
    were found; ``parted_by`` says what was left out: segments or blocks of one. ``notes``: what a choice between sets
    means for K where the record cannot make it.
    """

    sets: tuple[TermSet, ...]
    observations: int
    parts: int
    folds: int
    parted_by: str
    noise_terms: tuple[str, ...]
    angle_rms: float
    angle_random_walk: float
    best: int | None
    best_prediction: int | None
    notes: tuple[str, ...] = ()

    @property
    def ranking(self) -> tuple[int, ...]:
        """Indices of the sets by BIC, those without one last."""
        order = [math.inf if found.bic is None else found.bic for found in self.sets]
        return tuple(sorted(range(len(order)), key=lambda index: (order[index], index)))

    def document(self) -> dict[str, Any]:
        """The comparison as plain data for JSON: forces [m/s^2], coefficients in the units of calibration.json."""
        best = self.sets[self.best].bic if self.best is not None else None
        return {
            "treatment": "noise levels of the largest set that the record separates, the same for all sets",
            "noise_terms": list(self.noise_terms),
            "angle_rms": self.angle_rms,
            "angle_random_walk": self.angle_random_walk,
            "observations": self.observations,
            "parts": self.parts,
            "folds": self.folds,
            "parted_by": self.parted_by,
            "best": None if self.best is None else list(self.sets[self.best].terms),
            "best_prediction": None
            if self.best_prediction is None
            else list(self.sets[self.best_prediction].terms),
            "notes": list(self.notes),
            "sets": [_set_document(found, best, self.observations) for found in self.sets],
        }


def _set_document(found: TermSet, best: float | None, observations: int) -> dict[str, Any]:
    document: dict[str, Any] = {"terms": list(found.terms), "reason": found.reason}
    if found.chi_square is None or found.bic is None or best is None:
        return document
    document |= {
        "parameters": found.parameters,
        "chi_square": found.chi_square,
        "chi_square_per_degree": found.chi_square / (observations - found.parameters),
        "log_likelihood": found.log_likelihood,
        "bic": found.bic,
        "bic_above_best": found.bic - best,
        "aic": found.aic,
        "weight": found.weight,
    }
    changes = dict(found.changes)
    document["coefficients"] = [
        {"key": c.key, "value": c.value, "std": c.std, "unit": c.unit, "change": changes.get(c.key)}
        for c in found.coefficients
    ]
    if found.prediction is not None:
        document |= found.prediction.document()
    return document
