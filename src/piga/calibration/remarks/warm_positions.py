"""A temperature that moves in step with the positions: what the record cannot tell of a bias that follows it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from piga.calibration.fit.one_run import Fit
from piga.calibration.model.segment_parts import has_phases
from piga.calibration.model.solution import layout_of
from piga.calibration.remarks.missing_terms import CONFOUNDED, pieces_of
from piga.records.calibration import Coefficient
from piga.records.spool import extent
from piga.records.terms import si_factor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """When it is worth a remark.

    Attributes
    ----------
    growth:
        Ratio [1] of the standard uncertainties of the scale factor with ``k0_T`` and without it, by the fit alone.
    bias:
        Change of the bias with temperature [g/K] that an instrument may have: it must move the scale factor by more than
        its standard uncertainty.
    """

    growth: float = 1.5
    bias: float = 1e-5


SETTINGS = Settings()


def in_step(plain: Fit, groups: tuple[int, ...], coefficients: tuple[Coefficient, ...]) -> tuple[str, ...]:
    """The remark on ``k0_T`` and ``scale_factor``; none where the record tells them apart.

    Parameters
    ----------
    plain, groups:
        The fit without a slow noise, and its phases.
    coefficients:
        Those of the result, with combined standard uncertainties.
    """
    design, run = plain.design, plain.design.run
    scale = next((c for c in coefficients if c.name == "scale_factor"), None)
    thermal = {"k0_T", "k1_T"} & set(design.request.terms)
    if scale is None or run.temperature is None or thermal or design.request.phase_source != "output":
        return ()
    low, high = extent(run.temperature)
    if low == high:
        return ()
    layout = layout_of(design, len(set(groups)))
    names = layout.columns
    if has_phases(layout, groups):
        names = tuple(name for name, _ in layout.amplitude_keys)
    pieces, _ = pieces_of(plain, groups, ["k0_T"])
    rows = np.vstack(pieces)[:, :-1]
    size = np.linalg.norm(rows, axis=0)
    if not size.all():
        return ()
    factor: Array = np.asarray(np.linalg.qr(rows / size, mode="r"))
    m, at = len(names), names.index("scale_factor")
    if np.abs(np.diag(factor)[:m]).min() == 0.0:
        return ()
    inverse = np.linalg.inv(factor[:m, :m])
    share = inverse @ factor[:m, m]
    left = abs(float(factor[m, m]))
    own = float(np.sum(inverse[at] ** 2))
    growth = math.inf if left < CONFOUNDED else math.sqrt(1.0 + (float(share[at]) / left) ** 2 / own)
    moved = abs(float(share[at]) * size[m] / size[at]) * SETTINGS.bias * si_factor("k0_T") * scale.value
    if growth < SETTINGS.growth or moved < scale.std:
        return ()
    much = "without limit" if math.isinf(growth) else f"{growth:.2g} times as large"
    words = (
        f"the temperature moves in step with the positions: scale_factor and k0_T, a bias that follows the temperature, "
        f"cannot be told apart here. With k0_T the fit's standard uncertainty of scale_factor is {much}; a bias of "
        f"{1e6 * SETTINGS.bias:g} ug/K that is not in the model moves scale_factor by {moved / scale.std:.2g} standard "
        "uncertainties. Take the positions in another order, or twice at different temperatures, or hold the temperature; "
        "or add 'k0_T' to [model] terms"
    )
    return (words,)
