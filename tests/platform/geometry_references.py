"""Reference values of the nulled platform at 50 digits: the four null conditions solved as equations.

Run: python tests/platform/geometry_references.py > tests/platform/data/geometry.json

Unknown are a rotation vector of P against G and the ring angle; the conditions say that each momentum
lies along its tip. Nothing of the closed solution of the package is used.
"""

from __future__ import annotations

import json
import random

import mpmath as mp

mp.mp.dps = 50


def rotation(v: mp.matrix) -> mp.matrix:
    """Rotation matrix exp([v x])."""
    angle = mp.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    k = mp.matrix([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    if angle == 0:
        return mp.eye(3)
    return mp.eye(3) + mp.sin(angle) / angle * k + (1 - mp.cos(angle)) / angle**2 * (k * k)


def solve(m1: mp.mpf, c1: mp.mpf, m2: mp.mpf, c2: mp.mpf, eta: mp.mpf) -> tuple[mp.matrix, mp.mpf]:
    """``C_G^P`` and ring angle by Newton's method on the null conditions."""
    h1 = mp.matrix([0, 0, 1])
    h2 = mp.matrix([mp.cos(eta), 0, -mp.sin(eta)])
    n1 = mp.matrix([-mp.sin(m1) * mp.sin(c1), mp.sin(m1) * mp.cos(c1), mp.cos(m1)])
    n2 = mp.matrix([mp.cos(m2), -mp.sin(m2) * mp.sin(c2), mp.sin(m2) * mp.cos(c2)])

    def conditions(x: mp.mpf, y: mp.mpf, z: mp.mpf, ring: mp.mpf) -> list[mp.mpf]:
        c = rotation(mp.matrix([x, y, z])).T
        seen1, seen2 = c * h1, c * h2
        turn = mp.matrix([[mp.cos(ring), 0, mp.sin(ring)], [0, 1, 0], [-mp.sin(ring), 0, mp.cos(ring)]])
        tip = turn * n2
        return [seen1[0] - n1[0], seen1[1] - n1[1], seen2[1] - tip[1], seen2[2] - tip[2]]

    root = mp.findroot(conditions, (0, 0, 0, eta), tol=mp.mpf(10) ** -90, maxsteps=60)
    return rotation(mp.matrix(root[:3])).T, root[3]


def main() -> None:
    """Write the cases as JSON."""
    draw = random.Random(5)
    cases = []
    for k in range(24):
        size = 10.0 ** draw.uniform(-5, -1.2)
        values = [
            size,
            draw.uniform(0, 6.28),
            size * draw.uniform(0.2, 2.0),
            draw.uniform(0, 6.28),
            draw.uniform(-0.6, 0.6),
        ]
        if k == 0:
            values = [0.0, 1.0, 0.0, 2.0, 0.3]
        c, ring = solve(*(mp.mpf(v) for v in values))
        cases.append(
            {
                "input": values,
                "attitude": [[float(c[i, j]) for j in range(3)] for i in range(3)],
                "ring": float(ring),
            }
        )
    header = "geometry_references.py: null conditions at 50 digits; input m1, c1, m2, c2, eta [rad]"
    print(json.dumps({"header": header, "cases": cases}, indent=1))


if __name__ == "__main__":
    main()
