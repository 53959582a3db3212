"""Results as tables with units in their metadata, and as JSON documents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from piga.formats.parquet import number_column
from piga.platform.alignment import UNKNOWNS, Alignment
from piga.platform.budget import BudgetRow, LineRow
from piga.platform.chain import ModelRun
from piga.platform.identify import UNKNOWNS as MISALIGNMENTS
from piga.platform.identify import Identification, Observability
from piga.platform.simulate import PlatformRun, Readouts
from piga.results import Array, finite
from piga.units import ARCMIN

if TYPE_CHECKING:
    import pyarrow as pa


def _table(columns: dict[str, tuple[Array, str]]) -> pa.Table:
    import pyarrow as pa

    fields = [pa.field(name, pa.float64(), metadata={"unit": unit}) for name, (_, unit) in columns.items()]
    return pa.Table.from_arrays(
        [number_column(values) for values, _ in columns.values()], schema=pa.schema(fields)
    )


READOUT_COLUMNS, TRUTH_COLUMNS, NAVIGATION_COLUMNS = 11, 14, 19
"""Columns of the tables of a run, so that their size can be told before it."""


def readouts_table(r: Readouts) -> pa.Table:
    """Readouts as a table. The increment of a row is that since the previous row; the first row has none."""
    since = np.concatenate([np.full((1, 3), np.nan), r.increments])
    height = r.altitude if len(r.altitude) > 1 else np.full(len(r.times), r.altitude[0])
    columns = {"t": (r.times, "s")}
    columns |= {f"dv{axis}": (since[:, k], "m/s") for k, axis in enumerate("xyz")}
    columns |= {
        f"gimbal_{name}": (r.gimbals[:, k], "rad") for k, name in enumerate(("outer", "middle", "inner"))
    }
    columns |= {
        "pickoff": (r.pickoff, "rad"),
        "case_polar": (r.encoder1, "rad"),
        "case_equatorial": (r.encoder2, "rad"),
        "height": (height, "m"),
    }
    return _table(columns)


def truth_table(run: PlatformRun) -> pa.Table:
    """True specific force in platform axes, redundancy angle, place, velocity and attitude."""
    n, motion = len(run.readouts.times), run.truth.motion

    def full(values: Array) -> Array:
        return values if len(values) == n else np.repeat(values, n, axis=0)

    place, velocity, attitude = full(motion.place), full(motion.velocity), full(motion.attitude)
    columns = {"t": (run.readouts.times, "s"), "eta": (run.truth.eta, "rad")}
    columns |= {f"f{axis}": (run.truth.force[:, k], "m/s^2") for k, axis in enumerate("xyz")}
    columns |= {
        "latitude": (place[:, 0], "rad"),
        "longitude": (place[:, 1], "rad"),
        "height": (place[:, 2], "m"),
    }
    columns |= {f"v_{name}": (velocity[:, k], "m/s") for k, name in enumerate(("north", "east", "down"))}
    columns |= {name: (attitude[:, k], "rad") for k, name in enumerate(("roll", "pitch", "heading"))}
    return _table(columns)


def navigation_table(run: ModelRun) -> pa.Table:
    """Output of the navigator, and its errors."""
    t, e = run.navigation.table, run.errors
    names = ("latitude", "longitude", "height", "v_north", "v_east", "v_down", "roll", "pitch", "heading")
    units = ("rad", "rad", "m", "m/s", "m/s", "m/s", "rad", "rad", "rad")
    columns = {"t": (run.navigation.times, "s")}
    columns |= {name: (t[:, k], unit) for k, (name, unit) in enumerate(zip(names, units, strict=True))}
    columns |= {"error_north": (e.north, "m"), "error_east": (e.east, "m"), "error_up": (e.up, "m")}
    columns |= {
        f"error_v_{name}": (e.velocity[:, k], "m/s") for k, name in enumerate(("north", "east", "down"))
    }
    columns |= {
        f"error_{name}": (e.attitude[:, k], "rad") for k, name in enumerate(("roll", "pitch", "heading"))
    }
    return _table(columns)


def identification_document(identification: Identification, sources: Sequence[Observability]) -> dict[str, Any]:
    """JSON document of ``piga platform identify``."""
    document = {
        name: getattr(identification, name)
        for name in ("sources", "parameters", "noise", "degrees_of_freedom", "condition", "notes")
    }
    document["covariance"] = {
        "names": identification.names,
        "values": identification.values.tolist(),
        "matrix": identification.covariance.tolist(),
    }
    document["observability"] = [
        {
            "source": o.source,
            "condition": finite(o.condition),
            "std_rad": {
                n: (v if v < 1.0 else None) for n, v in zip(MISALIGNMENTS, o.std.tolist(), strict=True)
            },
            "separable": o.separable,
            "verdict": o.sentence,
        }
        for o in sources
    ]
    return dict(msgspec.to_builtins(document))


def alignment_document(alignment: Alignment) -> dict[str, Any]:
    """JSON document of ``piga platform align``."""
    return {
        "triad_to_inertial": alignment.triad.tolist(),
        "triad_rotation_vector_rad": alignment.triad_vector.tolist(),
        "drift_rad_s": alignment.drift.tolist(),
        "base_roll_pitch_heading_rad": alignment.base_angles.tolist(),
        "covariance": {"names": list(UNKNOWNS), "matrix": alignment.covariance.tolist()},
        "noise": alignment.noise,
        "condition": alignment.condition,
    }


_BUDGET_KEYS = {
    "source": "source",
    "position_linear": "position_linear_m",
    "position_full": "position_full_m",
    "velocity_linear": "velocity_linear_m_s",
    "velocity_full": "velocity_full_m_s",
    "difference": "largest_difference_m",
}


def budget_document(rows: Sequence[BudgetRow]) -> list[dict[str, Any]]:
    """Error budget as JSON rows."""
    return [{key: getattr(row, name) for name, key in _BUDGET_KEYS.items()} for row in rows]


def line_budget_document(rows: Sequence[LineRow]) -> list[dict[str, Any]]:
    """Lines of each misalignment alone and of both as JSON rows. A missing line is null."""
    document = []
    for row in rows:
        entry: dict[str, Any] = {"source": row.source, "period_s": row.period}
        for name, theory in row.theory.items():
            scale, unit = (1.0, "m_s") if name.endswith("velocity") else (ARCMIN, "arcmin")
            linear, full = finite(theory / scale), finite(row.full[name] / scale)
            entry |= {f"{name}_line_linear_{unit}": linear, f"{name}_line_full_{unit}": full}
        document.append(entry)
    return document
