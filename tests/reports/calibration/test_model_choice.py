"""The comparison of term sets fits a terminal of 80 columns, whatever its figures."""

from piga.reports.calibration.model_choice import comparison_table, comparison_words
from piga.reports.render.page import Page, Section, Text, page_text

TERMS = ["scale_factor", "tan_beta", "k0", "m_Y"]
LONG = [*TERMS, "k2", "k3", "k_XY", "k_XZ", "k_YY", "k_ZZ", "k_YZ", "m_Z"]


def result(terms, above):
    return {
        "terms": terms, "parameters": len(terms) + 1, "chi_square_per_degree": 1.0 + above, "bic": above,
        "bic_above_best": above, "weight": 0.37, "prediction_chi_square": 1e3 + above, "prediction_above_best": above,
        "prediction_standard_error": 0.1 * above, "prediction_force_error": 1e-5 * (1.0 + above),
    }  # fmt: skip


DOCUMENT = {
    "noise_terms": ["scale_factor"], "observations": 4000,
    "best": TERMS, "best_prediction": TERMS, "parted_by": "segment", "folds": 24, "parts": 24,
    "sets": [
        result(["scale_factor", "tan_beta"], 9.93e7), result(TERMS, 0.0), result(["k0"], 950782.0),
        {"terms": LONG, "reason": "this record cannot separate k0, k2, k_YY, k_ZZ, k_XY, m_Y and a few terms more"},
    ],
}  # fmt: skip


def lines_of(document):
    blocks = (Text(comparison_words(document)), comparison_table(document))
    return page_text(Page("", sections=(Section("", "sets", blocks),)), width=100).splitlines()


def test_no_line_is_wider_than_the_terminal_and_no_word_is_broken():
    lines = lines_of(DOCUMENT)
    assert max(map(len, lines)) <= 100
    assert "\n".join(lines).isascii()
    words = set(" ".join(lines).replace(",", " ").replace("(", " ").replace(")", " ").split())
    assert {"scale_factor", "tan_beta", "k_YZ", "separate"} <= words


def test_the_best_comes_first_and_figures_stand_under_their_heads():
    lines = lines_of(DOCUMENT)
    parts = [k for k, line in enumerate(lines) if line.startswith("  set")]
    assert len(parts) > 1
    assert all(lines[k + 1].split()[0] == "2" for k in parts)
    assert any(line.split()[:1] == ["1"] and "9.93e7" in line for line in lines)
    assert any("2  scale_factor, tan_beta, k0, m_Y" in line for line in lines)
    assert any(line.startswith("    2  ") and "least BIC" in line for line in lines)
