"""``residuals.parquet``: the residual of every used sample, with units in the field metadata."""

from __future__ import annotations

from pathlib import Path

from piga.errors import CalibrationError
from piga.formats.arrow_columns import label_column, number_column
from piga.records.calibration import Calibration


def write_residuals(calibration: Calibration, path: Path) -> None:
    """Write the residuals of a fresh calibration.

    Columns: ``row`` (file row), ``segment``, ``t`` [s], ``psi``, ``a_x``, ``before``, ``after`` and
    ``innovation``; for a joint calibration also ``run``.
    """
    import pyarrow as pa
    from pyarrow import parquet

    found = calibration.residuals
    if found is None:
        raise CalibrationError(
            "this calibration was read from a file and holds no residuals", remedy="calibrate again"
        )
    rate = calibration.diagnostics.get("residual_kind") == "rate"
    angle = "rad/s" if rate else "rad"
    labels = [segment.label for segment in calibration.segments]
    columns = {
        "row": (number_column(found.row), "1"),
        "segment": (label_column(found.segment, labels), "1"),
        "t": (number_column(found.t), "s"),
        "psi": (number_column(found.psi), angle),
        "a_x": (number_column(found.a_x), "m/s^2"),
        "before": (number_column(found.before), angle),
        "after": (number_column(found.after), angle),
        "innovation": (number_column(found.innovation), "1"),
    }
    if found.run is not None:
        columns["run"] = (label_column(found.run, [run.name for run in calibration.runs]), "1")
    fields = [pa.field(name, array.type, metadata={"unit": unit}) for name, (array, unit) in columns.items()]
    schema = pa.schema(
        fields, metadata={"serial": calibration.serial, "software": calibration.provenance.software}
    )
    table = pa.Table.from_arrays([array for array, _ in columns.values()], schema=schema)
    parquet.write_table(table, path, compression="zstd")
