"""Any layout that a spreadsheet or logger can write is recognised, and the numbers read are those written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from piga.describe import describe_log, draft_run_file
from piga.describe.columns import kind_of_name, unit_in_name
from piga.describe.log import text_layout
from piga.reading.columns import open_stream
from piga.records.run_file import read_run_file

LANGUAGES = {
    "en": ("Time", "Position", "Counts", "Acceleration X", "Acceleration Y", "Acceleration Z"),
    "de": ("Zeit", "Lage", "Zählerstand", "Beschleunigung X", "Beschleunigung Y", "Beschleunigung Z"),
    "fr": ("Temps", "Palier", "Impulsions", "Accélération X", "Accélération Y", "Accélération Z"),
    "zh": ("时间", "位置", "脉冲数", "X轴加速度", "Y轴加速度", "Z轴加速度"),
}
ENCODINGS = {
    "en": ("utf-8", "utf-16", "cp1252"),
    "de": ("utf-8", "utf-8-sig", "cp1252"),
    "fr": ("utf-8", "cp1252"),
    "zh": ("utf-8", "gb18030"),
}

PREAMBLE = ["Operator: A. B.", "# logger 3", "", "Test;12", "1.5", "Note: ok"]


@st.composite
def layouts(draw: st.DrawFn) -> dict[str, object]:
    language = draw(st.sampled_from(sorted(LANGUAGES)))
    separator = draw(st.sampled_from([";", "\t", ",", "|"]))
    return {
        "language": language,
        "encoding": draw(st.sampled_from(ENCODINGS[language])),
        "separator": separator,
        "decimal": "." if separator == "," else draw(st.sampled_from([".", ","])),
        "end": draw(st.sampled_from(["\n", "\r\n"])),
        "units": draw(st.sampled_from(["row", "dashes", "brackets"])),
        "preamble": draw(st.lists(st.sampled_from(PREAMBLE), max_size=4)),
        "rate": draw(st.sampled_from([10.0, 20.0, 64.0])),
        "order": draw(st.permutations(range(6))),
    }  # fmt: skip


def write(path: Path, case: dict) -> np.ndarray:
    t = np.arange(120) / case["rate"]
    position = 1 + np.arange(120) // 40
    angle = np.deg2rad(30.0 * (position - 1))
    fx, fy = np.cos(angle), -np.sin(angle)
    counts = np.round(np.cumsum(10180.0 / case["rate"] * fx))
    columns = [t, position, counts, fx, fy, 0.01 * np.sin(angle) + 0.001]
    units = ["s", "", "", "g", "g", "g"]
    text = [[f"{v:.6f}" for v in t], [f"{p:d}" for p in position], [f"{n:.0f}" for n in counts]]
    text += [[f"{v:.8f}" for v in column] for column in columns[3:]]
    names = list(LANGUAGES[case["language"]])
    if case["units"] == "brackets":
        names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    sep = case["separator"]
    lines = [line.replace(";", sep) for line in case["preamble"]]
    lines.append(sep.join(names[k] for k in case["order"]))
    if case["units"] != "brackets":
        blank = "-" if case["units"] == "dashes" else ""
        lines.append(sep.join(units[k] or blank for k in case["order"]))
    lines += [sep.join(text[k][row].replace(".", case["decimal"]) for k in case["order"]) for row in range(120)]
    path.write_bytes((case["end"].join(lines) + case["end"]).encode(case["encoding"]))
    return np.array([[float(v) for v in column] for column in text])


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(case=layouts())
def test_any_layout(tmp_path: Path, case: dict) -> None:
    log = tmp_path / "log.csv"
    written = write(log, case)
    draft = draft_run_file(describe_log(log), {"instrument.scale_factor": "0.8884 rad/s/g"})
    assert draft.open == []
    assert draft.document["instrument"]["counts_per_revolution"] == 72000
    data = read_run_file(tmp_path / "run.toml", draft.text().encode()).data
    names = LANGUAGES[case["language"]]
    assert data.time is not None
    assert (data.time.column, data.time.unit) == (names[0], "s")
    assert data.segment == names[1]
    assert (data.output.column, data.output.kind) == (names[2], "counts")
    assert data.reference is not None
    assert (data.reference.columns, data.reference.unit) == (names[3:], "g")
    stream = open_stream(tmp_path, data)
    chunks = list(stream.chunks())
    for name, column in zip((names[0], *names[2:]), (written[0], *written[2:]), strict=True):
        np.testing.assert_array_equal(np.concatenate([chunk.numbers[name] for chunk in chunks]), column)


def test_names_in_four_languages() -> None:
    for kind, names in {
        "time": ("t", "t_s", "Zeit [s]", "Zeitstempel", "Temps", "时间（s）", "X_Value", "Elapsed Time"),
        "counts": ("n", "counts", "Zählerstand", "Zaehler", "Impulsions", "脉冲数", "Pulse count", "计数"),
        "temperature": ("T_amb", "Temperatur (°C)", "température", "温度(℃)", "temp_degC"),
        "segment": ("position", "Lage", "Palier", "位置号", "Pos-Nr"),
        "stand-angle": (
            "Teilkopfwinkel",
            "Stellung Teilkopf",
            "Winkel des Drehtischs",
            "table angle",
            "分度头角度",
            "position du plateau",
        ),
        "stand-speed": ("Drehzahl", "rpm", "转速", "vitesse de rotation"),
        "sequence": ("sample no", "lfd. Nr.", "序号"),
        "other": ("Bemerkung", "status", "备注", "U_bat"),
    }.items():
        for name in names:
            assert kind_of_name(name)[0] == kind, name
    for name in ("fx", "a_x_g", "Beschl. X", "X轴加速度", "accX", "Accélération X [m/s²]"):
        assert kind_of_name(name) == ("force", 0), name
    assert [kind_of_name(name) for name in ("fx_g", "加速度Y", "acc_z", "w_y", "omega_z_rad_s", "Drehrate X")] == [
        ("force", 0), ("force", 1), ("force", 2), ("base-rate", 1), ("base-rate", 2), ("base-rate", 0),
    ]  # fmt: skip
    assert unit_in_name("wx_rad_s") == ("wx", "rad/s")


@pytest.mark.parametrize("damage", ["\0" * 20, "12:03:04 logger restarted", "1;2"])
def test_a_damaged_row_near_the_start_does_not_end_the_table(tmp_path: Path, damage: str) -> None:
    """Else the rows above it would be lost, and the columns without their names."""
    body = [f"{k / 10},{10 * k},1.0,0.0,0.0" for k in range(60)]
    body[20] = damage
    (tmp_path / "x.csv").write_text("\n".join(["t,n,fx,fy,fz", *body]) + "\n")
    layout = text_layout(tmp_path / "x.csv")
    assert layout.rows.header == 1
    assert layout.names == ("t", "n", "fx", "fy", "fz")
