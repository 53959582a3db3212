"""The rules: which component of the noise is looked for when, and from which gain it enters covariance and weights.

``python -m piga.calibration.noise.rules`` prints the table of docs/theory/noise.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

from piga.calibration.noise.components import COMPONENTS
from piga.calibration.noise.settings import NOISE

ALWAYS, NEVER = "always", "never"


@dataclass(frozen=True)
class Rule:
    """What is done with a component. Gains are those of twice the log-likelihood.

    ``looked_for``: the records in which it is looked for. ``covariance``, ``weights``: the gain from which it enters them.
    ``evidence``: where the numbers come from.
    """

    component: str
    looked_for: str
    covariance: str
    weights: str
    evidence: str


def _over(gain: float) -> str:
    return f"gain above {gain:g}"


RULES = (
    Rule("white", "every record", ALWAYS, ALWAYS, "by definition"),
    Rule(
        "walk",
        "angle logs",
        f"always, of either sign; up to {NOISE.restricted_rows} increments",
        _over(NOISE.walk_in_weights),
        "scenarios `white`, `faint`: 93.7 % with a limit of zero, 95 % without",
    ),
    Rule(
        "counting",
        f"white noise below {NOISE.counting_white:g} and walk below {NOISE.counting_walk:g} squared counts",
        ALWAYS,
        ALWAYS,
        "scenarios `coarse`, `mix`",
    ),
    Rule(
        "flicker",
        f"{NOISE.colour_least} increments a part, up to {NOISE.most_segments} segments",
        f"{_over(NOISE.colour_in_covariance)}, {NOISE.colour_ahead:g} ahead of drift and scatter",
        NEVER,
        "scenarios `head-flicker`, `rate-flicker`; sound records: one in twenty",
    ),
    Rule("markov", "as flicker", "as flicker", NEVER, "scenarios `head-markov`, `rate-markov`"),
    Rule(
        "drift",
        "angle logs; in rate logs as flicker",
        _over(NOISE.slow_in_covariance),
        f"{_over(NOISE.slow_in_weights)}; never beside counts",
        "scenario `drift`; weights for a drift that is not there cost six times the variance",
    ),
    Rule(
        "scatter",
        f"{NOISE.fewest_segments} to {NOISE.most_segments} segments; in rate logs as flicker",
        _over(NOISE.slow_in_covariance),
        f"{_over(NOISE.slow_in_weights)}; never beside counts",
        "scenario `scatter`",
    ),
)


def table() -> str:
    """The components and their rules as Markdown."""
    lines = [
        "| component | what it is | level | looked for in | in the covariance | in the weights | evidence |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for rule in RULES:
        part = COMPONENTS[rule.component]
        cells = (
            part.name,
            part.meaning,
            part.unit,
            rule.looked_for,
            rule.covariance,
            rule.weights,
            rule.evidence,
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(table())
