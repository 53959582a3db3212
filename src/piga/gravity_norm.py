"""Calibration of a set of accelerometers by the size of gravity alone, in many static attitudes.

Spells and the scan of their threshold: [Tedaldi2014]. Intervals: the bias-reduced sandwich over the spells
(:mod:`piga.calibration.intervals`).

>>> from piga.gravity_norm import calibrate_set
>>> calibrate_set.__name__
'calibrate_set'
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from piga.calibration.intervals import Repetition, sandwich
from piga.calibration.model.reduction import Reduction
from piga.errors import ArgumentError, DataError, IdentifiabilityError, RunFileError
from piga.reading.columns import read_series
from piga.records.calibration.coefficient import coverage_factor, welch_satterthwaite
from piga.records.run_file import (
    MOST_HEAD_ROWS,
    Columns,
    DataTable,
    HeadPair,
    HeadRow,
    OutputColumn,
    Quantity,
    Seconds,
    TimeColumn,
    TomlTable,
    in_unit,
    is_set,
)
from piga.results import Array, Plotted, Reported, Result
from piga.text_files import read_toml, toml_bytes, toml_document
from piga.upper import doors

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

__all__ = [
    "SetCalibration",
    "SetFile",
    "SetTerm",
    "Spell",
    "calibrate_set",
    "calibrate_set_file",
    "is_set_file",
]

Convention = Literal["upper", "lower"]
_MULTIPLES = tuple(float(k) for k in range(2, 11))
"""Thresholds of the scan, as multiples of the variance of the quietest windows ([Tedaldi2014])."""
QUIET = 0.1
"""Share of the windows that is quiet: its largest variance is that of the instrument at rest (own choice)."""
_ALIKE = 0.9
"""Correlation above which a remark says that the attitudes hardly tell two terms apart (own choice)."""
_FLAT = 0.02
"""Distance of the attitudes from one plane [g, root mean square] below which they are refused (own choice)."""
_MOST_STEPS = 100
"""Steps of the fit: attitudes that tell all terms take fewer than 20, those that do not never end."""
_SINGULAR = 1e-3
"""Share of the largest singular value below which the attitudes do not tell a combination of terms (own choice)."""


@dataclass(frozen=True)
class Spell(Result):
    """A time at which the set stood still: begin and end [s], samples, and the size of its mean force less g [m/s^2]."""

    begin: float
    end: float
    samples: int
    residual: float = math.nan


@dataclass(frozen=True)
class SetTerm(Result):
    """A coefficient with its standard uncertainty, its degrees of freedom and its unit."""

    key: str
    value: float
    std: float
    degrees_of_freedom: float
    unit: str

    @property
    def expanded(self) -> float:
        """Half width of the interval of 95 %."""
        return coverage_factor(self.degrees_of_freedom) * self.std


@dataclass(frozen=True, eq=False, repr=False)
class SetCalibration(Reported, Plotted, Result):
    """Calibration of a set: output = bias + K (f along the axis, with its non-orthogonality).

    Attributes
    ----------
    names, unit:
        Columns of the accelerometers, and the unit of their outputs.
    convention:
        ``"upper"``: the third axis is Z, the second lies in the plane of Y and Z. ``"lower"``: the first is X, the
        second lies in the plane of X and Y. Scale factors depend on it.
    gravity, gravity_std:
        Size of gravity and its standard uncertainty [m/s^2].
    terms:
        Biases, scale factors, non-orthogonality; of a fourth and further accelerometer its three sensitivities.
    covariance:
        That of the terms.
    matrix, bias:
        Sensitivities (n, 3) [unit/(m/s^2)] and biases (n,) [unit].
    spells, threshold:
        Static spells, and the multiple of the quiet variance by which they were found.
    residual_rms:
        Root of the mean square of the residuals, by degrees of freedom [m/s^2].
    remarks:
        What these attitudes hardly tell.
    """

    serial: str
    names: tuple[str, ...]
    unit: str
    convention: Convention
    gravity: float
    gravity_std: float
    terms: tuple[SetTerm, ...]
    covariance: Array
    matrix: Array
    bias: Array
    spells: tuple[Spell, ...]
    threshold: float
    residual_rms: float
    remarks: tuple[str, ...]
    input_sha256: dict[str, str] = field(default_factory=dict)

    def __getitem__(self, key: str) -> SetTerm:
        return next(term for term in self.terms if term.key == key)

    def force(self, outputs: ArrayLike) -> Array:
        """Specific force (n, 3) [m/s^2] of outputs (n, accelerometers); of a redundant set the one of least squares in g."""
        return _force(np.asarray(outputs, dtype=float), self.matrix, self.bias)

    def _subject(self) -> ModuleType:
        return doors().shown_set()


def _activity(t: Array, y: Array, window: float) -> tuple[Array, int]:
    """Variance in a window around each sample over that of quiet windows, and the samples of half a window.

    It is the mean over the accelerometers, each by its own quiet variance.
    """
    half = max(round(0.5 * window / float(np.median(np.diff(t)))), 5)
    size = 2 * half + 1
    if t.size < 2 * size:
        raise DataError(f"{t.size} samples, fewer than two windows of {window:g} s", remedy="record longer")
    y = y - y.mean(axis=0)
    sums = [np.concatenate((np.zeros((1, y.shape[1])), np.cumsum(one, axis=0))) for one in (y, y**2)]
    first, second = ((one[size:] - one[:-size]) / size for one in sums)
    variance = np.maximum(second - first**2, 0.0)
    quiet = np.quantile(variance, QUIET, axis=0)
    if (quiet <= 0.0).any():
        raise DataError(
            "an accelerometer shows no noise at rest: its steps are too coarse to find static spells",
            remedy="log finer steps, or give spells of a column",
        )
    return (variance / quiet).mean(axis=1), half


def _spells(t: Array, activity: Array, half: int, multiple: float) -> tuple[Spell, ...]:
    """Times at which the activity is below a multiple. Each has a window at least; half a window at its ends is left out."""
    still = np.concatenate(([False], activity < multiple, [False]))
    edges = np.flatnonzero(still[1:] != still[:-1])
    spells = [(a + half, b + half) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a > 2 * half]
    return tuple(Spell(float(t[a]), float(t[b - 1]), int(b - a)) for a, b in spells)


def calibrate_set(
    t: ArrayLike,
    outputs: ArrayLike,
    gravity: float,
    *,
    gravity_std: float = 0.0,
    convention: Convention = "upper",
    window: float = 1.0,
    unit: str = "1",
    names: tuple[str, ...] | None = None,
    serial: str = "",
) -> SetCalibration:
    r"""Calibrate a set of accelerometers from static spells in many attitudes.

    Accelerometer i gives :math:`y_i = b_i + K_i (f_i + \sum_j m_{ij} f_j)`, j > i for ``"upper"``, j < i for ``"lower"``; a
    fourth and further one :math:`y_i = b_i + \sum_j s_{ij} f_j`. With S the matrix of all sensitivities, the force of a
    spell is :math:`\hat f = S^+ (\bar y - b)`. The sum over the spells of :math:`(|\hat f| - g)^2`, and of what a redundant set
    leaves, is minimised. Of the thresholds for the spells that with the smallest residual counts [Tedaldi2014]. Intervals
    are those of the scatter of the spells; u of gravity is added to scale factors.

    Parameters
    ----------
    t, outputs:
        Time (n,) [s] and outputs (n, accelerometers) of three or more accelerometers.
    gravity, gravity_std:
        Size of gravity and its standard uncertainty [m/s^2].
    convention, unit, names, serial:
        As in the result.
    window:
        Length of the window for the spells [s].

    Raises
    ------
    ArgumentError, DataError
        If the arrays do not fit together, or too few spells are found.
    IdentifiabilityError
        If the attitudes do not tell the terms, or one spell alone determines a term.
    """
    t, y = np.asarray(t, dtype=float).reshape(-1), np.asarray(outputs, dtype=float)
    if y.ndim != 2 or y.shape[1] < 3 or len(y) != t.size or not np.isfinite(y).all():
        raise ArgumentError(
            "outputs: (n, 3 or more) finite numbers are needed, one row for each time", remedy="correct them"
        )
    names = names or tuple(f"{k + 1}" for k in range(y.shape[1]))
    activity, half = _activity(t, y, window)
    pairs = [(i, j) for i in range(3) for j in range(3) if (j > i if convention == "upper" else j < i)]
    size, count, most = np.ptp(y, axis=0) / gravity, 4 * y.shape[1] - 3, 0
    y = y / size
    best: tuple[float, float, tuple[Spell, ...], Array, OptimizeResult] | None = None
    for multiple in _MULTIPLES:
        spells = _spells(t, activity, half, multiple)
        most = max(most, len(spells))
        freedom = len(spells) * (y.shape[1] - 2) - count
        if freedom > 0:
            at = np.searchsorted(t, [[s.begin, s.end] for s in spells])
            means = np.array([y[a : b + 1].mean(axis=0) for a, b in at])
            fit = _fit(means, pairs, gravity)
            rms = math.sqrt(2.0 * fit.cost / freedom)
            best = (rms, multiple, spells, means, fit) if best is None or rms < best[0] else best
    if best is None:
        raise DataError(
            f"{most} static spells are found, and {count} terms need {count // (y.shape[1] - 2) + 1} or more",
            remedy="hold the set still for some seconds in more attitudes, or choose a shorter window",
        )
    rms, multiple, spells, means, fit = best
    keys, units, scale = _terms(names, unit, pairs, size)
    directions = _force(means, *_sensitivities(fit.x, y.shape[1], pairs)) / gravity
    correlation, remarks = _told(fit.jac, keys, directions)
    rows = fit.fun.reshape(len(spells), -1)
    parts = np.concatenate((-fit.jac.reshape(*rows.shape, -1), rows[:, :, None]), axis=-1)
    u, degrees = sandwich(
        list(parts),
        [
            Repetition(Reduction(keys, part), 0, 1.0, f"{one.begin:.6g} s", one.begin, one.end)
            for part, one in zip(parts, spells, strict=True)
        ],
        keys,
    )
    values = fit.x * scale
    of_gravity = np.array([one.endswith("/(m/s^2)") for one in units])
    both = np.stack((u * scale, np.where(of_gravity, np.abs(values), 0.0) * gravity_std / gravity), axis=-1)
    std = np.hypot(*both.T)
    freedoms = welch_satterthwaite(both, np.stack((degrees, np.full(u.size, np.inf)), axis=-1))
    matrix, bias = _sensitivities(values, y.shape[1], pairs)
    return SetCalibration(
        serial=serial,
        names=names,
        unit=unit,
        convention=convention,
        gravity=gravity,
        gravity_std=gravity_std,
        terms=tuple(map(SetTerm, keys, values.tolist(), std.tolist(), freedoms.tolist(), units)),
        covariance=correlation * np.outer(std, std),
        matrix=matrix,
        bias=bias,
        spells=tuple(replace(one, residual=float(r)) for one, r in zip(spells, rows[:, 0], strict=True)),
        threshold=multiple,
        residual_rms=rms,
        remarks=remarks,
    )


def _terms(
    names: tuple[str, ...], unit: str, pairs: list[tuple[int, int]], size: Array
) -> tuple[tuple[str, ...], tuple[str, ...], Array]:
    """Key, unit, and size of one unit of each parameter, where ``size`` is that of each output.

    Parameters: biases, scale factors, non-orthogonality, sensitivities of further accelerometers.
    """
    axes, each, scale = "XYZ", list(zip(names, size, strict=True)), f"{unit}/(m/s^2)"
    rows = [(f"bias[{name}]", unit, one) for name, one in each]
    rows += [(f"scale_factor[{name}]", scale, one) for name, one in each[:3]]
    rows += [(f"m_{axes[j]}[{names[i]}]", "rad", 1.0) for i, j in pairs]
    rows += [(f"s_{axis}[{name}]", scale, one) for name, one in each[3:] for axis in axes]
    keys, units, sizes = zip(*rows, strict=True)
    return keys, units, np.array(sizes)


def _sensitivities(parameters: Array, count: int, pairs: list[tuple[int, int]]) -> tuple[Array, Array]:
    """Matrix (n, 3) and biases (n,) of ``count`` accelerometers."""
    bias, scale, skew, further = np.split(parameters, [count, count + 3, count + 6])
    matrix = np.diag(scale)
    for (i, j), value in zip(pairs, skew, strict=True):
        matrix[i, j] = scale[i] * value
    return np.concatenate((matrix, further.reshape(-1, 3))), bias


def _force(outputs: Array, matrix: Array, bias: Array) -> Array:
    size = np.linalg.norm(matrix, axis=1)
    return np.asarray(((outputs - bias) / size) @ np.linalg.pinv(matrix / size[:, None]).T)


def _fit(means: Array, pairs: list[tuple[int, int]], gravity: float) -> OptimizeResult:
    """The least sum of squares. It starts at the ellipsoid's box, with all axes orthogonal.

    Residuals: size of the force less g of each spell; of a redundant set also what no force explains (spells, 1 or 1 + n).
    """
    from scipy.optimize import least_squares

    n = means.shape[1]

    def residuals(parameters: Array) -> Array:
        matrix, bias = _sensitivities(parameters, n, pairs)
        force = _force(means, matrix, bias)
        off = np.linalg.norm(force, axis=1)[:, None] - gravity
        if n > 3:
            left = (means - bias - force @ matrix.T) / np.linalg.norm(matrix, axis=1)
            off = np.column_stack((off, left))
        return off.ravel()

    low, high = means.min(axis=0), means.max(axis=0)
    start = np.zeros(4 * n - 3)
    start[:n] = 0.5 * (low + high)
    start[n : n + 3] = np.maximum(0.5 * (high - low)[:3], 1e-12) / gravity
    if n > 3:
        base = (means[:, :3] - start[:3]) / start[n : n + 3]
        columns = np.column_stack((base, np.ones(len(base))))
        further = np.linalg.lstsq(columns, means[:, 3:], rcond=None)[0]
        start[3:n], start[n + 6 :] = further[3], further[:3].T.ravel()
    return least_squares(
        residuals, start, jac="3-point", x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=_MOST_STEPS
    )


def _told(jacobian: Array, keys: tuple[str, ...], directions: Array) -> tuple[Array, tuple[str, ...]]:
    """Correlations of the terms, and remarks on pairs that the attitudes hardly tell apart.

    Raises
    ------
    IdentifiabilityError
        If they do not tell a combination at all, or lie in one plane: an ellipse is a section of many ellipsoids.
    """
    spread = np.linalg.svd(directions - directions.mean(axis=0), compute_uv=False)[-1]
    if spread < _FLAT * math.sqrt(len(directions)):
        raise IdentifiabilityError(
            "these attitudes lie in one plane: they cannot tell the sensitivities across it", remedy=_MORE
        )
    scaled = jacobian / np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    _, singular, right = np.linalg.svd(scaled, full_matrices=False)
    if singular[-1] < _SINGULAR * singular[0]:
        mixed = tuple(key for key, share in zip(keys, np.abs(right[-1]), strict=True) if share > 0.1)
        raise IdentifiabilityError(f"these attitudes cannot tell {', '.join(mixed)}", remedy=_MORE, terms=mixed)
    inverse = (right.T / singular**2) @ right
    size = np.sqrt(np.diag(inverse))
    correlation: NDArray[np.float64] = inverse / np.outer(size, size)
    remarks = [
        f"these attitudes hardly tell {keys[i]} from {keys[j]}: correlation {correlation[i, j]:.3f}"
        for i in range(len(keys))
        for j in range(i)
        if abs(correlation[i, j]) > _ALIKE
    ]
    return correlation, tuple(remarks)


_MORE = "hold the set in more attitudes: each axis up and down, and each pair of axes at 45 degrees"


# -- the run file of a set ----------------------------------------------------------------------------


class SetInstrument(TomlTable, frozen=True):
    """``[instrument]``: identity of the set, and the size of gravity."""

    serial: str
    gravity: Annotated[Quantity, in_unit("m/s^2")]
    gravity_uncertainty: Annotated[Quantity, in_unit("m/s^2")] = "0 m/s^2"


class SetOutputs(TomlTable, frozen=True):
    """Columns of three or more accelerometers, with one unit."""

    columns: Annotated[tuple[str, ...], msgspec.Meta(min_length=3)]
    unit: str


class SetData(TomlTable, frozen=True):
    """``[data]``: the file, its columns and, if the file does not show it, its format."""

    file: str
    reference: Literal["gravity-norm"]
    outputs: SetOutputs
    time: TimeColumn | None = None
    sample_rate: Quantity | None = None
    delimiter: str | None = None
    decimal: Literal[".", ","] | None = None
    skip_rows: Annotated[int, msgspec.Meta(ge=0, le=MOST_HEAD_ROWS)] = 0
    header_row: HeadRow | bool | HeadPair | None = None

    def table(self) -> DataTable:
        """The table of a run file that reads all columns."""
        columns = Columns(self.outputs.columns, "1")  # type: ignore[arg-type]
        return DataTable(
            self.file, OutputColumn(self.outputs.columns[0], "counts"), columns, self.time, self.sample_rate,
            delimiter=self.delimiter, decimal=self.decimal, skip_rows=self.skip_rows, header_row=self.header_row,
        )  # fmt: skip


class SetModel(TomlTable, frozen=True):
    """``[model]``: convention of the axes, and window for the static spells."""

    convention: Convention = "upper"
    window: Seconds = "1 s"


class SetFile(TomlTable, frozen=True):
    """A whole run file of a set."""

    instrument: SetInstrument
    data: SetData
    model: SetModel = SetModel()


def is_set_file(path: Path) -> bool:
    """Whether a run file is one of a set: its ``[data] reference`` is ``"gravity-norm"``."""
    return path.suffix == ".toml" and is_set(toml_document(path))


def calibrate_set_file(path: str | Path) -> SetCalibration:
    """Calibrate a set by its run file.

    Raises
    ------
    RunFileError, DataError, IdentifiabilityError
        As :func:`calibrate_set`. The message names file, key, row or column.
    """
    path = Path(path)
    content = toml_bytes(path)
    file = read_toml(path, SetFile, content)
    data, outputs = file.data, file.data.outputs
    if (data.time is None) == (data.sample_rate is None):
        raise RunFileError(f"{path}: [data] needs either time or sample_rate", remedy="give one of the two")
    values, t, digests = read_series(path.parent, data.table(), outputs.columns)
    given, model = file.instrument.in_si("[instrument] "), file.model.in_si("[model] ")
    result = calibrate_set(
        t, values, given["gravity"], gravity_std=given["gravity_uncertainty"], window=model["window"],
        convention=file.model.convention, unit=outputs.unit, names=outputs.columns, serial=file.instrument.serial,
    )  # fmt: skip
    return replace(result, input_sha256={path.name: hashlib.sha256(content).hexdigest()} | digests)
