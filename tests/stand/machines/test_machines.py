"""What a stand gives at a time does not depend on the other times it is asked for."""

from __future__ import annotations

import numpy as np
import pytest

from piga.frames import axis_turn
from piga.stand import Centrifuge, Composite, DividingHead, RateTable
from piga.stand.imperfections import Imperfections
from piga.stand.machines.turning import in_axes
from tests.stand.stands import SITE, SPIN

STANDS = [
    DividingHead(SITE, (0.1, 0.9, 2.0), dwell=2.0, move=1.0, roll=0.3, azimuth=0.4),
    Centrifuge(SITE, 1.0, SPIN, roll=0.2, outward=True),
    RateTable(SITE, SPIN, along="-Y0", horizontal=True, azimuth=0.7),
]


@pytest.mark.parametrize("stand", [*STANDS, Composite(tuple(STANDS), 1.5)], ids=lambda stand: stand.kind)
def test_one_row_is_that_row_of_many(stand: Composite) -> None:
    t = np.linspace(0.0, 20.0, 203)
    force, rate = stand.motion(t, Imperfections())
    for size in (1, 3):
        for at in range(0, t.size, size):
            alone = stand.motion(t[at : at + size], Imperfections())
            assert alone[0].tobytes() == force[at : at + size].tobytes()
            assert alone[1].tobytes() == rate[at : at + size].tobytes()


def test_turned_rows_are_the_matrix_product_and_each_its_own() -> None:
    vectors = np.random.default_rng(1).standard_normal((1000, 3))
    matrix = axis_turn(0, 0.3) @ axis_turn(2, 0.7) @ axis_turn(1, 1.1)
    turned = in_axes(matrix, vectors)
    np.testing.assert_allclose(turned, vectors @ matrix.T, atol=1e-15)
    rows = [in_axes(matrix, vectors[k : k + 1]) for k in range(1000)]
    assert np.concatenate(rows).tobytes() == turned.tobytes()
