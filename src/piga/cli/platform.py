"""``piga platform``: simulate, align, identify, navigate and compare on a space-stable platform."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from piga.cli.common import (
    App,
    Delivery,
    ForceOption,
    argument,
    deliver,
    files_named_in,
    flag,
    option,
    progress,
)

if TYPE_CHECKING:
    from piga.platform.chain import ModelComparisonRun
    from piga.platform.scenario import PlatformScenario
    from piga.platform.simulate import PlatformRun

app = App("platform", "Analyse a space-stable platform with case rotation.")

Scenario = Annotated[Path, argument("SCENARIO.toml", "Scenario file.", show_default=False)]
Out = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results and report.html.")]
_Json = Annotated[bool, flag("--json", "Print the result as JSON.")]


@app.command()
def simulate(scenario: Scenario, out: Out, force: ForceOption = False, json: _Json = False) -> None:
    """Simulate the readouts and the truth.

    Writes readouts.parquet, truth.parquet, the scenario and a page.
    """
    from piga.platform.scenario import load_scenario
    from piga.platform.simulate import readouts_table, truth_table
    from piga.reports.platform import simulation_page

    files = ("readouts.parquet", "truth.parquet", "simulated.toml", "report.html")
    with _results(out, "simulate", scenario, force, json, *files) as to:
        run = _simulated(load_scenario(scenario))
        for table, name in zip((readouts_table(run.readouts), truth_table(run)), files, strict=False):
            _parquet(table, to / name)
        (to / "simulated.toml").write_bytes(scenario.read_bytes())
        rows, eta = len(run.readouts.times), run.truth.eta
        document = {
            "rows": rows,
            "duration_s": run.scenario.duration,
            "redundancy_deg": [math.degrees(eta[0]), math.degrees(eta[-1])],
            "files": list(files),
        }
        whole = simulation_page(run)
        to.show(document, whole, whole.only(), "report.html")


@app.command()
def align(scenario: Scenario, out: Out, force: ForceOption = False, json: _Json = False) -> None:
    """Align on the first stretch of a static base.

    Writes alignment.json and a page.
    """
    from piga.errors import PigaError
    from piga.platform.chain import prepare
    from piga.platform.identify import align as align_platform
    from piga.platform.scenario import load_scenario
    from piga.reports.platform import alignment_page

    with _results(out, "align", scenario, force, json, "alignment.json") as to:
        run = _simulated(load_scenario(scenario))
        if not run.truth.motion.at_rest:
            raise PigaError(
                f"{scenario}: alignment needs a base at rest, [motion] kind = '{run.scenario.motion.kind}'",
                remedy="align on a static scenario",
            )
        with progress("aligning") as advance:
            preparation = prepare(run, advance)
            aligned = preparation.alignment
            if aligned is None:
                stretch = run.readouts.first(run.scenario.calibration_time)
                orders = run.scenario.compensation.orders
                aligned = align_platform(
                    stretch, run.scenario.place, preparation.knowledge, orders=orders, progress=advance
                )
        document = aligned.document()
        whole = alignment_page(run, aligned)
        to.show(document, whole, whole.only(), "alignment.json", "report.html")


@app.command()
def identify(scenario: Scenario, out: Out, force: ForceOption = False, json: _Json = False) -> None:
    """Identify misalignments, phases and harmonics.

    Writes identification.json and a page.
    """
    from piga.platform.chain import sources_of
    from piga.platform.identify import identification_document, identify_growing, observability
    from piga.platform.observation import MOVING_SOURCES, SOURCES
    from piga.platform.scenario import load_scenario
    from piga.reports.platform import identification_page

    with _results(out, "identify", scenario, force, json, "identification.json") as to:
        run = _simulated(load_scenario(scenario))
        s = run.scenario
        with progress("identifying") as advance:
            stretch, orders = run.readouts.first(s.calibration_time), s.compensation.orders
            growing = identify_growing(
                stretch, s.place, sources=sources_of(run), orders=orders, progress=advance
            )
            identification = growing.parts[-1]
            allowed = SOURCES if run.truth.motion.at_rest else MOVING_SOURCES
            sources = observability(stretch, s.place, sources=allowed, orders=orders)
        document = identification_document(identification, sources)
        whole = identification_page(run, growing, sources)
        to.show(document, whole, whole.only("parameters"), "identification.json", "report.html")


@app.command()
def navigate(scenario: Scenario, out: Out, force: ForceOption = False, json: _Json = False) -> None:
    """Navigate with every model of the scenario.

    Writes navigation-MODEL.parquet and a page.
    """
    from piga.platform.chain import navigation_table
    from piga.platform.scenario import load_scenario
    from piga.reports.platform import navigation_page

    with _results(out, "navigate", scenario, force, json, "navigation-*.parquet") as to:
        comparison = _compared(load_scenario(scenario))
        files = {name: f"navigation-{name}.parquet" for name in comparison.models}
        for name, run in comparison.models.items():
            _parquet(navigation_table(run), to / files[name])
        worst = {m: float(r.errors.horizontal.max()) for m, r in comparison.models.items()}
        document = {
            "models": {m: {"position_error_m": v, "file": files[m]} for m, v in worst.items()},
            "notes": list(comparison.preparation.notes),
        }
        whole = navigation_page(comparison)
        to.show(document, whole, whole.only(), "report.html")


@app.command()
def compare(
    scenario: Scenario,
    out: Annotated[Path | None, option("DIR", "Folder for comparison.json and report.html.")] = None,
    force: ForceOption = False,
    json: _Json = False,
    budget: Annotated[bool, flag("--budget", "Add the error budget by source.")] = False,
) -> None:
    """Compare the compensation models, and each with theory.

    Writes comparison.json and a page, day by day.
    """
    import msgspec

    from piga.platform.chain import error_budget, line_budget, line_budget_document, standard_sources
    from piga.platform.scenario import load_scenario
    from piga.reports.platform import comparison_page
    from piga.reports.render.page import write_page

    with _results(out, "compare", scenario, force, json, "comparison.json", "capstone.html") as to:
        comparison = _compared(load_scenario(scenario))
        s = comparison.run.scenario
        with progress("budget") as advance:
            sources = standard_sources(comparison.preparation.alignment)
            rows = error_budget(s, sources, progress=advance) if budget else ()
            lines = line_budget(s, comparison.preparation.identification) if budget else ()
        document = comparison.document()
        if rows:
            document["budget"] = msgspec.to_builtins(rows)
        if lines:
            document["line_budget"] = line_budget_document(lines)
        if out is not None and s.sensors.pigas is not None:
            from piga.studies.platform import capstone, capstone_page

            with progress("capstone") as show:
                write_page(capstone_page(capstone(s, progress=show)), to / "capstone.html")
        whole = comparison_page(comparison, rows, lines)
        to.show(
            document, whole, whole.only("lines", "equatorial-lines", "notes"), "comparison.json", "report.html"
        )


def _simulated(scenario: PlatformScenario) -> PlatformRun:
    from piga.platform.simulate import simulate as simulate_platform

    with progress("simulating"):
        return simulate_platform(scenario)


def _compared(scenario: PlatformScenario) -> ModelComparisonRun:
    from piga.platform.chain import compare as compare_models

    with progress("simulating and navigating") as advance:
        return compare_models(scenario, progress=advance)


def _results(
    out: Path | None, command: str, scenario: Path, force: bool, as_json: bool, *names: str
) -> AbstractContextManager[Delivery]:
    """The folder for the results and the page of a command, and its ending."""
    every, inputs = dict.fromkeys((*names, "report.html")), files_named_in(scenario)
    return deliver(out, f"platform-{command}", tuple(every), inputs, force=force, as_json=as_json)


def _parquet(table: Any, path: Path) -> None:
    import pyarrow.parquet as pq

    pq.write_table(table, path, write_page_checksum=True)
