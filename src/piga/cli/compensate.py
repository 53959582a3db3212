"""``piga compensate``: specific force and velocity increments from a run and a calibration."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from piga.cli.common import note, print_json, say, write_by_rename


def compensate(
    run: Annotated[Path, typer.Argument(help="Run file (TOML).", show_default=False)],
    calibration: Annotated[
        Path, typer.Option(help="Calibration record (calibration.json).", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="Result: .parquet or .csv.", show_default=False)],
    method: Annotated[
        Literal["exact", "published"] | None,
        typer.Option(help="Default: what the calibration's phase asks for."),
    ] = None,
    uncertainty: Annotated[bool, typer.Option(help="Write the column u_ax.")] = True,
    max_age: Annotated[
        float | None, typer.Option(help="Flag rows when the calibration is older [days].")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Use the calibration of another serial number.")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON.")] = False,
) -> None:
    """Compensate a recorded run: columns t, ax, dv, u_ax, flags."""
    from piga.compensation import compensate as compensate_record
    from piga.compensation.writers import format_of, write_table
    from piga.records import Calibration, read_run

    kind = format_of(out)
    record, coefficients = read_run(run), Calibration.from_json(calibration)
    result = compensate_record(
        record, coefficients, method=method, uncertainty=uncertainty, max_age_days=max_age, force=force
    )
    write_by_rename(out, lambda path: write_table(path, result.columns(), kind))
    if json:
        print_json(_summary(result, out))
    else:
        say(f"wrote {out}: {result.size} rows")
        for name, count in _flag_counts(result).items():
            note(f"{name}: {count} rows")


def _flag_counts(result: Any) -> dict[str, int]:
    from piga.compensation import FLAGS

    counts = {name: int(result.flagged(name).sum()) for name in FLAGS}
    return {name: count for name, count in counts.items() if count}


def _summary(result: Any, out: Path) -> dict[str, Any]:
    return {
        "file": str(out),
        "serial": result.serial,
        "method": result.method,
        "rows": result.size,
        "velocity_m_s": float(result.dv.sum()),
        "flags": _flag_counts(result),
    }
