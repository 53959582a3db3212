"""``piga campaign``: thousands of tests, planned, run, watched and collected."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from piga.cli.common import (
    App,
    ForceOption,
    JsonOption,
    argument,
    deliver,
    files_named_in,
    note,
    option,
    progress,
    say,
    tell,
    write_text,
)

app = App("campaign", "Run thousands of tests, on one machine or many.")

File = Annotated[Path, argument("CAMPAIGN.toml", "Campaign file.")]
Out = Annotated[Path, option("DIR", "Folder of the campaign.")]
Folder = Annotated[Path, argument("DIR", "Folder of the campaign.")]
_INCOMPLETE = 1
"""Exit code if shards could not be computed, or the run was stopped."""


@app.command()
def plan(campaign: File, out: Out, as_json: JsonOption = False) -> None:
    """Check a campaign and cut its records into shards.

    Nothing is computed; 'piga campaign status' tells the cost when a few shards are done.
    """
    from piga.campaign.shards import plan_campaign

    planned = plan_campaign(campaign, out)
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
    lines.append(f"wrote {out}/manifest.json; go on with: {_command('run', campaign, out)}")
    tell(as_json, document, lines)


@app.command()
def run(
    campaign: File,
    out: Out,
    workers: Annotated[int | None, option("N", "Processes on this machine [default: one per core].")] = None,
    executor: Annotated[str | None, option("tls://HOST:PORT", "Scheduler of a Dask cluster.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Compute all records that are not computed yet.

    After any interruption give the same command again: it continues where it stopped. Ctrl-C drops the shards under way.
    The exit code is 1 if the run was stopped, or a worker died again and again at a shard.
    """
    from piga.campaign.shards import plan_campaign, run_campaign
    from piga.reports.render.numbers import duration

    planned = plan_campaign(campaign, out)
    engine = [] if workers is None else ["--workers", str(workers)]
    engine += [] if executor is None else ["--executor", executor]
    again = _command("run", campaign, out, *engine)
    try:
        with progress("computing") as show:
            report = run_campaign(planned, workers=workers, executor=executor, progress=show)
    except KeyboardInterrupt:
        note(f"piga: stopped; the shards under way are dropped\n  remedy: go on with: {again}")
        raise SystemExit(_INCOMPLETE) from None
    document = {
        "shards": report.shards,
        "shards_done": report.done,
        "records": planned.plan.records,
        "records_of_this_run": report.records,
        "failed_in_this_run": report.failed,
        "set_aside": [{"shard": k, "reason": text} for k, text in sorted(report.set_aside.items())],
    }
    here = f"{report.records} records in this run, {report.failed} failed, {duration(report.seconds)} of processor time"
    tell(as_json, document, [f"{report.done} of {report.shards} shards done; {here}"])
    if report.set_aside:
        for shard, text in sorted(report.set_aside.items()):
            note(f"piga: shard {shard} is not computed: {text}")
        note(f"  remedy: find out why the worker dies (memory?), then try again with: {again}")
        raise SystemExit(_INCOMPLETE)
    if not as_json:
        say(f"collect with: piga campaign collect {shlex.quote(str(out))}")


@app.command()
def status(folder: Folder, as_json: JsonOption = False) -> None:
    """Show the progress of a campaign and its core hours."""
    from piga.campaign.collect import read_rows
    from piga.campaign.shards import open_campaign

    campaign = open_campaign(folder)
    parts = campaign.parts()
    failed, seconds, records = 0, 0.0, 0
    if parts:
        heads, _ = read_rows(campaign, parts)
        records, failed = len(heads), sum(head["error_class"] is not None for head in heads)
        seconds = sum(head["seconds"] for head in heads)
    document = {
        "campaign": str(campaign.plan.path),
        "shards": campaign.shards,
        "shards_done": len(parts),
        "records": campaign.plan.records,
        "records_done": records,
        "failed": failed,
        "core_hours": seconds / 3600.0,
        "core_hours_per_1000": seconds / 3.6 / records if records else None,
    }
    lines = ["{shards_done} of {shards} shards, {records_done} of {records} records, {failed} failed"]
    cost = "cost: {core_hours:.3g} core hours so far, {core_hours_per_1000:.3g} per thousand records"
    lines += [cost] if records else []
    tell(as_json, document, (line.format(**document) for line in lines))


@app.command()
def collect(folder: Folder, as_json: JsonOption = False) -> None:
    """Judge the records: coverage, bias, NEES, worst cases.

    Writes collected/collect.json, coefficients.csv and report.html. Exit code 1 if shards are missing.
    """
    import msgspec

    from piga.campaign.collect import collect as collect_campaign
    from piga.campaign.collect import write_table
    from piga.campaign.page import campaign_page
    from piga.campaign.shards import open_campaign

    campaign = open_campaign(folder)
    names = ("collect.json", "coefficients.csv", "report.html")
    with deliver(
        folder / "collected", "campaign-collect", names, [folder / "manifest.json"], force=True, as_json=as_json
    ) as to:
        collected = collect_campaign(campaign)
        write_table(collected, to / names[1])
        page = campaign_page(collected)
        to.show(msgspec.to_builtins(collected), page, page, names[0], names[2])
    if collected.missing:
        note(f"piga: {len(collected.missing)} of {collected.shards} shards are not computed yet")
        raise SystemExit(_INCOMPLETE)


@app.command()
def repeat(
    campaign: File,
    record: Annotated[int, option("N", "Number of the record, from 0.", min=0)],
    out: Annotated[Path, option("DIR", "Folder for the scenario of the record.")],
    force: ForceOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write the scenario of one record, with its values and its seed.

    'piga simulate' (or 'piga platform') then makes the record again, bit for bit.
    """
    from piga.campaign.campaign_file import read_campaign
    from piga.campaign.subjects import scenario_text

    planned = read_campaign(campaign)
    chosen = planned.record(record)
    with deliver(
        out, "campaign-repeat", ("scenario.toml",), files_named_in(campaign), force=force, as_json=as_json
    ) as to:
        write_text(to / "scenario.toml", scenario_text(planned, chosen))
        scenario = f"{shlex.quote(str((to.folder or out) / 'scenario.toml'))} --out DIR"
        commands = f"piga simulate {scenario}; piga calibrate DIR/run.toml"
        if chosen.group.subject == "platform":
            commands = f"piga platform compare {scenario}"
        document = {"record": record, "group": chosen.group.label, "commands": commands}
        to.tell(lambda: document, lambda: f"compute it with: {commands}")


def _command(name: str, campaign: Path, out: Path, *more: str) -> str:
    parts = ["piga", "campaign", name, str(campaign), "--out", str(out), *more]
    return " ".join(shlex.quote(part) for part in parts)
