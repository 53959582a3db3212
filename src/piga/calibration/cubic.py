"""What a cubic signature means for the scale factor, where the specific force never changes its size.

With ``a_x^2 + a_t^2 = N`` throughout, ``a_x a_t^2 = N a_x - a_x^3``: a servo of finite stiffness and a third-order
coefficient fit the record alike, and the scale factor under one is ``1 + k3 N`` times that under the other. No data of such a
stand choose between them. So a suggestion names the scale factor under each, and where such a signature is clear and
neither term is asked for, both meanings are a source of Type B (docs/theory/servo).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from piga.calibration.budget import budget_row
from piga.calibration.candidate_columns import CUBIC, constant_squares
from piga.calibration.fit import Fit
from piga.calibration.missing_terms import after_change, pieces_of, tested
from piga.calibration.segment_parts import has_phases
from piga.calibration.solution import layout_of
from piga.records.calibration import Coefficient
from piga.records.terms import si_factor, unit_of

Array = NDArray[np.float64]

CLEAR = 0.01
"""Probability of as strong a cubic signature by chance, below which both of its meanings are in the budget."""
SEEN = 2.0
"""Standard uncertainties from which a k3 that is asked for is said to have another meaning."""
SOURCE = "meaning of the cubic signature: servo or k3"


@dataclass(frozen=True)
class CubicDoubt:
    """A clear cubic signature that no term of the model takes.

    ``scale_factors`` are K under the name of each term (file unit); ``change`` is the half-width of what either meaning
    makes of each coefficient of the result (file units).
    """

    scale_factors: dict[str, float]
    size: float
    change: Array

    @property
    def covariance(self) -> Array:
        """What it adds to the covariance of the coefficients."""
        return np.outer(self.change, self.change) / 3.0

    def row(self, coefficients: tuple[Coefficient, ...]) -> dict[str, Any]:
        """Its row of the budget: anything between the half-widths is as likely."""
        return budget_row(SOURCE, "B", "rectangular", None, "", coefficients, self.change / math.sqrt(3.0))

    def words(self) -> str:
        """The note."""
        under = ", ".join(f"{value:.8g} with {name}" for name, value in self.scale_factors.items())
        return (
            f"the residuals hold a cube of a_x ({self.size:.3g} g/g^3): a_x^2 + a_t^2 never changes here, so that no record of "
            f"this stand can say whether it is the servo or k3. scale_factor would be {under} {unit_of('scale_factor')}; "
            "its uncertainty holds both. Add 'servo' (and 'servo_damping') to [model] terms if the servo has a finite "
            "stiffness, as every servo has; a run on a centrifuge or [instrument] servo decides"
        )


def cubic_doubt(
    plain: Fit, groups: tuple[int, ...], per_segment: bool, coefficients: tuple[Coefficient, ...]
) -> CubicDoubt | None:
    """Both meanings of a cubic signature; None where there is none, where a term takes it, or the stand tells them apart.

    Parameters
    ----------
    plain, groups, per_segment:
        The fit without a slow noise, which would take up what a missing term leaves, and its phases.
    coefficients:
        Those of the result.
    """
    design = plain.design
    square = constant_squares(design.run)[0]
    held = (*design.request.terms, *design.turning_servo)
    if (
        square is None
        or not {"scale_factor", "tan_beta"} <= set(held)
        or set(CUBIC) & set(held)
        or design.request.phase_source != "output"
    ):
        return None
    pieces, rows = pieces_of(plain, groups, ["k3"])
    test = tested(pieces, ["k3"], ("k3",), rows)
    if test is None or test.probability > CLEAR:
        return None
    amplitudes = has_phases(layout_of(design, len(set(groups))), groups)
    after = after_change(plain, per_segment, test.change, amplitudes)
    before = after_change(plain, per_segment, np.zeros_like(test.change), amplitudes)
    k3 = float(test.columns[0]) / design.scale_factor
    cube = after["scale_factor"]
    under = {"servo": cube * (1.0 + k3 * square), "k3": cube}
    change = np.array([0.0 if c.name == "phi" else after[c.key] - before[c.key] for c in coefficients])
    at = next(i for i, c in enumerate(coefficients) if c.name == "scale_factor")
    change[at] = max((value - coefficients[at].value for value in under.values()), key=abs)
    return CubicDoubt(under, k3 / si_factor("k3"), change)


def other_meaning(fit: Fit, coefficients: tuple[Coefficient, ...]) -> tuple[str, ...]:
    """What a scale factor beside an asked ``k3`` or ``k2o`` rests on, where the record cannot tell it from the servo."""
    square = constant_squares(fit.design.run)[0]
    named = {c.name: c for c in coefficients}
    scale = named.get("scale_factor")
    if square is None or scale is None or fit.design.turning_servo:
        return ()
    notes = []
    k3 = named.get("k3")
    if k3 is not None and abs(k3.value) > SEEN * k3.std:
        other = scale.value * (1.0 + k3.value * si_factor("k3") * square)
        notes.append(
            "k3 may as well be the servo: a_x^2 + a_t^2 never changes here, and with 'servo' in the place of 'k3' the fit "
            f"is the same and scale_factor is {other:.8g} instead of {scale.value:.8g} {scale.unit}. The choice is one of "
            "meaning: a run on a centrifuge, calibrated together with this one, or [instrument] servo makes it"
        )
    odd = named.get("k2o")
    if odd is not None and abs(odd.value) > SEEN * odd.std:
        notes.append(
            "k2o takes much of what the stiffness of the servo makes of this record, and scale_factor depends on which of "
            "them is asked for: compare the sets with 'k2o' and with 'servo' in its place (--compare)"
        )
    return tuple(notes)
