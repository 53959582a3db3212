"""The pages of the workbench. Each module holds the routes of one page; ``workbench/templates`` has its template."""

from __future__ import annotations

from typing import Any


def all_routes() -> list[Any]:
    """The routes of all pages, and of the files that they load."""
    from piga.workbench.pages import (
        calibrate,
        certificate,
        common,
        compensate,
        describe,
        explore,
        instrument,
        jobs,
        live,
        login,
        records,
        scenario,
        signals,
    )

    return [
        *common.routes(),
        *records.routes(),
        *describe.routes(),
        *signals.routes(),
        *calibrate.routes(),
        *compensate.routes(),
        *instrument.routes(),
        *certificate.routes(),
        *scenario.routes(),
        *explore.routes(),
        *live.routes(),
        *jobs.routes(),
        *login.routes(),
    ]
