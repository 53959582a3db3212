"""Write small logs as other programs write them: LabVIEW, spreadsheets and data loggers, in four languages.

The numbers are those of the shipped record: twelve positions of eight seconds at 10 Hz. The logs of a centrifuge and of
a dividing head without reference columns come from simulated tests. ``python -m tests.describe.lab_logs`` writes them to
``tests/data/logs``.
"""

from __future__ import annotations

import csv
import datetime as dt
import gzip
import io
import tempfile
from importlib.resources import files
from pathlib import Path

from piga.stand.scenario import read_scenario, run_scenario
from piga.stand.write_run import write_data

TARGET = Path(__file__).resolve().parents[1] / "data" / "logs"
START = dt.datetime(2026, 3, 12, 23, 59, 0)
Row = tuple[float, str, int, str, str, str]


def rows() -> list[Row]:
    """Time [s], position, counts and the three components [g] as text."""
    text = gzip.decompress(files("piga.data").joinpath("tumble-a.csv.gz").read_bytes()).decode()
    result = []
    for line in csv.DictReader(io.StringIO(text)):
        t, position = float(line["t_s"]), int(line["position"])
        if position % 2 == 0 and round(t * 20) % 2 == 0:
            inside = t - 90.0 * position
            if inside < 8.0:
                values = (f"{float(line[name]):.8f}" for name in ("fx_g", "fy_g", "fz_g"))
                result.append((t, str(position // 2 + 1), int(line["counts"]), *values))
    return result


def comma(text: str) -> str:
    """A number with a decimal comma."""
    return text.replace(".", ",")


def stamped(t: float, form: str) -> str:
    """A time stamp of the logger, to milliseconds."""
    return (START + dt.timedelta(seconds=t)).strftime(form)[:-3]


def german(data: list[Row]) -> bytes:
    """German spreadsheet: cp1252, semicolons, decimal commas, units row with dashes, local stamps past midnight."""
    head = [
        "Prüfprotokoll Kreiselbeschleunigungsmesser;;;;;;",
        "Gerät;G-0417;;;;;",
        "Prüfer;Müller;;;;;",
        "Impulse pro Umdrehung;72000;;;;;",
        ";;;;;;",
        "Zeitstempel;Lage;Zählerstand;Beschleunigung X;Beschleunigung Y;Beschleunigung Z;Temperatur",
        "-;-;-;g;g;g;°C",
    ]
    body = [
        ";".join(
            (
                stamped(t, "%d.%m.%Y %H:%M:%S,%f"),
                p,
                str(n),
                comma(x),
                comma(y),
                comma(z),
                comma(f"{22.0 + 1e-4 * t:.2f}"),
            )
        )
        for t, p, n, x, y, z in data
    ]
    return ("\r\n".join([*head, *body]) + "\r\n").encode("cp1252")


def labview(data: list[Row]) -> bytes:
    """LabVIEW measurement file: two header blocks, tabs, a Comment column without cells."""
    head = [
        "LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab", "Decimal_Separator\t.",
        "Multi_Headings\tNo", "X_Columns\tOne", "Time_Pref\tRelative", "Operator\tlab", "Date\t2026/03/12",
        "Time\t09:15:02.1234567", "***End_of_Header***\t", "\t", "Channels\t5\t\t\t\t\t",
        "Samples\t960\t960\t960\t960\t960\t", "X_Dimension\tTime\tTime\tTime\tTime\tTime\t",
        "X0\t0.0000000000000000E+0\t0.0\t0.0\t0.0\t0.0\t", "Delta_X\t0.100000\t0.100000\t0.100000\t0.100000\t0.100000\t",
        "***End_of_Header***\t\t\t\t\t\t", "X_Value\tPosition\tCounter\tAcc_X (g)\tAcc_Y (g)\tAcc_Z (g)\tComment",
    ]  # fmt: skip
    body = [f"{t:.6f}\t{p}\t{n}\t{x}\t{y}\t{z}" for t, p, n, x, y, z in data]
    return ("\r\n".join([*head, *body]) + "\r\n").encode()


def chinese(data: list[Row]) -> bytes:
    """Chinese logger: GB18030, names with units in full-width brackets."""
    head = "时间（s）,位置号,脉冲数,X轴加速度（g）,Y轴加速度（g）,Z轴加速度（g）,温度（℃）"
    body = [f"{t:.3f},{p},{n},{x},{y},{z},{21.5 + 1e-4 * t:.2f}" for t, p, n, x, y, z in data]
    return ("\n".join(["产品编号：BY-07", head, *body]) + "\n").encode("gb18030")


def french(data: list[Row]) -> bytes:
    """French spreadsheet: UTF-8 with byte-order mark, units in brackets, decimal commas, a separator at each line's end."""
    head = [
        "Numéro de série;A-12;",
        "Temps [ms];Palier;Impulsions;Accélération X [m/s²];Accélération Y [m/s²];Accélération Z [m/s²];",
    ]
    body = [
        ";".join((f"{1000.0 * t:.0f}", p, str(n), *(comma(f"{9.80665 * float(v):.7f}") for v in (x, y, z))))
        + ";"
        for t, p, n, x, y, z in data
    ]
    return ("\r\n".join([*head, *body]) + "\r\n").encode("utf-8-sig")


def iso(data: list[Row]) -> bytes:
    """ISO stamps with zone, quoted names, fx only named by letters."""
    body = [f"{stamped(t, '%Y-%m-%dT%H:%M:%S.%f')}+01:00,{p},{n},{x},{y},{z}" for t, p, n, x, y, z in data]
    return ("\n".join(['"timestamp","segment","pulse_count","f_x_g","f_y_g","f_z_g"', *body]) + "\n").encode()


def folded(data: list[Row]) -> bytes:
    """Tab-separated, comment lines and a preamble, a 16 bit counter that folds, a gap inside a position."""
    head = [
        "# logger 3.1",
        "# S/N: T-9",
        "Sampling rate\t10 Hz",
        "",
        "Time\tPos\tCount\tfx\tfy\tfz",
        "[s]\t\t\t[g]\t[g]\t[g]",
    ]
    kept = [row for k, row in enumerate(data) if not 355 <= k < 361]
    body = [f"{t:.4f}\tP{p}\t{n % 65536}\t{x}\t{y}\t{z}" for t, p, n, x, y, z in kept]
    return ("\n".join([*head, *body]) + "\n").encode()


SCENARIO = """\
[instrument]
serial = "example-1"
scale_factor = "0.8884 rad/s/g"
[truth]
beta = "74 arcsec"
k0 = "3e-4 g"
[electronics]
sample_rate = "10 Hz"
angle_random_walk = "1e-6 rad/sqrt(s)"
[run]
format = "csv"
[stand]
latitude = "48 deg"
dwell = "8 s"
"""


def simulated(stand: str) -> list[dict[str, str]]:
    """Rows of a simulated test."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "scenario.toml"
        path.write_text(SCENARIO + stand)
        write_data(run_scenario(read_scenario(path)), Path(name) / "run.csv")
        with (Path(name) / "run.csv").open(encoding="utf-8") as stream:
            return list(csv.DictReader(stream))


def head_angle() -> bytes:
    """Dividing head: its angle in degrees in place of a reference; no column numbers the positions."""
    data = simulated('kind = "dividing-head"\npositions = "0:360:30 deg"\nmove = "10 s"\n')
    label, count = (next(name for name in data[0] if name.startswith(word)) for word in ("segment", "counts"))
    time = next(iter(data[0]))
    lines = [f"{comma(row[time])};{30 * int(row[label])},0;{row[count]}" for row in data]
    head = [
        "Seriennummer: T-11",
        "Breite: 48 Grad",
        "Impulse pro Umdrehung: 72000",
        "Zeit;Teilkopfwinkel;Impulse",
        "s;Grad;-",
    ]
    return ("\r\n".join([*head, *lines]) + "\r\n").encode("cp1252")


def centrifuge() -> bytes:
    """Centrifuge: its speed in rpm in place of a reference."""
    rates = [30, 60, 90, 120]
    data = simulated(
        f'kind = "centrifuge"\nradius = "1 m"\nrates = {[f"{rate} rpm" for rate in rates]}\nramp = "20 s"\n'
    )
    label, count = (next(name for name in data[0] if name.startswith(word)) for word in ("segment", "counts"))
    time = next(iter(data[0]))
    levels = [*rates, *rates[-2::-1]]
    order = list(dict.fromkeys(row[label] for row in data))
    lines = [
        f"{row[time]},{order.index(row[label]) + 1},{levels[order.index(row[label])]}.00,{row[count]}"
        for row in data
    ]
    return ("\n".join(["t_s,level,rpm,counts", *lines]) + "\n").encode()


def main() -> None:
    """Write all logs."""
    TARGET.mkdir(parents=True, exist_ok=True)
    data = rows()
    logs = {
        "german.csv": german(data), "labview.lvm": labview(data), "chinese.csv": chinese(data), "french.csv": french(data),
        "iso.csv": iso(data), "folded.tsv": folded(data), "head-angle.csv": head_angle(), "centrifuge.csv": centrifuge(),
    }  # fmt: skip
    for name, content in logs.items():
        (TARGET / name).write_bytes(content)
        print(f"{name}: {len(content)} bytes")


if __name__ == "__main__":
    main()
