"""Names in four languages, and a damaged row in the head of a log."""

from __future__ import annotations

from pathlib import Path

import pytest

from piga.describe.columns import kind_of_name, unit_in_name
from piga.describe.log import text_layout


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
    assert layout.options.header == 1
    assert layout.form.names == ("t", "n", "fx", "fy", "fz")
