"""Trial: one linear mixed model for all noise of a record, against the search of the estimator.

Every record of a scenario is calibrated as usual. On the same fit, all levels are estimated together by one restricted likelihood
without bounds; no component is tested first. Covariance and degrees of freedom follow from the information matrix of the levels
(Satterthwaite, Kenward and Roger). ``python -m benchmarks.noise_trial --records 200 [CASE ...]`` prints the table.
"""

from __future__ import annotations

import argparse
import json
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks import measured
from numpy.typing import NDArray
from scipy.fft import dct, dst
from scipy.stats import t as student

import piga
from piga.calibration.fit.one_run import Fit, fit_run, refine_counted
from piga.calibration.model.request import make_request
from piga.calibration.model.solution import name_coefficients
from piga.calibration.noise.components import RATES, RateBins
from piga.calibration.noise.stretches import modes_of
from piga.campaign.campaign_file import read_campaign
from piga.campaign.constant_force import ConstantForce, tumble
from piga.campaign.subjects import built

Array = NDArray[np.float64]
CAMPAIGNS = Path(__file__).parents[1] / "examples" / "campaigns"


@dataclass(frozen=True)
class Contrasts:
    """Independent values of a record: ``y`` (n,), the slow rates and the model in them (n, .), variances.

    ``known`` (n,) is the known variance, ``units`` (k, n) are those by a unit of white noise and walk. The last
    values, behind ``rates.shape[0]``, are fast: neither the model nor slow noise is in them.
    """

    y: Array
    known: Array
    units: Array
    rates: Array
    model: Array
    weights: Array
    bins: RateBins


def contrasts_of(fit: Fit) -> Contrasts:
    """Contrasts of a fit: sine transforms of increments; of coarse counts the cosines that the estimator has."""
    design, bins = fit.design, RateBins.of(fit.design.run)
    m, modes = len(design.names), max(modes_of(design), 24)
    slow, fast = [], []
    if fit.counted is not None:
        held = fit.counted.stretches
        factor = np.linalg.inv(np.linalg.cholesky(held.covariance(fit.counted.noise)))
        walk = factor @ held.walk @ factor.transpose(0, 2, 1)
        values, turn = np.linalg.eigh(walk)
        for k, (segment, whitened) in enumerate(fit.counted.whitened(design, bins)):
            columns = whitened @ turn[k]
            y = columns[-1] - fit.solution.values[segment] @ columns[:m]
            known = 1.0 - fit.counted.noise.walk * values[k]
            slow.append(_rows(fit, segment, columns, bins, y, np.stack([known, values[k]]).T))
        whole = np.concatenate(slow)
        y, known, units = whole[:, -1], whole[:, -3], whole[:, -2][None]
        weights = known + fit.counted.noise.walk * units[0]
        return Contrasts(y, known, units, whole[:, : bins.count], whole[:, bins.count : -3], weights, bins)
    for block in design.blocks():
        formed = block.h > 0.0
        t = np.asarray(design.run.t[block.start : block.stop])
        columns = np.vstack([block.columns[:m], bins.increments(t, block.h)])[:, formed]
        y = block.columns[-1, formed] - fit.solution.values[block.segment] @ columns[:m]
        h = block.h[formed]
        if fit.mode == "samples":
            both = dct(np.vstack([columns, y]), type=2, norm="ortho", axis=1)
            columns, y = both[:-1], both[-1]
            weights = np.ones((y.size, 1))
        else:
            k = np.arange(1, y.size + 1)
            both = dst(np.vstack([columns, y]), type=1, norm="ortho", axis=1)
            columns, y = both[:-1], both[-1]
            weights = np.stack(
                [4.0 * np.sin(0.5 * np.pi * k / (y.size + 1)) ** 2, np.full(y.size, h.mean())], axis=1
            )
        rows = _rows(fit, block.segment, np.vstack([columns, y]), bins, y, weights)
        cut = min(modes, y.size)
        slow.append(rows[:cut])
        fast.append(rows[cut:])
    first = np.concatenate(slow)
    whole = np.concatenate([first, *fast])
    units = whole[:, -3:-1].T if fit.mode != "samples" else whole[:, -2:-1].T
    noise = (
        np.array([fit.noise.white, fit.noise.walk])
        if fit.mode != "samples"
        else np.array([fit.sample_variance])
    )
    known = np.zeros(len(whole))
    used = slice(0, bins.count), slice(bins.count, first.shape[1] - 1 - len(units))
    return Contrasts(whole[:, -1], known, units, first[:, used[0]], first[:, used[1]], noise @ units, bins)


def _rows(fit: Fit, segment: int, columns: Array, bins: RateBins, y: Array, variances: Array) -> Array:
    """Rows ``[slow rates | parameters | variances | y]`` from columns ``[model, slow, y]``."""
    m = len(fit.design.names)
    turned = fit.solution.jacobians[fit.design.groups[segment]].T @ columns[:m]
    return bins.placed(np.vstack([columns[m:-1], turned, variances.T, y]).T, segment)


@dataclass(frozen=True)
class Model:
    """The mixed model: contrasts and the unit covariances of the slow rates (k, bins, bins)."""

    held: Contrasts
    slow: Array

    @property
    def count(self) -> int:
        return len(self.held.units)

    def parts(self, levels: Array):
        """V: its diagonal D, ``Z``, R of ``P = D^-1 - D^-1 Z R Z' D^-1``, the estimator, and ``log|V| + log|X' V^-1 X|``.

        None if V is no covariance.
        """
        c, n = self.held, len(self.held.rates)
        diagonal = c.known + levels[: self.count] @ c.units
        if diagonal.min() <= 0.0:
            return None
        Z = np.hstack([c.rates, c.model])
        b = c.rates.shape[1]
        M = Z.T @ (Z / diagonal[:n, None])
        K, log = np.zeros((b, b)), 0.0
        if len(self.slow):
            G = np.tensordot(levels[self.count :], self.slow, 1)
            values, vectors = np.linalg.eigh(M[:b, :b])
            root = vectors * np.sqrt(np.maximum(values, 0.0))
            inner = np.linalg.eigvalsh(np.eye(b) + root.T @ G @ root)
            if inner.min() <= 1e-9:
                return None
            K = np.linalg.solve(np.eye(b) + G @ M[:b, :b], G)
            K, log = 0.5 * (K + K.T), float(np.log(inner).sum())
        a = np.vstack([-K @ M[:b, b:], np.eye(M.shape[0] - b)])
        A = M[b:, b:] - M[b:, :b] @ K @ M[:b, b:]
        sign, size = np.linalg.slogdet(A)
        if sign <= 0:
            return None
        inverse = np.linalg.inv(A)
        R = a @ inverse @ a.T
        R[:b, :b] += K
        return diagonal, Z, R, a, inverse, log + float(np.log(diagonal).sum()) + size

    def deviance(self, levels: Array) -> float:
        parts = self.parts(levels)
        if parts is None:
            return np.inf
        diagonal, Z, R, _, _, log = parts
        y = self.held.y
        z = Z.T @ (y[: len(Z)] / diagonal[: len(Z)])
        return log + float(y**2 @ (1.0 / diagonal) - z @ R @ z)

    def score(self, levels: Array) -> tuple[Array, Array]:
        """Derivatives of the log-likelihood and expected information."""
        diagonal, Z, R, _, _, _ = self.parts(levels)
        n, c, b = len(Z), self.held, self.held.rates.shape[1]
        D = Z / diagonal[:n, None]
        Py = c.y / diagonal
        Py[:n] -= D @ (R @ (D.T @ c.y[:n]))
        first = [D.T @ (unit[:n, None] * D) for unit in c.units]
        MZ = D.T @ Z
        S = (MZ - MZ @ R @ MZ)[:b, :b]
        By = c.rates.T @ Py[:n]
        k = self.count
        size = k + len(self.slow)
        slope, information = np.zeros(size), np.zeros((size, size))
        turned = np.eye(len(R)) - MZ @ R
        for i, unit in enumerate(c.units):
            slope[i] = 0.5 * (unit @ Py**2 - (unit @ (1.0 / diagonal) - np.sum(R * first[i])))
            for j in range(i, k):
                second = D.T @ ((unit * c.units[j] / diagonal)[:n, None] * D)
                value = unit @ (c.units[j] / diagonal**2) - 2.0 * np.sum(R * second)
                value += np.sum((R @ first[i]) * (R @ first[j]).T)
                information[i, j] = information[j, i] = 0.5 * value
            PwP = (turned @ first[i] @ turned.T)[:b, :b]
            for j, C in enumerate(self.slow):
                information[i, k + j] = information[k + j, i] = 0.5 * np.sum(C * PwP)
        CS = [C @ S for C in self.slow]
        for j, C in enumerate(self.slow):
            slope[k + j] = 0.5 * (By @ C @ By - np.sum(C * S))
            for other in range(j, len(self.slow)):
                value = 0.5 * np.sum(CS[j] * CS[other].T)
                information[k + j, k + other] = information[k + other, k + j] = value
        return slope, information

    def estimate(self, start: Array) -> tuple[Array, Array, float]:
        """Levels of greatest restricted likelihood, of either sign; their covariance; deviance."""
        levels, best = start.copy(), self.deviance(start)
        for _ in range(40):
            slope, information = self.score(levels)
            step, gain = _inverse(information) @ slope, 0.0
            for _ in range(14):
                tried = self.deviance(levels + step)
                if tried <= best:
                    gain, levels, best = best - tried, levels + step, tried
                    break
                step = 0.5 * step
            if gain < 1e-4:
                break
        return levels, _inverse(self.score(levels)[1]), best

    def weights_cost(self, levels: Array, covariance: Array) -> Array:
        """Twice the covariance that the uncertainty of slow levels in the weights adds (Kenward and Roger)."""
        diagonal, Z, R, a, inverse, _ = self.parts(levels)
        n, b, k = len(Z), self.held.rates.shape[1], self.count
        D = Z / diagonal[:n, None]
        MZ = D.T @ Z
        S = (MZ - MZ @ R @ MZ)[:b, :b]
        BW = self.held.rates.T @ D @ a @ inverse
        added = sum(
            covariance[k + i, k + j] * BW.T @ C @ S @ other @ BW
            for i, C in enumerate(self.slow)
            for j, other in enumerate(self.slow)
        )
        return added + added.T

    def shares(self, weights: Array) -> tuple[Array, list[Array], Array]:
        """Estimate with the weights of these levels, its covariance by a unit of each level, and by what is known."""
        diagonal, Z, _, a, inverse, _ = self.parts(weights)
        n = len(Z)
        WX = (Z / diagonal[:n, None]) @ a @ inverse
        moved = WX.T @ self.held.y[:n]
        BW = self.held.rates.T @ WX
        parts = [WX.T @ (unit[:n, None] * WX) for unit in (*self.held.units, self.held.known)]
        return moved, [*parts[:-1], *(BW.T @ C @ BW for C in self.slow)], parts[-1]


def _inverse(matrix: Array) -> Array:
    size = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return np.linalg.pinv(matrix / np.outer(size, size), rcond=1e-9, hermitian=True) / np.outer(size, size)


SETS = {"drift and scatter": ("drift", "scatter"), "and flicker": ("flicker", "drift", "scatter")}
"""Slow components of the trial models, beside white noise, walk and counting."""
CLEAR = 9.0
"""Gain from which drift and scatter are in the weights, as in the estimator."""


def trial(fit: Fit) -> dict[str, tuple[Array, Array, Array]]:
    """Moved parameters, variances and degrees of freedom of the coefficients by each set of components."""
    held = contrasts_of(fit)
    start = np.array([fit.noise.white, fit.noise.walk])
    if fit.mode == "samples":
        start = np.array([fit.sample_variance])
    if fit.counted is not None:
        start = np.array([fit.counted.noise.walk])

    def named(matrix: Array) -> Array:
        return np.diag(name_coefficients(fit.design, fit.solution, matrix)[1]).copy()

    size = held.bins.count
    without = Model(held, np.zeros((0, size, size))).estimate(start)[2]
    results = {}
    for name, components in SETS.items():
        model = Model(held, np.array([RATES[component](held.bins, 0.0) for component in components]))
        weights = np.append(start, np.zeros(len(components)))
        levels, covariance, deviance = model.estimate(weights)
        clear = without - deviance > CLEAR
        if clear:
            weights[start.size :] = np.maximum(levels[start.size :], 0.0)
        moved, parts, known = model.shares(weights)
        shares = np.array([named(part) for part in parts])
        variance = levels @ shares + named(known)
        degrees = 2.0 * variance**2 / np.einsum("ik,ij,jk->k", shares, covariance, shares)
        if clear:
            variance = variance + named(model.weights_cost(weights, covariance))
        results[name] = (moved, variance, degrees)
    return results


def one(scenario: ConstantForce, run: piga.Run) -> dict[str, list]:
    """Errors and half widths by today's search and by each trial model."""
    result = scenario.calibrate(run)
    fit = fit_run(run, make_request(run, scenario.terms))
    fit = refine_counted(fit)
    named = name_coefficients(fit.design, fit.solution, fit.covariance)[0]
    truth = np.array([scenario.true_value(c.name) for c in named])
    order = [[c.name for c in named].index(c.name) for c in result.coefficients]
    rows = {
        "today": (
            scenario.errors(result),
            [c.expanded for c in result.coefficients],
            [min(c.degrees_of_freedom, 1e6) for c in result.coefficients],
        )
    }
    for name, (moved, variance, degrees) in trial(fit).items():
        n = fit.solution.amplitudes.size
        other = replace(
            fit.solution, amplitudes=fit.solution.amplitudes + moved[:n], phases=fit.solution.phases + moved[n:]
        )
        value = np.array([c.value for c in name_coefficients(fit.design, other, fit.covariance)[0]])
        error = value - truth
        half = student.ppf(0.975, np.maximum(degrees, 1.0)) * np.sqrt(np.maximum(variance, 0.0))
        rows[name] = (error[order], half[order], np.minimum(degrees, 1e6)[order])
    return {name: [list(map(float, part)) for part in row] for name, row in rows.items()}


EXTRA = {
    "drift-half": ("drift", {"drift": 0.5e-6}),
    "drift-three": ("drift", {"drift": 3e-6}),
    "scatter-faint": ("scatter", {"walk": 2e-5, "scatter": 3e-6}),
    "four": ("faint-2e-06", {"positions": 4}),
}


def scenarios() -> dict[str, ConstantForce]:
    """The scenarios of the campaigns by name, and the hard ones."""
    cases: dict[str, ConstantForce] = {}
    for name in ("coverage", "coloured"):
        plan = read_campaign(CAMPAIGNS / f"{name}.toml")
        for group in plan.groups:
            record = plan.record(group.start)
            test = built(plan, record, plan.document(record))
            if isinstance(test, ConstantForce):
                cases[record.group.name] = test
    for name, (base, changed) in EXTRA.items():
        if "positions" in changed:
            cases[name] = replace(
                cases[base], forces=tumble(4), truth={"k0": 1.6e-3}, terms=("scale_factor", "tan_beta", "k0")
            )
        else:
            cases[name] = replace(cases[base], **changed)
    return cases


def summarise(rows: list[dict[str, list[list[float]]]]) -> dict[str, dict[str, Any]]:
    """For each model: share of intervals that hold, half widths and errors over those of today, degrees of freedom."""
    table: dict[str, dict[str, Any]] = {}
    widths = np.array([row["today"][1] for row in rows])
    spread = np.std([row["today"][0] for row in rows], axis=0)
    for name in ("today", *SETS):
        errors, half, degrees = (np.array([row[name][i] for row in rows]) for i in range(3))
        inside = 100.0 * (np.abs(errors) <= half).mean(axis=0)
        ratio = np.median(half, axis=0) / np.median(widths, axis=0)
        table[name] = {
            "intervals hold": (round(float(inside.min()), 1), round(float(inside.max()), 1)),
            "half width": (round(float(ratio.min()), 2), round(float(ratio.max()), 2)),
            "largest error ratio": round(float((np.std(errors, axis=0) / spread).max()), 2),
            "degrees of freedom": round(float(np.median(degrees)), 0),
        }
    return table


def put_down(tables: dict[str, dict[str, dict[str, Any]]], records: int) -> None:
    """The table of the page on the theory of the noise."""
    rows: dict[str, dict[str, Any]] = {}
    for case, table in tables.items():
        rows[case] = {"intervals hold, estimator": table["today"]["intervals hold"]}
        rows[case]["degrees of freedom, estimator"] = table["today"]["degrees of freedom"]
        for name, model in (("two", table["drift and scatter"]), ("three", table["and flicker"])):
            rows[case][f"intervals hold, {name} slow"] = model["intervals hold"]
            rows[case][f"half width, {name} slow"] = model["half width"]
            rows[case][f"largest error, {name} slow"] = model["largest error ratio"]
            rows[case][f"degrees of freedom, {name} slow"] = model["degrees of freedom"]
    units = {column: "%" for column in next(iter(rows.values())) if "hold" in column}
    measured.write(
        "noise-trial",
        "scenario",
        rows,
        units,
        command=f"python -m benchmarks.noise_trial --record --records {records} {' '.join(tables)}",
        conditions="worst and best coefficient; two slow: white noise, walk, drift and scatter in one restricted likelihood "
        "without bounds, always in the covariance; three slow: and flicker. Half widths (median over the records, narrowest "
        "and widest coefficient) and spread of the errors (worst coefficient) over those of the estimator; degrees of "
        "freedom: median",
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=150)
    parser.add_argument("--record", action="store_true", help="write docs/measured/noise-trial.json")
    parser.add_argument("cases", nargs="*")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    known, tables = scenarios(), {}
    for name in chosen.cases or known:
        seeds = (np.random.default_rng([k, 24, 77]) for k in range(chosen.records))
        tables[name] = summarise([one(known[name], known[name].record(rng)) for rng in seeds])
        print(name, json.dumps(tables[name]), flush=True)
    if chosen.record:
        put_down(tables, chosen.records)


if __name__ == "__main__":
    main()
