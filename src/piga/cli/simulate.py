"""``piga plan``, ``simulate``, ``reproduce`` and ``platform``: tests to come, synthetic tests, published cases, platforms."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from piga.cli.common import (
    App,
    Delivery,
    ForceOption,
    JsonOption,
    argument,
    deliver,
    files_named_in,
    flag,
    option,
    progress,
    write_text,
)
from piga.errors import PigaError

if TYPE_CHECKING:
    from piga.platform.chain import ModelComparisonRun
    from piga.platform.simulate import PlatformRun

Scenario = Annotated[Path, argument("SCENARIO.toml", "Scenario file.")]
_PLAN_RESULTS = ("scenario.toml", "program.csv", "plan.json", "report.html")
"""Names of the result files of ``plan``."""


def plan(
    plan_file: Annotated[Path, argument("PLAN.toml", "Plan file.")],
    out: Annotated[Path | None, option("DIR", "Folder for the results [default: PLAN-plan].")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Plan a test: positions, times and the uncertainty it gives.

    Writes plan.json, report.html, program.csv for the stand, and scenario.toml for 'piga simulate'.
    """
    from piga.planning.candidates import read_plan
    from piga.planning.plan import plan_document, plan_mounting, plan_test, program_csv, scenario_text
    from piga.reports.planning import page

    inputs = files_named_in(plan_file)
    folder = out or plan_file.parent / f"{plan_file.stem}-plan"
    with deliver(folder, "plan", _PLAN_RESULTS, inputs, force=force, as_json=as_json) as to:
        request = read_plan(plan_file)
        with progress("planning") as show:
            mounting = plan_mounting(request)
            planned = plan_test(request, progress=show)
        document = plan_document(planned, mounting)
        write_text(to / "scenario.toml", scenario_text(planned))
        write_text(to / "program.csv", program_csv(planned))
        whole = page(planned, mounting)
        to.show(document, whole, whole, "plan.json", "report.html")


RESULTS = ("run.toml", "run.csv", "run.parquet", "truth.json", "report.html")
"""Names of the result files of ``simulate``."""


def simulate(
    scenario: Scenario,
    out: Annotated[Path, option("DIR", "Folder for run.toml, the data, truth.json and the page.")],
    model: Annotated[
        Literal["quasi-steady", "twin"] | None, typer.Option(help="Instead of the scenario's.")
    ] = None,
    seed: Annotated[int | None, option("N", "Seed of the noise, instead of the scenario's.", min=0)] = None,
    unstable: Annotated[bool, flag("--unstable", "Also accept an unstable servo loop.")] = False,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Simulate a test: a run to calibrate, and its truth."""
    from piga.reports.render.page import write_page
    from piga.reports.stand import page
    from piga.stand.scenario import read_scenario, run_scenario
    from piga.stand.write_run import run_file_text, truth_document, truth_text, write_data

    read = read_scenario(scenario)
    data = f"run.{read.table.run.format}"
    with deliver(out, "simulate", RESULTS, files_named_in(scenario), force=force, as_json=as_json) as to:
        with progress("simulating") as show:
            test = run_scenario(read, model=model, seed=seed, force=unstable, progress=show)
        with progress("writing data and report"):
            write_data(test, to / data)
            write_text(to / "run.toml", run_file_text(read, test, data))
            write_text(to / "truth.json", truth_text(read, test))
            write_page(page(test, read.table.instrument.serial), to / "report.html")
        to.tell(lambda: truth_document(read, test), test.summary)


def reproduce(
    out: Annotated[Path | None, option("DIR", "Folder for reproduction.html.")] = None,
    only: Annotated[str | None, option("ID", "Run one chapter, e.g. ten-days.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Compute every published case and compare.

    Shows published value, computed value, difference and verdict. Exits with 1 if one disagrees.
    """
    from piga import studies
    from piga.reports.render.page import page_text, write_page
    from piga.studies.reproduction import brief, reproduction_page

    with deliver(out, "reproduce", ("reproduction.html",), (), force=force, as_json=as_json) as to:
        with progress("reproducing") as show:
            reproduction = studies.reproduce(only, progress=show)
        if out is not None:
            write_page(reproduction_page(reproduction), to / "reproduction.html")
        to.tell(reproduction.document, lambda: page_text(brief(reproduction)))
    if reproduction.failed:
        raise typer.Exit(1)


# -- platform ------------------------------------------------------------------------------------------

platform = App("platform", "Analyse a space-stable platform with case rotation.")

Out = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results and report.html.")]


@platform.command("simulate")
def simulate_platform(
    scenario: Scenario, out: Out, force: ForceOption = False, as_json: JsonOption = False
) -> None:
    """Simulate the readouts and the truth.

    Writes readouts.parquet, truth.parquet, the scenario and a page.
    """
    from piga.platform.simulate import readouts_table, truth_table
    from piga.reports.platform import simulation_page

    files = ("readouts.parquet", "truth.parquet", "simulated.toml", "report.html")
    with _results(out, "simulate", scenario, force, as_json, *files) as to:
        run = _simulated(scenario)
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


@platform.command()
def align(scenario: Scenario, out: Out, force: ForceOption = False, as_json: JsonOption = False) -> None:
    """Align on the first stretch of a static base.

    Writes alignment.json and a page.
    """
    from piga.platform.chain import prepare
    from piga.platform.identify import align as align_readouts
    from piga.reports.platform import alignment_page

    with _results(out, "align", scenario, force, as_json, "alignment.json") as to:
        run = _simulated(scenario)
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
                aligned = align_readouts(
                    stretch, run.scenario.place, preparation.knowledge, orders=orders, progress=advance
                )
        document = aligned.document()
        whole = alignment_page(run, aligned)
        to.show(document, whole, whole.only(), "alignment.json", "report.html")


@platform.command()
def identify(scenario: Scenario, out: Out, force: ForceOption = False, as_json: JsonOption = False) -> None:
    """Identify misalignments, phases and harmonics.

    Writes identification.json and a page.
    """
    from piga.platform.chain import sources_of
    from piga.platform.identify import identification_document, identify_growing, observability
    from piga.platform.observation import MOVING_SOURCES, SOURCES
    from piga.reports.platform import identification_page

    with _results(out, "identify", scenario, force, as_json, "identification.json") as to:
        run = _simulated(scenario)
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


@platform.command()
def navigate(scenario: Scenario, out: Out, force: ForceOption = False, as_json: JsonOption = False) -> None:
    """Navigate with every model of the scenario.

    Writes navigation-MODEL.parquet and a page.
    """
    from piga.platform.chain import navigation_table
    from piga.reports.platform import navigation_page

    with _results(out, "navigate", scenario, force, as_json, "navigation-*.parquet") as to:
        comparison = _compared(scenario)
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


@platform.command()
def compare(
    scenario: Scenario,
    out: Annotated[Path | None, option("DIR", "Folder for comparison.json and report.html.")] = None,
    force: ForceOption = False,
    as_json: JsonOption = False,
    budget: Annotated[bool, flag("--budget", "Add the error budget by source.")] = False,
) -> None:
    """Compare the compensation models, and each with theory.

    Writes comparison.json and a page, day by day.
    """
    import msgspec

    from piga.platform.chain import error_budget, standard_sources
    from piga.reports.platform import comparison_page
    from piga.reports.render.page import write_page

    with _results(out, "compare", scenario, force, as_json, "comparison.json", "capstone.html") as to:
        comparison = _compared(scenario)
        s = comparison.run.scenario
        sources = standard_sources(comparison.preparation.alignment)
        rows = error_budget(s, sources) if budget else ()
        document = comparison.document()
        if rows:
            document["budget"] = msgspec.to_builtins(rows)
        if out is not None and s.sensors.pigas is not None:
            from piga.studies.platform import capstone, capstone_page

            with progress("capstone") as show:
                write_page(capstone_page(capstone(s, progress=show)), to / "capstone.html")
        whole = comparison_page(comparison, rows)
        to.show(
            document, whole, whole.only("lines", "equatorial-lines", "notes"), "comparison.json", "report.html"
        )


def _simulated(scenario: Path) -> PlatformRun:
    from piga.platform.scenario import load_scenario
    from piga.platform.simulate import simulate as simulate_readouts

    with progress("simulating"):
        return simulate_readouts(load_scenario(scenario))


def _compared(scenario: Path) -> ModelComparisonRun:
    from piga.platform.chain import compare as compare_models
    from piga.platform.scenario import load_scenario

    with progress("simulating and navigating") as advance:
        return compare_models(load_scenario(scenario), progress=advance)


def _results(
    out: Path | None, command: str, scenario: Path, force: bool, as_json: bool, *names: str
) -> AbstractContextManager[Delivery]:
    """The folder for the results and the page of a command, and its ending."""
    every, inputs = dict.fromkeys((*names, "report.html")), files_named_in(scenario)
    return deliver(out, f"platform-{command}", tuple(every), inputs, force=force, as_json=as_json)


def _parquet(table: Any, path: Path) -> None:
    import pyarrow.parquet as pq

    pq.write_table(table, path, write_page_checksum=True)
