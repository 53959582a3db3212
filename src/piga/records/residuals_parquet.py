"""``residuals.parquet``: the residual of every used sample, with units in the field metadata."""

from __future__ import annotations

from pathlib import Path

from piga.errors import CalibrationError
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
        "row": (pa.array(found.row), "1"),
        "segment": (pa.DictionaryArray.from_arrays(pa.array(found.segment), pa.array(labels)), "1"),
        "t": (pa.array(found.t), "s"),
        "psi": (pa.array(found.psi), angle),
        "a_x": (pa.array(found.a_x), "m/s^2"),
        "before": (pa.array(found.before), angle),
        "after": (pa.array(found.after), angle),
        "innovation": (pa.array(found.innovation), "1"),
    }
    if found.run is not None:
        names = pa.array([run.name for run in calibration.runs])
        columns["run"] = (pa.DictionaryArray.from_arrays(pa.array(found.run), names), "1")
    fields = [pa.field(name, array.type, metadata={"unit": unit}) for name, (array, unit) in columns.items()]
    schema = pa.schema(
        fields, metadata={"serial": calibration.serial, "software": calibration.provenance.software}
    )
    table = pa.Table.from_arrays([array for array, _ in columns.values()], schema=schema)
    parquet.write_table(table, path, compression="zstd")
