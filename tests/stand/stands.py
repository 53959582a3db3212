"""Stands that several tests share."""

import math

from piga.earth import Site
from piga.stand import (
    DividingHead,
    SpinPlan,
)
from piga.stand.scenario import head_positions

SITE = Site(math.radians(40.0), gravity=9.80166)
HEAD = DividingHead(SITE, head_positions("0:360:15 deg"))
SPIN = SpinPlan((1.0, 4.0, 2.0), 2.0, 1.0)


def derivative(function, t, h=1e-4):
    return (function(t + h) - function(t - h)) / (2 * h)
