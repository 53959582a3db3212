"""Pages of ``piga platform simulate``, ``align`` and ``identify``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from piga.platform.identification.alignment import Alignment
from piga.platform.identification.identified import Identification
from piga.platform.identification.observability import UNKNOWNS, Observability
from piga.platform.model.case_rotation import averaged_drift
from piga.platform.model.scenario import Scenario
from piga.platform.model.simulate import Run
from piga.reports.platform.figures import ARCMIN, cone_figure, convergence_figure, readouts_figure
from piga.reports.platform.parts import page, parameter_table
from piga.reports.render.numbers import fixed, short
from piga.reports.render.page import Block, Cell, Column, FigureBlock, Notice, Page, Section, Table, Text, Tile
from piga.units import ARCSEC


def simulation_page(run: Run) -> Page:
    """Page of ``piga platform simulate``."""
    s = run.scenario
    drift = abs(float(run.truth.eta[-1] - run.truth.eta[0]))
    tiles = (
        Tile("duration", short(s.duration / 86400.0), "d", f"{s.steps} steps of {short(s.step)} s"),
        Tile(
            "redundancy angle",
            short(np.degrees(run.truth.eta[-1])),
            "deg",
            f"grew by {short(np.degrees(drift))} deg",
        ),
        Tile("base", s.motion.kind, "", "motion of the vehicle"),
    )
    sections = (
        Section("What is read", "read", (FigureBlock(readouts_figure(run)),)),
        Section("What was put in", "truth", (_truth_table(s), _case_rotation_text(s))),
    )
    return page("Platform simulation", s, tiles, sections)


def identification_page(
    run: Run, found: Identification, recursive: Identification | None, sources: Sequence[Observability]
) -> Page:
    """Page of ``piga platform identify``."""
    s = run.scenario
    m1, m2 = found["polar.misalignment"], found["equatorial.misalignment"]
    tiles = (
        Tile("polar misalignment", f"{m1.value / ARCMIN:.5f}", "arcmin", f"± {short(m1.std / ARCSEC)} arcsec"),
        Tile(
            "equatorial misalignment",
            f"{m2.value / ARCMIN:.5f}",
            "arcmin",
            f"± {short(m2.std / ARCSEC)} arcsec",
        ),
        Tile("condition", short(found.condition), "", " + ".join(found.sources)),
    )
    blocks: list[Block] = [parameter_table(found, s)]
    blocks += [Notice("info", note) for note in found.notes]
    sections = [Section("Misalignments, phases and harmonics", "parameters", tuple(blocks))]
    if recursive is not None:
        sections.append(Section("Sample by sample", "recursive", (FigureBlock(convergence_figure(recursive)),)))
    sections.append(Section("What each source can tell", "observability", (_observability_table(sources),)))
    return page("Platform identification", s, tiles, tuple(sections))


def alignment_page(run: Run, aligned: Alignment) -> Page:
    """Page of ``piga platform align``."""
    std = aligned.std / ARCSEC
    tiles = (
        Tile("triad attitude", short(float(std[:3].max())), "arcsec", "largest standard uncertainty of three"),
        Tile(
            "triad drift",
            short(float(np.degrees(aligned.std[3:6].max()) * 3600.0)),
            "deg/h",
            "largest standard uncertainty",
        ),
        Tile(
            "base heading",
            f"{np.degrees(aligned.base_angles[2]):.4f}",
            "deg",
            f"± {short(float(aligned.base_stds[2] / ARCSEC))} arcsec",
        ),
    )
    sections = (
        Section("Attitude and drift", "attitude", (_alignment_table(run, aligned),)),
        Section("How gravity tells it", "cone", (FigureBlock(cone_figure(run, aligned)),)),
    )
    return page("Platform alignment", run.scenario, tiles, sections)


def _truth_table(s: Scenario) -> Table:
    rows = []
    for name, gyro, axes in (("polar", s.polar, "w1x, w1y"), ("equatorial", s.equatorial, "w2y, w2z")):
        rows.append((f"{name} misalignment", f"{gyro.misalignment / ARCMIN:.4f}", "arcmin"))
        rows.append((f"{name} phase", f"{np.degrees(gyro.phase):.3f}", "deg"))
        rows += [
            (
                f"{name} harmonic {h.order}",
                f"{h.amplitude / ARCMIN:.4f} at {np.degrees(h.phase):.1f} deg",
                "arcmin",
            )
            for h in gyro.harmonics
        ]
        rows.append((f"{name} drift {axes}", _pair(gyro.drift), "deg/h"))
        rows.append((f"{name} case-fixed drift", _pair(gyro.case_drift), "deg/h"))
    return Table((Column("quantity", align="text"), Column("value"), Column("unit", align="text")), tuple(rows))


def _pair(drift: tuple[float, float]) -> str:
    return ", ".join(f"{np.degrees(w) * 3600.0:.4g}" for w in drift)


def _case_rotation_text(s: Scenario) -> Text:
    at_rest = type(s.polar_rotation)(0.0)
    parts = []
    for name, gyro, rotation in (
        ("polar", s.polar, s.polar_rotation),
        ("equatorial", s.equatorial, s.equatorial_rotation),
    ):
        if any(gyro.case_drift):
            resting = averaged_drift(at_rest, gyro.case_drift, s.duration) / ARCMIN
            turning = averaged_drift(rotation, gyro.case_drift, s.duration) / ARCMIN
            parts.append(
                f"The case-fixed drift of the {name} gyro would turn its momentum by "
                f"{short(resting)} arcmin over the run with the "
                f"case at rest; with the case turning it stays within {short(turning)} arcmin."
            )
    return Text("\n\n".join(parts) or "No case-fixed drift was put in.")


def _observability_table(sources: Sequence[Observability]) -> Table:
    columns = (
        Column("source", align="text"),
        Column("condition"),
        *(Column(n, "arcsec") for n in UNKNOWNS),
        Column("verdict", align="text"),
    )
    rows: tuple[tuple[str | Cell, ...], ...] = tuple(
        (
            o.source,
            short(o.condition),
            *(short(float(v / ARCSEC)) if v < 1.0 else "–" for v in o.std),
            Cell(o.sentence, "good" if o.separable else "doubtful"),
        )
        for o in sources
    )
    return Table(
        columns,
        rows,
        notes=(
            "u and v are m cos(phase) and m sin(phase).",
            "Uncertainties for white noise of one arc-second on every reading, at the redundancy angle found.",
            "On the specific force that is 48 µm/s², one arc-second of its direction.",
        ),
    )


def _alignment_table(run: Run, aligned: Alignment) -> Table:
    rows = (*_triad_attitude_rows(run, aligned), *_triad_drift_rows(aligned), *_base_rows(run, aligned))
    columns = (
        Column("quantity", align="text"),
        Column("value"),
        Column("standard uncertainty"),
        Column("unit", align="text"),
        Column("off truth"),
    )
    return Table(
        columns,
        rows,
        notes=("Accelerometer bias is not seen: one micro-g across gravity tilts the result by 0.2 arcsec.",),
    )


def _triad_attitude_rows(run: Run, aligned: Alignment) -> Iterator[tuple[str, ...]]:
    from piga.frames import matrix_to_rotation_vector

    true = matrix_to_rotation_vector(run.truth.triad_start.T)
    for k, axis in enumerate("xyz"):
        value, std = aligned.triad_vector[k] / ARCSEC, aligned.std[k] / ARCSEC
        off = (aligned.triad_vector[k] - true[k]) / ARCSEC
        yield f"triad attitude {axis}", f"{value:.3f}", f"{std:.2g}", "arcsec", f"{off:+.3f}"


def _triad_drift_rows(aligned: Alignment) -> Iterator[tuple[str, ...]]:
    degree_per_hour = np.radians(1.0) / 3600.0
    for k, axis in enumerate("xyz"):
        value, std = aligned.drift[k] / degree_per_hour, aligned.std[3 + k] / degree_per_hour
        yield f"triad drift {axis}", f"{value:.2e}", f"{std:.1e}", "deg/h", "–"


def _base_rows(run: Run, aligned: Alignment) -> Iterator[tuple[str, ...]]:
    motion = run.scenario.motion
    put_in = {"roll": motion.roll, "pitch": motion.pitch, "heading": motion.heading}
    for k, (name, true) in enumerate(put_in.items()):
        value, std = float(np.degrees(aligned.base_angles[k])), np.degrees(aligned.base_stds[k])
        off = float(np.remainder(value - np.degrees(true) + 180.0, 360.0) - 180.0)
        yield f"base {name}", fixed(value, 5), f"{std:.1e}", "deg", f"{off:+.1e}"
