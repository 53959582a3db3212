"""The page, the text and the document of a trend."""

from __future__ import annotations

import datetime as dt

import numpy as np

from piga.reports.render.page import page_html, page_text
from piga.reports.trend import brief as trend_brief
from piga.reports.trend import page as trend_page
from piga.reports.trend import trend_document
from piga.trend.history import find_trend
from tests.trend.history import START, record

AT = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)


def instrument(days=9, step=150):
    rng = np.random.default_rng(4)
    entries = []
    for day in range(days):
        for run in range(2 if day % 3 == 0 else 1):
            values = {
                "scale_factor": 0.8885092 + 3e-6 * day / 3 + rng.normal(0, 1e-6),
                "tan_beta": 3.587e-4 + rng.normal(0, 2e-7),
                "k0": 1.6e-3 + rng.normal(0, 3e-6) + (6e-5 if day == 7 else 0.0),
                "k2": rng.normal(0, 1e-6),
                "k1_T": -2e-6 + rng.normal(0, 1e-8),
            }
            stds = {"scale_factor": 1e-6, "tan_beta": 2e-7, "k0": 1e-6, "k2": 1e-6, "k1_T": 1e-8}
            when = START + dt.timedelta(days=step * day, hours=2 * run)
            entries.append(
                (f"r{day}-{run}", when, record(values, stds, {"reference_scale": {"scale_factor": 9e-7}}))
            )
    return find_trend(entries)


def test_page_holds_every_coefficient_and_alarm():
    made = instrument()
    html = page_html(trend_page(made, at=AT))
    for trend in made.coefficients:
        assert f'id="coefficient-{trend.key.replace("_", "-")}"' in html
    assert made.alarms
    assert "record r7-0" in html
    assert "Forecast for 2026-01-01" in html
    assert "scale_factor drifts by" in html
    assert html == page_html(trend_page(made, at=AT))


def test_what_is_not_judged_is_not_called_in_control():
    entries = [(f"r{k}", START + dt.timedelta(days=k), record({"k0": 1e-3}, {"k0": 1e-6})) for k in range(4)]
    texts = [page_text(trend_brief(find_trend(entries[:n]))) for n in (2, 3, 4)]
    for text, judged in zip(texts, (0, 0, 1), strict=True):
        assert ("No record is out of control" in text) == (judged > 0)
        assert ("No record is judged yet" in text) == (judged == 0)
        assert f"{judged} of " in text
    assert "0 of 1, needs three days" in texts[0]


def test_text_and_document():
    made = instrument()
    text = page_text(trend_brief(made, at=AT))
    assert text.isascii()
    assert "problem: k0: record r7-0" in text
    document = trend_document(made, at=AT)
    k0 = next(c for c in document["coefficients"] if c["name"] == "k0")
    assert [r["record"] for r in k0["records"] if r["out_of_control"]] == ["r7-0"]
    assert k0["forecast"]["half_width_95"] > k0["forecast"]["std"]
    assert k0["next_record"]["date"] == "2026-01-01T00:00:00+00:00"
