"""Run files: what is refused, and how it is said."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import piga
from piga.records import read_run_file
from piga.records.terms import check_terms, term_words
from tests.records.files import lines, write_log, write_run


def test_the_former_name_of_a_key_is_read(tmp_path: Path) -> None:
    """A file of version 0.1 says ``phase``. Of both names the new one counts."""
    path = write_run(tmp_path)
    text = path.read_text(encoding="utf-8")
    for said, wanted in (("phase", "per-segment"), ("phase = 'shared'\nphases", "per-segment")):
        path.write_text(text.replace("[model]\n", f"[model]\n{said} = '{wanted}'\n"), encoding="utf-8")
        assert read_run_file(path).model.phases == wanted


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('serial = "T-1"', 'seriol = "T-1"', r"\[instrument\] has the unknown key 'seriol'.*mean 'serial'"),
        ('serial = "T-1"', "serial = 7", r"\[instrument.serial\]: expected text"),
        ('"T-1"', f'"{"T" * 201}"', r"run.toml: \[instrument\] serial has 201 characters\n  remedy: use 200"),
        ('serial = "T-1"\n', "", r"\[instrument\] lacks the key 'serial'"),
        ('"0.8884 rad/s/g"', '"0.8884 g"', r"\[instrument\] scale_factor: .*quantity in 'rad/s/g'"),
        ('"0.8884 rad/s/g"', '"-1 rad/s/g"', "must be positive"),
        ("72000", "0", r"\[instrument.counts_per_revolution\]: expected a number >= 1e-06"),
        ("counts_per_revolution = 72000", "", "counts_per_revolution is missing"),
        ("[data]", "counter_bits = 99\n[data]", r"\[instrument.counter_bits\]: expected a whole number <= 62"),
        ('unit = "s"', 'unit = "deg"', r"\[data\] time: unit 'deg'"),
        ('unit = "g" }', 'unit = "furlong" }', r"\[data\] reference: unknown unit 'furlong'"),
        (
            'kind = "counts"',
            'kind = "turns"',
            "'turns' is not one of the allowed values\n  remedy: one of: counts, pulses, angle, rate",
        ),
        ('kind = "counts"', 'kind = "angle"', "kind 'angle' needs a unit"),
        ('kind = "counts"', 'kind = "counts", unit = "rad"', "cannot be used with kind 'counts'"),
        ('kind = "counts"', 'kind = "counts", wraps_at = "1 rev"', "wraps_at is for kind 'angle'"),
        ('kind = "counts"', 'kind = "angle", unit = "deg", wraps_at = "-1 rev"', "wraps_at must be positive"),
        ('time = { column = "t", unit = "s" }', "", "either time or sample_rate"),
        ('time = { column = "t", unit = "s" }', 'sample_rate = "0 Hz"', "sample_rate: must be positive"),
        ('"fx", "fy", "fz"', '"fx", "fy"', r"\[data.reference.columns\]"),
        ('terms = ["scale_factor", "k0"]', 'terms = ["kO"]', "unknown term 'kO'"),
        ("[model]", '[uncertainty]\nreference_scale = "-1 ppm"\n[model]', "is negative"),
        ("[model]", '[uncertainty]\nreference_scale = "2 arcsec"\n[model]', "quantity in 'ppm'"),
        ("[model]", '[estimation]\nangle_rms = "1 urad"\n[model]', "one of them is missing"),
        ("[model]", "[model", "not valid TOML: .*line"),
        ("[data]", '[data]\ndelimiter = ","\ndecimal = ","', "the same character"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = write_run(tmp_path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    pattern = "(?s)" + message
    with pytest.raises(piga.RunFileError, match=pattern) as caught:
        read_run_file(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("truth", "a scenario: 'piga simulate' makes a run file of it"),
        ("plan", "a plan: give it to 'piga plan'"),
        ("polar", "give it to 'piga platform'"),
        ("laboratory", "give it to 'piga certificate' as --data"),
    ],
)
def test_a_file_of_another_kind_is_recognised(tmp_path: Path, table: str, words: str) -> None:
    path = write_run(tmp_path)
    path.write_text(f"[{table}]\n" + path.read_text())
    with pytest.raises(piga.RunFileError, match=f"has the unknown key '{table}'") as caught:
        read_run_file(path)
    assert caught.value.remedy.startswith("it looks like ")
    assert caught.value.remedy.endswith(words)


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(piga.RunFileError, match="not UTF-8"):
        read_run_file(tmp_path / "bytes.toml")


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "any.toml"
    path.write_text(text, encoding="utf-8", errors="replace")
    with pytest.raises(piga.PigaError):
        read_run_file(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"data": "range = { speed = [0.0, 1.0] }"}, "range: 'speed' is not a column in use"),
        ({"data": "range = { fx = [1.0, 0.0] }"}, "range: 'fx': 1 is not below 0"),
        ({"data": 'segment = "fx"'}, "'fx' is a number column that is in use already"),
        ({"model": 'compare = [["scale_factor"], ["scale_factor", "k9"]]'}, r"\[model\] compare(?s:.*)'k9'"),
        (
            {"model": '[uncertainty]\nlevelling = "2 arcsec"'},
            r"\[uncertainty\] levelling: belongs to a stand(?s:.*)add \[stand\]",
        ),
        (
            {"model": '[estimation]\nangle_rms = "-1 urad"\nangle_random_walk = "0 rad/sqrt(s)"'},
            "angle_rms: '-1 urad' is negative",
        ),
    ],
)
def test_run_files_that_contradict_themselves(tmp_path: Path, options: dict[str, str], message: str) -> None:
    with pytest.raises(piga.RunFileError, match=message) as caught:
        read_run_file(write_run(tmp_path, **options))
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("key", "changes"),
    [
        (r"\[instrument\] scale_factor: 0.8884", ('"0.8884 rad/s/g"', "0.8884")),
        (r"\[data\] settle: 20", ("[model]", "settle = 20\n[model]")),
        (r"\[uncertainty\] reference_scale: 10", ("[model]", "[uncertainty]\nreference_scale = 10\n[model]")),
        (
            r"\[uncertainty\] gravity: 1e-06",
            ("[model]", "[uncertainty]\ngravity = { standard = 1e-6 }\n[model]"),
        ),
        (r"\[model\] scale_factor_tolerance: 2", ("[model]", "[model]\nscale_factor_tolerance = 2")),
        (r"\[model\] temperature_reference: 20", ("[model]", "[model]\ntemperature_reference = 20")),
        (r"\[stand\] latitude: 52.3", ('reference = { columns = ["fx", "fy", "fz"], unit = "g" }\n', "")),
    ],
)
def test_a_number_without_its_unit_is_refused_with_file_and_key(tmp_path, key, changes):
    write_log(tmp_path, lines())
    path = write_run(tmp_path)
    stand = (
        '[stand]\nkind = "dividing-head"\nlatitude = 52.3\npositions = ["0 deg"]\n' if "stand" in key else ""
    )
    path.write_text(path.read_text().replace(*changes) + stand)
    with pytest.raises(
        piga.PigaError, match=rf'run.toml: {key} has no unit\n  remedy: write its unit.*; piga 0.2 took it as "'
    ):
        piga.read_run(path)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('{ standard = "1 ppm", half_width = "2 ppm" }', "give either standard or half_width"),
        ("{ degrees_of_freedom = 8 }", "give either standard or half_width"),
        ('{ value = "1 ppm", distribution = "rectangular" }', "'value' of a rectangular distribution could be"),
        ('{ half_width = "1 ppm" }', "a normal distribution has no half-width"),
        ('{ standard = "1 ppm", distribution = "t" }', "'t' needs more than two degrees_of_freedom"),
        ('{ standard = "1 ppm", distribution = "t", degrees_of_freedom = 2 }', "needs more than two"),
        ('{ standard = "1 ppm", degrees_of_freedom = 0 }', "degrees_of_freedom must be positive"),
        ('{ half_width = "-1 ppm", distribution = "triangular" }', "'-1 ppm' is negative"),
        ('"-1 ppm"', "'-1 ppm' is negative"),
    ],
)
def test_a_spread_that_says_too_little_or_too_much(tmp_path: Path, entry: str, message: str) -> None:
    path = write_run(tmp_path, model=f"[uncertainty]\nreference_scale = {entry}")
    with pytest.raises(piga.RunFileError, match=message) as caught:
        read_run_file(path)
    assert "[uncertainty] reference_scale" in str(caught.value)
    assert "run.toml" in str(caught.value)
    assert caught.value.remedy


def test_more_segments_than_a_record_may_have(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("piga.reading.columns.MAX_SEGMENTS", 12)
    rows = [f"{row},{index // 2}" for index, row in enumerate(lines(40))]
    write_log(tmp_path, rows, header="t,n,fx,fy,fz,seg")
    with pytest.raises(piga.DataError, match="column 'seg' has more than 12 different segments"):
        piga.read_run(write_run(tmp_path, data='segment = "seg"'))
    assert piga.read_run(write_run(tmp_path)).size == 40


def test_the_sizes_of_the_servo_are_those_of_its_formulas() -> None:
    """docs/understanding/servo: s = K ml/(2 k_i), d = c K^2/k_i."""
    scale, pendulosity, gain, damping = 0.8884 / 9.80665, 9.06e-3, 3000.0, 0.05
    known = 1e6 * 9.80665**2
    assert f"{known * scale * pendulosity / (2.0 * gain):.0f} ug/g^3" in term_words("servo").known
    assert f"{known * damping * scale**2 / gain:.0f} ug/g^3" in term_words("servo_damping").known


@pytest.mark.parametrize(
    ("terms", "message"),
    [
        ((), "no term is asked for"),
        (("k0", "phi"), "'phi' comes with tan_beta"),
        (("k0", "k0"), "'k0' is named twice"),
        (("k0", "s2"), "'s2' without 'c2'"),
        (("c3", "k0"), "'c3' without 's3'"),
        (("k1", "scale_factor"), "the same coefficient"),
        (("s100", "c100"), "unknown term 's100'"),
    ],
)
def test_terms_that_do_not_go_together(terms: tuple[str, ...], message: str) -> None:
    with pytest.raises(piga.RunFileError, match=message) as caught:
        check_terms(terms)
    assert caught.value.remedy


@pytest.mark.parametrize(
    ("name", "near"), [("k_1", "k1"), ("k2k", "k2"), ("tanbeta", "tan_beta"), ("k_xy", "k_XY")]
)
def test_a_mistyped_term_is_answered_with_the_nearest(name: str, near: str) -> None:
    with pytest.raises(piga.RunFileError) as caught:
        check_terms((name,))
    assert caught.value.remedy.startswith(f"did you mean '{near}'? known terms: scale_factor")
