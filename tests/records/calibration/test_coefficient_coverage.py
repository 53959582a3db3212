"""One expanded uncertainty: every place that prints, signs or judges states the same k, U and limits.

The truth is SciPy's Student t. The degrees of freedom of Type A are computed here with the full matrices of the rows, by the
formulas of Bell and McCaffrey as they publish them. They are put together with an exactly known Type B by JCGM 100,
equation G.2b.
"""

from __future__ import annotations

import datetime as dt
import html
import json
import re
from dataclasses import replace
from functools import cache

import msgspec
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import fractional_matrix_power

import piga
from piga.certificate.certificate_file import ConformityTable, verdicts
from piga.certificate.page import certificate_html
from piga.records.calibration.calibration import Calibration
from piga.records.calibration.document import calibration_to_bytes, to_document
from piga.records.run_file import UncertaintyTable
from piga.reports.calibration.page import page as calibration_page
from piga.reports.render.page import page_html
from piga.reports.trend import page as trend_page
from piga.reports.trend import trend_document
from piga.trend.history import find_trend
from piga.units import G0
from tests.certificate.certificate_data import changed, complete

TERMS = ["scale_factor", "k0", "k2"]
K = 0.8884 / G0
ROWS = {4: 7, 12: 15, 997: 1000}
"""Rows of a record by its surplus observations: three coefficients are fitted."""
BLOCKS = 20
"""A continuous record is cut into 20 blocks of equal length, or one for each row (docs/theory/calibration)."""


def rate_log(rows: int, seed: int = 1) -> piga.Run:
    """Rates of a tumble with white noise, and a reference known to 0.2 ppm (exactly known)."""
    rng = np.random.default_rng(seed)
    a = G0 * np.cos(np.linspace(0.1, 6.0, rows))
    f = np.column_stack([a, np.zeros(rows), np.zeros(rows)])
    rate = K * (a + 300e-6 * G0 + 5e-6 * a**2 / G0 + 2e-6 * G0 * rng.standard_normal(rows))
    run = piga.Run.from_arrays(
        np.arange(rows) * 1.0, rate, f, scale_factor="0.8884 rad/s/g", kind="rate", serial="G-0417", units="SI"
    )
    waived = dict.fromkeys(("reference_misalignment", "timing", "vibration", "earth_rate"), "simulated")
    stated = UncertaintyTable(reference_scale="0.2 ppm", reference_bias="0.3e-6 g", waived=waived)
    return replace(run, uncertainty=stated)


@pytest.fixture(scope="module", params=list(ROWS))
def cal(request) -> Calibration:
    cal = piga.calibrate(rate_log(ROWS[request.param]), TERMS, "rate")
    cal = replace(cal, provenance=replace(cal.provenance, created="2026-01-01T00:00:00Z"))
    assert cal.quality.masked == 0
    assert cal.surplus_observations == request.param
    assert cal.segment_scatter == 0.0  # all rows have the same weight
    return cal


@cache
def degrees_by_hand(rows: int) -> dict[str, float]:
    """Satterthwaite's degrees of freedom of the three coefficients from the residual matrix of all rows.

    Block j adds ``v_j' y`` to a coefficient, with ``v_j = (1 - H)_j (1 - H_jj)^-1/2 X_j (X'X)^-1 c``. If all rows have
    the same noise, these have the covariance ``P = V'V``. They count with the weights ``(P_jj + mean/1000)^-1/2``.
    """
    a = np.cos(np.linspace(0.1, 6.0, rows))
    x = np.column_stack([a, np.ones(rows), a**2])
    parts = np.split(np.arange(rows), np.unique(np.linspace(0, rows, BLOCKS + 1).astype(int))[1:-1])
    inverse = np.linalg.inv(x.T @ x)
    rest = np.eye(rows) - x @ inverse @ x.T
    roots = [fractional_matrix_power(rest[np.ix_(own, own)], -0.5).real @ x[own] @ inverse for own in parts]
    found = {}
    for column, key in enumerate(TERMS):
        v = np.column_stack([rest[:, own] @ root[:, column] for own, root in zip(parts, roots, strict=True)])
        p = v.T @ v
        w = (p.diagonal() + p.diagonal().mean() / 1000.0) ** -0.5
        found[key] = (w @ p.diagonal()) ** 2 / (w @ p**2 @ w)
    return found


def expected(cal: Calibration, key: str) -> tuple[float, float]:
    """k and U by hand."""
    a = cal.budget[0].contributions[key]
    nu = degrees_by_hand(ROWS[cal.surplus_observations])[key] * (cal[key].std / a) ** 4
    k = float(stats.t.ppf(0.975, nu))
    return k, k * cal[key].std


def shown(text: str) -> float:
    """A printed number."""
    return float(
        text.replace("\u202f", "")
        .replace(" × 10", "e")
        .translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹−", "-0123456789-"))
    )


def cells(page: str, key: str, heading: str) -> list[str]:
    """The row of a coefficient in the first table that has this heading."""
    table = next(t for t in re.findall(r"<table.*?</table>", page, re.DOTALL) if heading in t)
    row = next(r for r in re.findall(r"<tr.*?</tr>", table, re.DOTALL) if f">{key}<" in r)
    plain = (re.sub("<[^>]*>", "", cell) for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.DOTALL))
    return [html.unescape(cell).strip() for cell in plain]


def same(text: str, half: float, key: str, unit: str) -> None:
    """Printed to two digits in ``unit``, the number is U."""
    factor = 1e6 if unit.startswith(("µ", "u")) else 1.0
    assert shown(text) == pytest.approx(half * factor, rel=0.051), key  # 1.0 stands for 0.95 to 1.05
    assert f"{shown(text):.1e}" == f"{half * factor:.1e}", key


def test_json_and_terminal(cal):
    stated = {c["name"]: c for c in json.loads(calibration_to_bytes(cal))["coefficients"]}
    text = cal.summary().split("Coefficient  ")[1].split("\n\n")[0]
    lines = {line.split()[0]: line.split() for line in text.splitlines()[1:]}
    for key in TERMS:
        k, half = expected(cal, key)
        assert stated[key]["coverage_factor"] == pytest.approx(k, rel=1e-9)
        assert stated[key]["expanded"] == pytest.approx(half, rel=1e-9)
        assert cal[key].limits == pytest.approx((cal[key].value - half, cal[key].value + half), rel=1e-12)
        same(lines[key][3], half, key, lines[key][4])
        assert float(lines[key][-1]) == pytest.approx(k, abs=0.0051)


@pytest.mark.parametrize(
    "page_of", [lambda cal: page_html(calibration_page(cal)), lambda cal: certificate_html(complete(), cal)],
    ids=["report", "certificate"],
)  # fmt: skip
def test_page(cal, page_of):
    page = page_of(cal)
    for key in TERMS:
        k, half = expected(cal, key)
        row = cells(page, key, "U (95 %)")
        same(row[3], half, key, row[4])
        assert float(row[-1]) == pytest.approx(k, abs=0.0051)


def test_dcc_and_read_back(cal, tmp_path):
    etree = pytest.importorskip("lxml.etree")
    from piga.certificate.dcc import dcc_document, read_dcc, written

    raw = written(dcc_document(complete(), cal))
    names = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
    reals = {r.findtext("si:label", "", names): r for r in etree.fromstring(raw).iterfind(".//si:real", names)}
    to_si = {"scale_factor": 1.0 / G0, "k0": G0, "k2": 1.0 / G0}
    for key in TERMS:
        k, half = expected(cal, key)
        assert float(reals[key].findtext(".//si:coverageFactor", "", names)) == pytest.approx(k, abs=1e-6)
        stated = float(reals[key].findtext(".//si:valueExpandedMU", "", names))
        assert stated == pytest.approx(half * to_si[key], rel=1e-9)
    path = tmp_path / "c.xml"
    path.write_bytes(raw)
    back = read_dcc(path)
    assert to_document(back) == to_document(cal)
    assert [(c.limits, c.coverage_factor) for c in back.coefficients] == [
        (c.limits, c.coverage_factor) for c in cal.coefficients
    ]


def test_trend(cal):
    times = [dt.datetime(2024, 1, day, tzinfo=dt.UTC) for day in (1, 2)]
    trend = find_trend([("a", times[0], cal), ("b", times[1], cal)])
    stated = {c["name"]: c["records"][-1] for c in trend_document(trend)["coefficients"]}
    page = page_html(trend_page(trend))
    for key in TERMS:
        k, half = expected(cal, key)
        assert stated[key]["half_width_95"] == pytest.approx(half, rel=1e-9)
        on_page = cells(page, key, "On the last day")
        spread, power = re.fullmatch(r"\(?[^±]*± ([^)]*)\)?(.*)", on_page[2]).groups()
        same(spread + power, half, key, on_page[1])
        # without a common part the record's own is Type A alone, with its own degrees of freedom
        a = cal.budget[0].contributions[key]
        assert stated[key]["own_half_width_95"] == pytest.approx(
            stats.t.ppf(0.975, degrees_by_hand(ROWS[cal.surplus_observations])[key]) * a, rel=1e-6
        )
        assert k > 1.95


def test_monte_carlo_interval_is_the_one_that_is_judged_and_signed(cal, tmp_path):
    """An interval that is not symmetric: limits, guard band and DCC take its ends, not value -+ U."""
    etree = pytest.importorskip("lxml.etree")
    from piga.certificate.dcc import dcc_document, read_dcc, written

    ends = (cal["k0"].value - 1e-6, cal["k0"].value + 3e-6)
    cal = replace(
        cal, coefficients=tuple(replace(c, interval=ends) if c.name == "k0" else c for c in cal.coefficients)
    )
    for low, high, status in ((-1.1e-6, 3.1e-6, "pass"), (-2.1e-6, 2.9e-6, "conditionalPass")):
        limits = {"k0": (f"{cal['k0'].value + low!r} g", f"{cal['k0'].value + high!r} g")}
        table = ConformityTable(specification="S", rule="guarded", agreed_with_customer=True, limits=limits)
        data = msgspec.structs.replace(complete(), conformity=table)
        assert verdicts(data, cal)[0].status == status
    raw = written(dcc_document(changed(complete()), cal))
    (low,) = etree.fromstring(raw).iterfind(".//{https://ptb.de/si}intervalMin")
    assert float(low.text) == pytest.approx(ends[0] * G0, rel=1e-12)
    path = tmp_path / "c.xml"
    path.write_bytes(raw)
    assert read_dcc(path)["k0"].limits == ends
    page = certificate_html(complete(), cal)
    assert "Shortest 95 % interval by Monte Carlo" in page
    assert "coverage_factor" not in next(c for c in to_document(cal)["coefficients"] if c["name"] == "k0")
