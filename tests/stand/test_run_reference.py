"""The ``[stand]`` table of a run file: reference where the log has none, rows of the uncertainty budget."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import piga
from piga.data import copy_example
from piga.errors import ArgumentError
from piga.records.calibration.coefficient import Amount
from piga.stand import (
    DividingHead,
    LoggedProfile,
    stand_changes,
)
from piga.stand.run_reference import plan_times
from piga.units import ARCSEC, G0
from tests.stand.simulated import SITE

STAND = """
[stand]
kind = "dividing-head"
latitude = "40 deg"
gravity = "9.80166 m/s^2"
positions = "0:360:15 deg"
"""


def edited(folder: Path, *, stand: str = STAND, uncertainty: str = "") -> Path:
    path = copy_example(folder)
    lines = path.read_text().split("[uncertainty]")[0].splitlines()
    lines = [line for line in lines if not line.startswith(("reference =", "base_rate ="))]
    path.write_text("\n".join(lines) + stand + uncertainty)
    return path


def test_the_stand_gives_the_reference_of_the_shipped_record(tmp_path: Path) -> None:
    logged = piga.read_run(copy_example(tmp_path))
    run = piga.read_run(edited(tmp_path))
    np.testing.assert_allclose(run.f, logged.f, atol=1e-9 * G0)
    assert run.base_rate is not None
    assert logged.base_rate is not None
    np.testing.assert_allclose(run.base_rate, logged.base_rate, atol=1e-13)


def test_positions_by_name(tmp_path: Path) -> None:
    names = ", ".join(f'"{k}" = "{15 * k} deg"' for k in reversed(range(24)))
    by_name = STAND.replace('"0:360:15 deg"', f"{{ {names} }}")
    run = piga.read_run(edited(tmp_path, stand=by_name))
    np.testing.assert_allclose(run.f, piga.read_run(edited(tmp_path)).f, atol=1e-12)


@pytest.mark.parametrize(
    ("stand", "uncertainty", "message"),
    [
        (
            STAND.replace("0:360:15", "0:360:45"),
            "",
            r"8 positions or levels, the record has 24 segments \(.+, .+\)",
        ),
        (STAND.replace("dividing-head", "swing"), "", "'swing' is not one of"),
        (STAND.replace("latitude", "lattitude"), "", "lattitude|latitude"),
        (STAND.replace("40 deg", "40 g"), "", r"\[stand\] latitude.*quantity in 'rad'"),
        (
            '[stand]\nkind = "vibration-table"\nlatitude = "40 deg"\n[[stand.drives]]\nshape = "rest"\nduration = "60 s"\n',
            "",
            "phase of the drive",
        ),
        ("", "", r"\[data\] reference is missing"),
        ("", '[uncertainty]\nlevelling = "1 arcsec"\n', "levelling: belongs to a stand"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, stand: str, uncertainty: str, message: str) -> None:
    path = edited(tmp_path, stand="\n" + stand, uncertainty=uncertainty)
    with pytest.raises(piga.RunFileError, match="(?s)" + message) as caught:
        piga.read_run(path)
    assert str(path) in str(caught.value)


def test_stand_entries_need_a_stand_that_has_them(tmp_path: Path) -> None:
    wrong = piga.read_run(edited(tmp_path, uncertainty='[uncertainty]\narm_radius = "1 um"\n'))
    with pytest.raises(
        piga.RunFileError, match=r"\[uncertainty\] arm_radius does not exist on a dividing-head"
    ):
        list(stand_changes(wrong))
    unit = piga.read_run(edited(tmp_path, uncertainty='[uncertainty]\nangle_error = "1 um"\n'))
    with pytest.raises(piga.RunFileError, match=r"angle_error.*'1 um'"):
        list(stand_changes(unit))


def test_each_component_changes_the_force_as_its_geometry_says(tmp_path: Path) -> None:
    entries = (
        '[uncertainty]\nangle_error = "2 arcsec"\nlevelling = "1 arcsec"\nangle_harmonics = [[2, "1 arcsec"]]\n'
    )
    run = piga.read_run(edited(tmp_path, uncertainty=entries))
    changes = {change.name: change for change in stand_changes(run)}
    assert set(changes) == {
        "angle_error", "levelling axis 1", "levelling axis 2",
        "angle_harmonics order 2 (sine)", "angle_harmonics order 2 (cosine)",
    }  # fmt: skip
    turned = changes["angle_error"].change(slice(0, run.size))
    np.testing.assert_allclose(turned[:, 0], 2.0 * ARCSEC * run.f[:, 1], atol=1e-9)
    np.testing.assert_allclose(turned[:, 1], -2.0 * ARCSEC * run.f[:, 0], atol=1e-9)


def test_entries_of_the_stand_have_distributions(tmp_path: Path) -> None:
    """Half-width over root three for a rectangular one; each component keeps shape and degrees of freedom."""
    entries = (
        '[uncertainty]\nangle_error = { half_width = "3 arcsec", distribution = "rectangular" }\n'
        'levelling = { standard = "1 arcsec", distribution = "t", degrees_of_freedom = 8 }\n'
    )
    changes = {c.name: c for c in stand_changes(piga.read_run(edited(tmp_path, uncertainty=entries)))}
    number, unit = changes["angle_error"].written.split()
    assert (float(number), unit) == (pytest.approx(3.0 / np.sqrt(3.0), rel=1e-8), "arcsec")
    assert changes["angle_error"].distribution == "rectangular"
    assert changes["levelling axis 2"].written == "1 arcsec"
    assert (changes["levelling axis 2"].distribution, changes["levelling axis 2"].degrees_of_freedom) == (
        "t",
        8.0,
    )
    for wrong, message in (
        ('angle_error = { half_width = "1 arcsec" }', "no half-width"),
        ('angle_error = { width = "1 arcsec" }', r"\[uncertainty.angle_error\] has the unknown key 'width'"),
        ('angle_harmonics = { standard = "1 arcsec" }', "a list is needed"),
    ):
        run = piga.read_run(edited(tmp_path, uncertainty=f"[uncertainty]\n{wrong}\n"))
        with pytest.raises(piga.RunFileError, match=message):
            list(stand_changes(run))


@pytest.mark.long
def test_budget_has_the_rows_of_the_stand(tmp_path: Path) -> None:
    """An index error of the head is a misalignment m_Y, and nothing else, to first order."""
    run = piga.read_run(edited(tmp_path, uncertainty='[uncertainty]\nangle_error = "2 arcsec"\n'))
    rows = {row.source: row for row in piga.calibrate(run).budget}
    result = rows["angle_error"]
    assert result.standard_uncertainty == Amount(2.0, "arcsec")
    assert abs(result.contributions["m_Y"]) == pytest.approx(2.0 * ARCSEC, rel=1e-2)
    assert abs(result.contributions["k0"]) < 1e-9


@pytest.mark.parametrize("bits", [None, 16])
def test_a_record_without_reference_is_read_where_none_is_needed(tmp_path: Path, bits: int | None) -> None:
    path = edited(tmp_path, stand="\n")
    if bits is not None:
        path.write_text(path.read_text().replace("= 72000", f"= 72000\ncounter_bits = {bits}"))
        header, *rows = (tmp_path / "tumble-a.csv").read_text().splitlines()
        cells = [row.split(",") for row in rows]
        folded = [",".join([*c[:2], str(int(c[2]) % 2**bits), *c[3:]]) for c in cells]
        (tmp_path / "tumble-a.csv").write_text("\n".join([header, *folded]) + "\n")
    run = piga.read_run(path, need_reference=False)
    assert np.isnan(run.f).all()
    (tmp_path / "again").mkdir()
    logged = piga.read_run(copy_example(tmp_path / "again"))
    steps = ~run.begins[1:]
    np.testing.assert_allclose(np.diff(run.output)[steps], np.diff(logged.output)[steps], atol=1e-9)
    with pytest.raises(piga.RunFileError, match="reference is missing"):
        piga.read_run(path)


SHORT_HEAD = DividingHead(SITE, (0.0, 1.0), dwell=4.0, move=2.0)


def test_segments_of_a_log_are_taken_in_order_when_their_names_say_nothing() -> None:
    t = np.array([100.0, 101.0, 200.0, 203.0, 209.0])
    at = plan_times(SHORT_HEAD, None, ("first", "second"), t, np.array([0, 0, 1, 1, 1], dtype=np.int32))
    assert at == pytest.approx([0.0, 1.0, 6.0, 9.0, 10.0])  # no further than the end of the dwell
    log = LoggedProfile(np.array([0.0, 1.0]), np.zeros((2, 3)), np.zeros((2, 3)))
    assert plan_times(log, None, (), t, np.zeros(5, dtype=np.int32)) is t


def test_numbers_of_a_log_do_not_match_some_of_the_positions_by_chance() -> None:
    """Two segments named by their numbers, as piga names what it finds, and a stand of more positions."""
    planned = [part.label for part in SHORT_HEAD.segments() if part.recorded]
    assert len(planned) == 2
    with pytest.raises(ArgumentError, match="2 positions or levels, the record has 1 segments"):
        plan_times(SHORT_HEAD, None, (planned[0],), np.zeros(3), np.zeros(3, dtype=np.int32))
