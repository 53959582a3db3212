"""Columns of the calibration and their moments against quadrature."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import quad

from piga._kernels.estimation import coupling_columns, half_angle_moments, product_column
from piga.terms import PRODUCTS

pytestmark = pytest.mark.interpreted


@pytest.mark.parametrize("x", [1e-9, 1e-3, 0.1, 0.35, 0.499999, 0.500001, 0.7, 3.0, -0.4, -2.0, 40.0])
def test_half_angle_moments(x: float) -> None:
    """Against spherical Bessel functions with 50 digits; the series for small ones reach rounding."""
    with mp.workdps(50):
        size = mp.mpf(x)
        j0 = mp.sin(size) / size
        j1 = (mp.sin(size) - size * mp.cos(size)) / size**2
        for one, exact in zip(half_angle_moments(x), (j0, j1, 2 * j1 / size), strict=True):
            assert abs(one - exact) < (4e-16 * abs(exact) if abs(x) < 0.5 else 1e-14)
    assert half_angle_moments(0.0) == pytest.approx((1.0, 0.0, 2.0 / 3.0), abs=1e-16)


@pytest.mark.parametrize("turn", [1e-4, 0.1, 0.9, 2.5])
@pytest.mark.parametrize("order", [1.0, 2.0])
def test_product_integration_of_the_coupling(turn: float, order: float) -> None:
    psi, y, z = np.array([0.3, 0.3 + turn]), np.array([4.0, 5.5]), np.array([-2.0, 1.0])
    h, bend, bows = np.array([0.05]), np.array([2e-5]), np.zeros((2, 1))
    columns = np.empty((2, 1))
    sine, cosine = columns
    coupling_columns(psi, y, z, bows, h, bend, order, columns)

    def at(s: float) -> tuple[float, float, float]:
        angle = order * (psi[0] + s * turn + 4.0 * s * (1.0 - s) * bend[0])
        return angle, y[0] + s * (y[1] - y[0]), z[0] + s * (z[1] - z[0])

    def wanted(which: int) -> float:
        def integrand(s: float) -> float:
            angle, ys, zs = at(s)
            if which:
                return ys * np.cos(angle) + zs * np.sin(angle)
            return ys * np.sin(angle) - zs * np.cos(angle)

        return h[0] * quad(integrand, 0, 1, epsabs=1e-13, epsrel=1e-12)[0]

    # left out is the sag times the slope of y and z; the sag itself makes up to 1.2e-4 h here
    assert sine[0] == pytest.approx(wanted(0), abs=2e-5 * h[0])
    assert cosine[0] == pytest.approx(wanted(1), abs=2e-5 * h[0])
    coupling_columns(psi, y, z, bows, h, 0.0 * bend, order, columns)
    bend[0] = 0.0
    assert sine[0] == pytest.approx(wanted(0), rel=1e-12, abs=1e-14)
    assert cosine[0] == pytest.approx(wanted(1), rel=1e-12, abs=1e-14)


FORCE_TERMS = {
    "scale_factor": lambda x, y, z, t, T: x,
    "k1": lambda x, y, z, t, T: x,
    "k0": lambda x, y, z, t, T: 1.0,
    "k2": lambda x, y, z, t, T: x * x,
    "k3": lambda x, y, z, t, T: x**3,
    "k2o": lambda x, y, z, t, T: x * abs(x),
    "k1a": lambda x, y, z, t, T: abs(x),
    "m_Y": lambda x, y, z, t, T: y,
    "m_Z": lambda x, y, z, t, T: z,
    "k_XY": lambda x, y, z, t, T: x * y,
    "k_XZ": lambda x, y, z, t, T: x * z,
    "k_YY": lambda x, y, z, t, T: y * y,
    "k_ZZ": lambda x, y, z, t, T: z * z,
    "k_YZ": lambda x, y, z, t, T: y * z,
    "k0_t": lambda x, y, z, t, T: t,
    "k0_T": lambda x, y, z, t, T: T,
    "k1_T": lambda x, y, z, t, T: x * T,
    "k2v": lambda x, y, z, t, T: (2.0 * T) ** 2,
}


@pytest.mark.parametrize("name", list(PRODUCTS))
@pytest.mark.parametrize("ends", [(1.2, 3.4), (-2.0, 5.0), (-1.0, -4.0), (5.0, -0.1)])
def test_force_terms_are_integrated_exactly(name: str, ends: tuple[float, float]) -> None:
    force = np.array([ends, (0.4, -1.1), (2.0, 2.5)])
    t, temperature, h = np.array([3.0, 3.2]), np.array([-4.0, 5.0]), np.array([0.2])
    out = np.empty(1)
    product_column(PRODUCTS[name], t, force, temperature, h, out, 2.0 * temperature)

    def integrand(s: float) -> float:
        x, y, z = force[:, 0] + s * np.diff(force, axis=1)[:, 0]
        return FORCE_TERMS[name](x, y, z, t[0] + s * h[0], temperature[0] + s * np.diff(temperature)[0])

    kink = -ends[0] / (ends[1] - ends[0])
    points = [kink] if 0.0 < kink < 1.0 else None
    assert out[0] == pytest.approx(
        h[0] * quad(integrand, 0, 1, points=points, epsabs=1e-13)[0], rel=1e-12, abs=1e-13
    )
