"""What the user says of a column, names over two rows, and the height that is asked for with the latitude."""

from __future__ import annotations

import tomllib
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pytest

import piga
from piga.describe import describe_log, draft_run_file, try_run_file
from piga.errors import ArgumentError
from tests.cli.runner import invoked

SETTINGS = {"instrument.scale_factor": "0.8884 rad/s/g", "instrument.counts_per_revolution": 72000}


def columns() -> list[np.ndarray]:
    """Time [s], counts, angle of a head [deg] that moves between six positions, temperature [degC]."""
    t = np.arange(3600) / 10.0
    at = np.minimum(t // 60.0, 5.0)
    angle = 60.0 * (at + np.clip((t - 60.0 * at - 50.0) / 10.0, 0.0, 1.0))
    counts = np.round(np.cumsum(1018.0 * np.cos(np.radians(angle))))
    return [t, counts, angle, 20.0 + 0.001 * t]


def log(path: Path, *names: list[str]) -> Path:
    rows = np.column_stack(columns())
    if path.suffix == ".csv":
        body = [";".join(f"{value:.6f}" for value in row).replace(".", ",") for row in rows]
        path.write_text("\n".join([*(";".join(row) for row in names), *body]) + "\n", encoding="utf-8")
    elif path.suffix == ".xlsx":
        book = openpyxl.Workbook()
        for row in (*names, *rows.tolist()):
            book.active.append([cell if cell != "" else None for cell in row])
        book.save(path)
    else:
        with h5py.File(path, "w") as out:
            for name, column in zip(names[0], rows.T, strict=True):
                out[f"test/{name}"] = column
    return path


def test_the_place_of_the_laboratory_is_read_from_the_head_of_a_log(tmp_path: Path) -> None:
    head = (
        ["Breite: 48 Grad"],
        ["Höhe: 500 m"],
        ["Zeit [s]", "Zähler [Impulse]", "Kopfwinkel [Grad]", "Temperatur [°C]"],
    )
    draft = draft_run_file(describe_log(log(tmp_path / "log.csv", *head)), SETTINGS)
    assert {key: draft.document["stand"][key] for key in ("latitude", "height")} == {
        "latitude": "48 Grad",
        "height": "500 m",
    }
    assert not draft.optional


@pytest.mark.parametrize("kind", ["csv", "xlsx", "h5"])
def test_a_column_is_told_on_the_command_line(tmp_path: Path, kind: str) -> None:
    path = log(tmp_path / f"log.{kind}", ["Zeit", "Zähler", "Kanal 4", "Kanal 5"])
    options = [part for key, value in SETTINGS.items() for part in ("--set", f"{key}={value}")]
    done = invoked("init", path, *options)
    assert "Not understood: " in done.stdout
    assert "--column '" in done.stdout
    told = ["--column", "Kanal 4=angle [deg]", "--column", "Kanal 5=temperature"]
    done = invoked("init", path, "--force", *options, *told)
    assert "angle of the stand [deg]: as you said" in done.stdout
    assert "stand.latitude" in done.stdout
    assert "--column 'Kanal 4=angle [deg]' --column 'Kanal 5=temperature'" in done.stdout
    assert "--set stand.height='320 m'" in done.stdout
    site = ["--set", "stand.latitude=52 deg", "--set", "stand.height=80 m"]
    done = invoked("init", path, "--force", *options, *told, *site)
    assert done.exit_code == 0
    document = tomllib.loads((tmp_path / "log.toml").read_text(encoding="utf-8"))
    assert document["data"]["segment"]["holds_of"].endswith("Kanal 4")
    assert document["data"]["temperature"]["unit"] == "degC"
    assert len(document["stand"]["positions"]) == 6
    run = piga.read_run(tmp_path / "log.toml")
    assert run.f[:, 0].max() == pytest.approx(9.81, abs=0.01)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        (
            {"Kanal 9": "angle"},
            r"--column Kanal 9: there is no such column\n  remedy: the columns are: Zeit, Z",
        ),
        (
            {"Kanal 4": "tilt"},
            r"=tilt: this is not what a column can hold\n  remedy: one of: time, .*force x, .*angle",
        ),
        ({"Kanal 4": "force"}, "=force: this is not what a column can hold"),
        ({"Kanal 4": "angle [s]"}, r"=angle \[s\]: this is not what"),
        ({"Kanal 4": "counts [deg]"}, r"=counts \[deg\]: this is not what"),
    ],
)
def test_what_cannot_be_told_is_refused(tmp_path: Path, told: dict[str, str], message: str) -> None:
    path = log(tmp_path / "log.csv", ["Zeit", "Zähler", "Kanal 4", "Kanal 5"])
    with pytest.raises(ArgumentError, match=message):
        describe_log(path, told)


def test_what_is_told_is_not_guessed_again(tmp_path: Path) -> None:
    """Words of the page; an axis and a unit; a column that is not used; the segment is read with its labels."""
    path = log(tmp_path / "log.csv", ["Zeit", "Zähler", "Winkel", "Temperatur"])
    told = {"Winkel": "force y [mg]", "Temperatur": "not used", "Zähler": "pulses of each sample"}
    kinds = {one.name: (one.kind, one.axis, one.unit, one.reason) for one in describe_log(path, told).columns}
    assert kinds["Winkel"] == ("force", 1, "mg", "as you said")
    assert kinds["Temperatur"][0] == "other"
    assert draft_run_file(describe_log(path, told), SETTINGS).document["data"]["output"]["kind"] == "pulses"
    assert describe_log(path, {"Winkel": "output angle"}).of("angle")[0].name == "Winkel"
    described = describe_log(path, {"Winkel": "segment"})
    assert described.labels is not None
    assert draft_run_file(described, SETTINGS).document["data"]["segment"] == "Winkel"


@pytest.mark.parametrize("kind", ["csv", "xlsx"])
def test_names_over_two_rows_are_joined(tmp_path: Path, kind: str) -> None:
    """``Kraft`` over ``X``, ``Y``, ``Z``; with units below, and with units in brackets."""
    t, counts, angle, warm = columns()
    x = np.radians(angle)
    rows = np.column_stack([t, counts, np.cos(x), -np.sin(x), 0.0 * x, warm])[::10]
    upper, lower = ["Zeit", "Zähler", "Kraft", "", "", "Temperatur"], ["", "", "X", "Y", "Z", ""]
    for name, units in (("below", ["s", "-", "g", "g", "g", "°C"]), ("none", None)):
        path = tmp_path / f"{name}.{kind}"
        names = [upper, lower, *([units] if units else [])]
        if kind == "csv":
            body = [",".join(f"{value:.6f}" for value in row) for row in rows]
            path.write_text("\n".join(["Pruefstand 3", *map(",".join, names), *body]) + "\n", encoding="utf-8")
        else:
            book = openpyxl.Workbook()
            for row in (["Pruefstand 3"], *names, *rows.tolist()):
                book.active.append([cell if cell != "" else None for cell in row])
            book.save(path)
        described = describe_log(path)
        assert [one.name for one in described.of("force")] == ["Kraft X", "Kraft Y", "Kraft Z"]
        assert [one.name for one in described.of("temperature")] == ["Temperatur"]
        done = invoked("init", path, *[part for k, v in SETTINGS.items() for part in ("--set", f"{k}={v}")])
        assert "It reads 360 of 360 rows" in done.stdout, done.stdout
        run = piga.read_run(path.with_suffix(".toml"))
        assert run.f[:, 0] == pytest.approx(rows[:, 2] * 9.80665, rel=1e-5, abs=1e-5)
    if kind == "csv":
        assert "header_row = [2, 3]" in path.with_suffix(".toml").read_text()


DIRECT = {"V": 2.5, "mA": 1.3, "Hz": 4000.0, "LSB": 16384.0, "count/s": 5e3, "m/s^2": 9.81}
"""Output of an instrument without a gimbal for 1 g of the laboratory."""


def direct_log(folder: Path, unit: str) -> Path:
    """Its output beside the angle of a head, with a bias of 2e-3 of that g."""
    path = log(folder / "log.csv", ["Zeit [s]", "Ausgang", "Teilkopfwinkel [°]", "Temperatur [°C]"])
    head, *rows = path.read_text("utf-8").splitlines()
    angle = columns()[2]
    noise = 1e-5 * np.random.default_rng(2).standard_normal(angle.size)
    output = DIRECT[unit] * (np.cos(np.radians(angle)) + 2e-3 + noise)
    cells = [row.split(";") for row in rows]
    lines = (";".join([c[0], f"{y:.7f}".replace(".", ","), *c[2:]]) for c, y in zip(cells, output, strict=True))
    path.write_text("\n".join([head.replace("Ausgang", f"Ausgang [{unit}]"), *lines]) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize("unit", DIRECT)
def test_an_output_in_another_unit_beside_the_stand_is_that_of_a_direct_instrument(
    tmp_path: Path, unit: str
) -> None:
    draft = draft_run_file(describe_log(direct_log(tmp_path, unit)), {"stand.latitude": "48 deg"})
    assert draft.open == []
    own, output = draft.document["instrument"], draft.document["data"]["output"]
    assert own["kind"] == "direct"
    assert (output["kind"], output["unit"]) == ("rate", unit)
    value, _, written = own["scale_factor"].partition(" ")
    assert float(value) == pytest.approx(DIRECT[unit], rel=2e-3)
    assert written == f"{unit}/g"
    assert draft.document["model"]["terms"] == ["scale_factor", "k0", "m_Y"]


def test_an_output_that_could_be_one_of_two_is_asked_for(tmp_path: Path) -> None:
    path = direct_log(tmp_path, "V")
    path.write_text(path.read_text("utf-8").replace("Temperatur [°C]", "Versorgung [V]"), encoding="utf-8")
    assert "data.output" in [one.key for one in draft_run_file(describe_log(path)).open]
    told = describe_log(path, {"Ausgang": "direct [V]"})
    assert draft_run_file(told).document["data"]["output"]["column"] == "Ausgang"


def test_a_row_of_a_sheet_with_a_word_among_numbers_is_left_out(tmp_path: Path) -> None:
    path = log(tmp_path / "log.xlsx", ["Zeit", "Zähler", "fx [g]", "Notiz"])
    book = openpyxl.load_workbook(path)
    book.active["B51"] = "five"
    for row in range(2, 3602):
        book.active[f"D{row}"] = "ok"
    book.save(path)
    with pytest.raises(ArgumentError, match="--column Notiz=temperature: its cells are not numbers"):
        describe_log(path, {"Notiz": "temperature"})
    settings = SETTINGS | {"data.reference": {"columns": ["fx", "fx", "fx"], "unit": "g"}}
    draft = draft_run_file(describe_log(path), settings)
    run = try_run_file(draft, path.with_suffix(".toml"))
    assert draft.document["data"]["missing"] == ["five"]
    assert (run.quality.rows, run.size) == (3600, 3599)


def test_a_word_among_the_numbers_of_the_positions_is_a_label(tmp_path: Path) -> None:
    """Wherever it stands; the numbers of the others are known."""
    for at in (5, 800):
        path = tmp_path / f"{at}.csv"
        rows = (f"{i / 10};{i * 7};{'five' if i == at else i // 100}" for i in range(1000))
        path.write_text("t;n;position\n" + "\n".join(rows) + "\n")
        described = describe_log(path)
        assert [one.kind for one in described.columns] == ["time", "counts", "segment"]
        assert "five" in described.label_names
        numbers = described.numbers["position"]
        assert np.isnan(numbers[at])
        assert numbers[at + 1] == at // 100
