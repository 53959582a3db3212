"""``piga plan``, ``simulate``, ``reproduce``, ``platform`` and ``campaign``: tests to come, synthetic tests, published cases."""

from __future__ import annotations

import math
import shlex
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import piga
from piga.cli.common import (
    JSON,
    App,
    Delivery,
    Ending,
    argument,
    deliver,
    flag,
    note,
    option,
    progress,
    say,
    tell,
    write_text,
)
from piga.errors import PigaError

Scenario = Annotated[Path, argument("SCENARIO.toml", "Scenario file.")]


def plan(
    plan_file: Annotated[Path, argument("PLAN.toml", "Plan file.")],
    out: Annotated[Path | None, option("DIR", "Folder for the results [default: PLAN-plan].")] = None,
) -> None:
    """Plan a test: positions, times and the uncertainty it gives.

    Writes plan.json, report.html, program.csv for the stand, and scenario.toml for 'piga simulate'.
    """
    from piga.planning.plan import program_csv
    from piga.reports.planning import page

    folder = out or plan_file.parent / f"{plan_file.stem}-plan"
    names = ("scenario.toml", "program.csv", "plan.json", "report.html")
    with deliver(folder, "plan", names, [plan_file]) as to:
        request = piga.read_plan(plan_file)
        with progress("planning") as show:
            planned = piga.plan_test(request, progress=show)
        write_text(to / "scenario.toml", piga.planning.scenario_text(planned))
        write_text(to / "program.csv", program_csv(planned))
        whole = page(planned)
        to.show(piga.planning.plan_document(planned), whole, whole, *names[2:])


def simulate(
    scenario: Scenario,
    out: Annotated[Path, option("DIR", "Folder for run.toml, the data, truth.json and the page.")],
    model: Annotated[
        Literal["quasi-steady", "twin"] | None, typer.Option(help="Instead of the scenario's.")
    ] = None,
    seed: Annotated[int | None, option("N", "Seed of the noise, instead of the scenario's.", min=0)] = None,
    unstable: Annotated[bool, flag("--unstable", "Also accept an unstable servo loop.")] = False,
) -> None:
    """Simulate a test: a run to calibrate, and its truth."""
    from piga.reports.stand import page
    from piga.stand.write_run import run_file_text, truth_document, write_data

    read = piga.read_scenario(scenario)
    data = f"run.{read.table.run.format}"
    names = ("run.toml", "run.csv", "run.parquet", "truth.json", "report.html")
    with deliver(out, "simulate", names, [scenario]) as to:
        with progress("simulating") as show:
            test = piga.run_scenario(read, model=model, seed=seed, force=unstable, progress=show)
        with progress("writing data and report"):
            write_data(test, to / data)
            write_text(to / "run.toml", run_file_text(read, test, data))
            truth = truth_document(read, test)
            to.write_json("truth.json", truth)
            piga.reports.write_page(page(test, read.table.instrument.serial), to / "report.html")
        to.tell(lambda: truth, test.summary)


def reproduce(
    out: Annotated[Path | None, option("DIR", "Folder for reproduction.html.")] = None,
    only: Annotated[str | None, option("ID", "Run one chapter, e.g. ten-days.")] = None,
) -> None:
    """Compute every published case and compare.

    Shows published value, computed value, difference and verdict. Exits with 1 if one disagrees.
    """
    from piga.studies.reproduction import brief, reproduction_page

    with deliver(out, "reproduce", ("reproduction.html",), ()) as to:
        with progress("reproducing") as show:
            reproduction = piga.studies.reproduce(only, progress=show)
        if out is not None:
            piga.reports.write_page(reproduction_page(reproduction), to / "reproduction.html")
        to.tell(reproduction.document, lambda: piga.reports.page_text(brief(reproduction)))
    if reproduction.failed:
        raise typer.Exit(1)


# -- platform ------------------------------------------------------------------------------------------

platform = App("platform", "Analyse a space-stable platform with case rotation.")

Out = Annotated[Path, typer.Option(metavar="DIR", help="Folder for the results and report.html.")]


@platform.command("simulate")
def simulate_platform(scenario: Scenario, out: Out) -> None:
    """Simulate the readouts and the truth.

    Writes readouts.parquet, truth.parquet, the scenario and a page.
    """
    from piga.platform.simulate import readouts_table, truth_table
    from piga.reports.platform import simulation_page

    files = ("readouts.parquet", "truth.parquet", "simulated.toml", "report.html")
    with _results(out, "simulate", scenario, *files) as to:
        run = _simulated(scenario)
        _parquet(readouts_table(run.readouts), to / files[0])
        _parquet(truth_table(run), to / files[1])
        (to / files[2]).write_bytes(scenario.read_bytes())
        eta = run.truth.eta
        document = {
            "rows": len(run.readouts.times),
            "duration_s": run.scenario.duration,
            "redundancy_deg": [math.degrees(eta[0]), math.degrees(eta[-1])],
            "files": list(files),
        }
        whole = simulation_page(run)
        to.show(document, whole, whole.only(), files[3])


@platform.command()
def align(scenario: Scenario, out: Out) -> None:
    """Align on the first stretch of a static base.

    Writes alignment.json and a page.
    """
    import msgspec

    from piga.reports.platform import alignment_page

    with _results(out, "align", scenario, "alignment.json") as to:
        run = _simulated(scenario)
        if not run.truth.motion.at_rest:
            raise PigaError(
                f"{scenario}: alignment needs a base at rest, [motion] kind = '{run.scenario.motion.kind}'",
                remedy="align on a static scenario",
            )
        wanted = msgspec.structs.replace(run.scenario.compensation, attitude="aligned")
        with progress("aligning") as advance:
            asked = replace(run, scenario=replace(run.scenario, compensation=wanted))
            aligned: Any = piga.platform.prepare(asked, advance).alignment
        whole = alignment_page(run, aligned)
        to.show(aligned.document(), whole, whole.only(), "alignment.json", "report.html")


@platform.command()
def identify(scenario: Scenario, out: Out) -> None:
    """Identify misalignments, phases and harmonics.

    Writes identification.json and a page.
    """
    from piga.platform.chain import sources_of
    from piga.reports.platform import identification_page

    with _results(out, "identify", scenario, "identification.json") as to:
        run = _simulated(scenario)
        place, orders = run.scenario.place, run.scenario.compensation.orders
        stretch = run.readouts.first(run.scenario.calibration_time)
        with progress("identifying") as advance:
            found = piga.platform.identify(
                stretch, place, sources=sources_of(run), orders=orders, progress=advance
            )
        whole = identification_page(run, found)
        to.show(found.document(), whole, whole.only("parameters"), "identification.json", "report.html")


@platform.command()
def compare(
    scenario: Scenario,
    out: Annotated[Path | None, option("DIR", "Folder for the results and report.html.")] = None,
    budget: Annotated[bool, flag("--budget", "Add the error budget by source.")] = False,
) -> None:
    """Navigate with each compensation model, and compare the models, also with theory.

    Writes comparison.json, navigation-MODEL.parquet and a page, day by day.
    """
    from piga.platform.chain import navigation_table
    from piga.reports.platform import comparison_page
    from piga.results import plain

    with _results(out, "compare", scenario, "comparison.json", "capstone.html", "navigation-*.parquet") as to:
        with progress("simulating and navigating") as advance:
            comparison = piga.platform.compare(piga.platform.load_scenario(scenario), progress=advance)
        s = comparison.run.scenario
        for name, run in comparison.models.items() if out is not None else ():
            _parquet(navigation_table(run), to / f"navigation-{name}.parquet")
        sources = piga.platform.standard_sources(comparison.preparation.alignment)
        rows = piga.platform.error_budget(s, sources) if budget else ()
        document = comparison.document()
        if rows:
            document["budget"] = plain(rows)
        if out is not None and s.sensors.pigas is not None:
            from piga.studies.platform import capstone, capstone_page

            with progress("capstone") as show:
                piga.reports.write_page(capstone_page(capstone(s, progress=show)), to / "capstone.html")
        whole = comparison_page(comparison, rows)
        brief = whole.only("lines", "equatorial-lines", "notes")
        to.show(document, whole, brief, "comparison.json", "report.html")


def _simulated(scenario: Path) -> piga.platform.PlatformRun:
    with progress("simulating"):
        return piga.platform.simulate(piga.platform.load_scenario(scenario))


def _results(out: Path | None, command: str, scenario: Path, *names: str) -> AbstractContextManager[Delivery]:
    every = dict.fromkeys((*names, "report.html"))
    return deliver(out, f"platform-{command}", tuple(every), [scenario])


def _parquet(table: Any, path: Path) -> None:
    import pyarrow.parquet as pq

    pq.write_table(table, path, write_page_checksum=True)


# -- campaigns -----------------------------------------------------------------------------------------

campaign = App("campaign", "Run thousands of tests, on one machine or many.")

CampaignFile = Annotated[Path, argument("CAMPAIGN.toml", "Campaign file.")]
CampaignOut = Annotated[Path, option("DIR", "Folder of the campaign.")]
CampaignFolder = Annotated[Path, argument("DIR", "Folder of the campaign.")]
_INCOMPLETE = 1
"""Exit code if shards could not be computed, or the run was stopped."""


@campaign.command("plan", JSON)
def plan_campaign(file: CampaignFile, out: CampaignOut) -> None:
    """Check a campaign and cut its records into shards.

    Nothing is computed; 'piga campaign status' tells the cost when a few shards are done.
    """
    planned = piga.campaign.plan_campaign(file, out)
    groups, size = planned.plan.groups, planned.manifest.records_per_shard
    document = {
        "campaign": str(planned.plan.path),
        "groups": len(groups),
        "cases": sum(group.designs for group in groups),
        "records": planned.plan.records,
        "shards": planned.shards,
        "records_per_shard": size,
    }
    lines = [planned.plan.file.campaign.title or planned.plan.path.name]
    lines += [f"  {group.records:>9} records  {group.label}" for group in groups[:30]]
    lines += [f"  and {len(groups) - 30} more"] if len(groups) > 30 else []
    lines.append(f"{planned.plan.records} records in {planned.shards} shards of {size}")
    again = shlex.join(["piga", "campaign", "run", str(file), "--out", str(out)])
    lines.append(f"wrote {out}/manifest.json; go on with: {again}")
    tell(document, lines)


@campaign.command(ends=JSON)
def run(
    file: CampaignFile,
    out: CampaignOut,
    workers: Annotated[int | None, option("N", "Processes on this machine [default: one per core].")] = None,
    executor: Annotated[str | None, option("tls://HOST:PORT", "Scheduler of a Dask cluster.")] = None,
) -> None:
    """Compute all records that are not computed yet.

    After any interruption give the same command again: it continues where it stopped. Ctrl-C drops the shards under way.
    The exit code is 1 if the run was stopped, or a worker died again and again at a shard.
    """
    from piga.reports.render.numbers import duration

    planned = piga.campaign.plan_campaign(file, out)
    try:
        with progress("computing") as show:
            report = piga.campaign.run_campaign(planned, workers=workers, executor=executor, progress=show)
    except KeyboardInterrupt:
        note("piga: stopped; the shards under way are dropped\n  remedy: give the same command again")
        raise SystemExit(_INCOMPLETE) from None
    aside = sorted(report.set_aside.items())
    document = {
        "shards": report.shards,
        "shards_done": report.done,
        "records": planned.plan.records,
        "records_of_this_run": report.records,
        "failed_in_this_run": report.failed,
        "set_aside": [{"shard": shard, "reason": reason} for shard, reason in aside],
    }
    here = f"{report.records} records in this run, {report.failed} failed, {duration(report.seconds)} of processor time"
    tell(document, [f"{report.done} of {report.shards} shards done; {here}"])
    if aside:
        for shard, reason in aside:
            note(f"piga: shard {shard} is not computed: {reason}")
        note("  remedy: find out why the worker dies (memory?), then give the same command again")
        raise SystemExit(_INCOMPLETE)
    if not Ending.as_json:
        say(f"collect with: {shlex.join(['piga', 'campaign', 'collect', str(out)])}")


@campaign.command(ends=JSON)
def status(folder: CampaignFolder) -> None:
    """Show the progress of a campaign and its core hours."""
    from piga.campaign.collect import read_rows

    opened = piga.campaign.open_campaign(folder)
    parts = opened.parts()
    heads = read_rows(opened, parts)[0] if parts else []
    hours = sum(head["seconds"] for head in heads) / 3600.0
    document = {
        "campaign": str(opened.plan.path),
        "shards": opened.shards,
        "shards_done": len(parts),
        "records": opened.plan.records,
        "records_done": len(heads),
        "failed": sum(head["error_class"] is not None for head in heads),
        "core_hours": hours,
        "core_hours_per_1000": 1000.0 * hours / len(heads) if heads else None,
    }
    lines = ["{shards_done} of {shards} shards, {records_done} of {records} records, {failed} failed"]
    cost = "cost: {core_hours:.3g} core hours so far, {core_hours_per_1000:.3g} per thousand records"
    lines += [cost] if heads else []
    tell(document, (line.format(**document) for line in lines))


@campaign.command(ends=JSON)
def collect(folder: CampaignFolder) -> None:
    """Judge the records: coverage, bias, NEES, worst cases.

    Writes collected/collect.json, coefficients.csv and report.html. Exit code 1 if shards are missing.
    """
    from piga.campaign.collect import campaign_page, write_table
    from piga.results import plain

    opened = piga.campaign.open_campaign(folder)
    names = ("collect.json", "coefficients.csv", "report.html")
    with deliver(folder / "collected", "campaign-collect", names, [folder / "manifest.json"], force=True) as to:
        collected = piga.campaign.collect(opened)
        write_table(collected, to / names[1])
        page = campaign_page(collected)
        to.show(plain(collected), page, page, names[0], names[2])
    if collected.missing:
        note(f"piga: {len(collected.missing)} of {collected.shards} shards are not computed yet")
        raise SystemExit(_INCOMPLETE)


@campaign.command()
def repeat(
    file: CampaignFile,
    record: Annotated[int, option("N", "Number of the record, from 0.", min=0)],
    out: Annotated[Path, option("DIR", "Folder for the scenario of the record.")],
) -> None:
    """Write the scenario of one record, with its values and its seed.

    'piga simulate' (or 'piga platform') then makes the record again, bit for bit.
    """
    from piga.campaign.shards import scenario_text

    planned = piga.campaign.read_campaign(file)
    chosen = planned.record(record)
    with deliver(out, "campaign-repeat", ("scenario.toml",), [file]) as to:
        write_text(to / "scenario.toml", scenario_text(planned, chosen))
        scenario = f"{shlex.quote(str((to.folder or out) / 'scenario.toml'))} --out DIR"
        commands = f"piga simulate {scenario}; piga calibrate DIR/run.toml"
        if chosen.group.subject == "platform":
            commands = f"piga platform compare {scenario}"
        document = {"record": record, "group": chosen.group.label, "commands": commands}
        to.tell(lambda: document, lambda: f"compute it with: {commands}")
