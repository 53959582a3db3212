"""Lines of both cases per day, against a navigator and a platform written here from the equations alone.

The platform is nulled by Newton steps on the angle between the momenta; the navigator integrates position and
velocity in inertial axes by Runge-Kutta steps; lines are fitted with NumPy. None of the kernels takes part.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from piga.platform import compare, true_knowledge
from piga.platform.chain import CHANNELS, daily_lines, fitted_lines, has_theory, theory_lines, theory_note
from piga.platform.navigator import Errors
from piga.platform.scenario import (
    Compensation,
    Gyro,
    Harmonic,
    MotionPlan,
    Place,
    PlatformScenario,
)
from tests.platform.conftest import ARCMIN, AT_SEA, DEG, long, published

DAY = 86400.0
W1, W2 = 2.0 * np.pi / 480.0, 2.0 * np.pi / 560.0
GM, A, F, J2, OMEGA = 3.986004418e14, 6378137.0, 1.0 / 298.257223563, 1.08262982131e-3, 7.292115e-5
LATITUDES = (5.0, 40.0, 75.0)
HEADING = 30.0 * DEG


def unequal(latitude: float = 40.0, **changes):
    """The published gyros with other phases, cases at 8 min and 9 min 20 s."""
    values = {
        "place": Place(latitude * DEG),
        "duration": DAY,
        "polar": Gyro(4.0 * ARCMIN, 20.0 * DEG, (Harmonic(2, 0.3 * ARCMIN, 1.0),)),
        "equatorial": Gyro(
            4.0 * ARCMIN, 75.0 * DEG, (Harmonic(2, 0.4 * ARCMIN, 2.0),), drift=(0.01 * DEG / 3600.0, 0.0)
        ),
        "equatorial_rotation": W2,
        "redundancy": 2.0 * DEG,
        "motion": MotionPlan(heading=HEADING),
    }
    return published(**(values | changes))


def about(axis: int, angle) -> np.ndarray:
    """Matrices (..., 3, 3) that turn vectors by ``angle`` about an axis."""
    angle = np.asarray(angle, dtype=float)
    turn = np.zeros((*angle.shape, 3, 3))
    second, third = (axis + 1) % 3, (axis + 2) % 3
    turn[..., axis, axis] = 1.0
    turn[..., second, second] = turn[..., third, third] = np.cos(angle)
    turn[..., second, third], turn[..., third, second] = -np.sin(angle), np.sin(angle)
    return turn


def frame(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Right-handed orthonormal columns (n, 3, 3): along ``first``, across both, and the third."""
    across = np.cross(first, second)
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    return np.stack([first, across, np.cross(first, across)], axis=-1)


def platform(polar: Gyro, equatorial: Gyro, c1, c2, eta) -> np.ndarray:
    """``C_G^P`` (n, 3, 3) with both pick-offs nulled: the ring turns until the tips stand as the momenta do."""

    def size(gyro, c):
        return gyro.misalignment + sum(h.amplitude * np.cos(h.order * c + h.phase) for h in gyro.harmonics)

    m1, m2, zero = size(polar, c1), size(equatorial, c2), 0.0 * c1
    tip1 = np.stack([-np.sin(m1) * np.sin(c1), np.sin(m1) * np.cos(c1), np.cos(m1)], axis=-1)
    tip2 = np.stack([np.cos(m2), -np.sin(m2) * np.sin(c2), np.sin(m2) * np.cos(c2)], axis=-1)
    h1, h2 = np.stack([zero, zero, zero + 1.0], -1), np.stack([np.cos(eta), zero, -np.sin(eta)], -1)
    ring = np.array(eta)
    for _ in range(6):
        seen = np.einsum("ni,nij,nj->n", tip1, about(1, ring), tip2)
        slope = np.einsum("ni,nij,nj->n", tip1, about(1, ring + 0.5 * np.pi), tip2) - tip1[:, 1] * tip2[:, 1]
        ring -= (seen + np.sin(eta)) / slope
    along = np.einsum("nij,nj->ni", about(1, ring), tip2)
    return frame(tip1, along) @ np.swapaxes(frame(h1, h2), -1, -2)


def gravitation(r: np.ndarray) -> np.ndarray:
    square = np.sum(r * r, axis=-1, keepdims=True)
    s2 = r[..., 2:] ** 2 / square
    factor = 1.0 + 1.5 * J2 * A**2 / square * (np.array([1.0, 1.0, 3.0]) - 5.0 * s2)
    return -GM * r / square**1.5 * factor


def geodetic(r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and height (Bowring's first step, good to 1e-9 m near the ground)."""
    e2, out = F * (2.0 - F), np.hypot(r[..., 0], r[..., 1])
    beta = np.arctan2(r[..., 2], (1.0 - F) * out)
    north = r[..., 2] + e2 / (1.0 - F) * A * np.sin(beta) ** 3
    latitude = np.arctan2(north, out - e2 * A * np.cos(beta) ** 3)
    root = np.sqrt(1.0 - e2 * np.sin(latitude) ** 2)
    return latitude, out * np.cos(latitude) + r[..., 2] * np.sin(latitude) - A * root


def down_axes(latitude, longitude) -> np.ndarray:
    """``C_n^e``, columns north, east, down."""
    return about(2, longitude) @ about(1, -np.asarray(latitude) - 0.5 * np.pi)


def undoing(s: PlatformScenario, model: str, c1: np.ndarray, c2: np.ndarray) -> np.ndarray:
    """``I + [e x]`` (n, 3, 3) of model A with the true misalignments, or nothing."""
    undone = np.broadcast_to(np.eye(3), (len(c1), 3, 3)).copy()
    if model == "A":
        m1, m2 = s.polar.misalignment, s.equatorial.misalignment
        ex, ey = m1 * np.cos(c1), m1 * np.sin(c1)
        ez = m2 * np.sin(c2) / np.cos(s.redundancy) - ex * np.tan(s.redundancy)
        for i, j, e in ((1, 0, ez), (0, 2, ey), (2, 1, ex)):
            undone[:, i, j], undone[:, j, i] = e, -e
    return undone


@cache
def simulated(step: float = 30.0) -> dict[tuple[str, float], Errors]:
    """Errors over a day at rest of navigators with models none and A at all latitudes (Runge-Kutta, all at once)."""
    s, cases = unequal(), [(model, latitude) for model in ("none", "A") for latitude in LATITUDES]
    half = 0.5 * step * np.arange(2 * round(DAY / step) + 1)
    c1, c2 = W1 * half + s.polar.phase, W2 * half + s.equatorial.phase
    attitude = platform(s.polar, s.equatorial, c1, c2, s.redundancy + s.equatorial.drift[0] * half)
    undone = np.stack([undoing(s, model, c1, c2) for model, _ in cases], axis=1)
    place = np.array([latitude for _, latitude in cases]) * DEG
    prime = A / np.sqrt(1.0 - F * (2.0 - F) * np.sin(place) ** 2)
    at = np.stack([prime * np.cos(place), 0.0 * place, prime * (1.0 - F) ** 2 * np.sin(place)], axis=-1)
    at_rest = -gravitation(at) - OMEGA**2 * at * np.array([1.0, 1.0, 0.0])
    force = np.einsum("nij,bj->nbi", about(2, OMEGA * half), at_rest)
    felt = np.einsum("nbij,njk,nbk->nbi", undone, attitude, force)
    k1, k2 = 2.0 / 100.0, 1.0 / 100.0**2 + 2.0 * GM / A**3

    def slope(x, f):
        lat, height = geodetic(x[0])
        flat, lon = np.cos(lat), np.arctan2(x[0, :, 1], x[0, :, 0])
        above = height[:, None] * np.stack([flat * np.cos(lon), flat * np.sin(lon), np.sin(lat)], axis=-1)
        return np.stack([x[1] - k1 * above, f + gravitation(x[0]) - k2 * above])

    x = np.stack([at, np.cross([0.0, 0.0, OMEGA], at)])
    rows = [x]
    for k in range(0, len(half) - 1, 2):
        first = slope(x, felt[k])
        second = slope(x + 0.5 * step * first, felt[k + 1])
        third = slope(x + 0.5 * step * second, felt[k + 1])
        fourth = slope(x + step * third, felt[k + 2])
        x = x + step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
        rows.append(x)
    back = about(2, -OMEGA * half[::2])
    fixed = np.einsum("nij,nkbj->knbi", back, np.array(rows))
    lat, height = geodetic(fixed[0])
    lon = np.arctan2(fixed[0, ..., 1], fixed[0, ..., 0])
    to_local = np.swapaxes(down_axes(lat, lon), -1, -2)
    velocity = fixed[1] - np.cross([0.0, 0.0, OMEGA], fixed[0])
    body = (attitude[::2] @ about(2, OMEGA * half[::2]))[:, None] @ down_axes(place, 0.0) @ about(2, HEADING)
    c = to_local @ back[:, None] @ undone[::2] @ body
    angles = [
        np.arctan2(c[..., 2, 1], c[..., 2, 2]),
        -np.arcsin(c[..., 2, 0]),
        np.arctan2(c[..., 1, 0], c[..., 0, 0]) - HEADING,
    ]
    table = np.stack([(lat - place) * A, lon * A * np.cos(place), height, *angles], axis=-1)[1:]
    speeds = np.einsum("nbij,nbj->nbi", to_local, velocity)[1:]
    return {
        case: Errors(half[2::2], *table[:, b, :3].T, speeds[:, b], table[:, b, 3:])
        for b, case in enumerate(cases)
    }


def lines(e: Errors, latitude: float) -> dict[str, np.ndarray]:
    """Amplitudes at W1 and W2 (2,) of every channel, by least squares with what else is there.

    Rows times ``sin^2`` over the day. Without that the Schuler oscillation of 1.5 m/s, whose rate the columns have to 0.2 %,
    leaks into lines below 1 mm/s.
    """
    t = e.times - e.times.mean()
    schuler, split = np.sqrt(GM / A**3), OMEGA * np.sin(latitude * DEG)
    rates = (W1, W2, W1 - OMEGA, W1 + OMEGA, 2 * W1, 2 * W2, W1 + W2, W1 - W2, schuler, schuler - split,
             schuler + split)  # fmt: skip
    columns = [f(w * t) for w in rates for f in (np.cos, np.sin)]
    columns += [t / DAY * column for column in columns[:4]]
    columns += [(t / DAY) ** k for k in range(5)]
    named = dict(zip(CHANNELS, (e.velocity[:, 1], e.velocity[:, 0], *e.attitude.T[[2, 0, 1]]), strict=True))
    weights = np.sin(np.pi * (np.arange(len(t)) + 0.5) / len(t))[:, None] ** 2
    design, values = np.stack(columns, axis=1), np.stack(list(named.values()), axis=1)
    solved = np.linalg.lstsq(weights * design, weights * values, rcond=None)[0]
    amplitude = np.hypot(solved[0:4:2], solved[1:4:2])
    return {name: amplitude[:, k] for k, name in enumerate(named)}


def close(seen: dict, reference: dict, part: float = 0.01) -> None:
    """Every channel at both rates within 1 %."""
    for name, values in reference.items():
        assert np.all(np.abs(seen[name] - values) < part * values), (name, seen[name] / values - 1.0)


def both(lines_of_day) -> dict[str, np.ndarray]:
    return {
        name: np.array([lines_of_day.amplitude[name][0], lines_of_day.equatorial[name][0]]) for name in CHANNELS
    }


@pytest.mark.parametrize("latitude", LATITUDES)
@pytest.mark.parametrize("model", ["none", "A"])
def test_the_daily_fit_takes_both_lines(model, latitude):
    e = simulated()[model, latitude]
    close(both(daily_lines(e, (W1, W2), latitude * DEG)), lines(e, latitude))


@pytest.mark.parametrize("latitude", LATITUDES)
@pytest.mark.parametrize("model", ["none", "A"])
def test_the_closed_form_gives_both_lines(model, latitude):
    s, e = unequal(latitude), simulated()[model, latitude]
    known, reference = true_knowledge(s), lines(e, latitude)
    theory = theory_lines(s, model, known, [slice(0, len(e.times))], e.times)
    close(both(theory), reference, part=0.002)


EQUATORIAL = {
    "east_velocity_equatorial_line_m_s",
    "north_velocity_equatorial_line_m_s",
    "heading_equatorial_line_arcmin",
    "roll_equatorial_line_arcmin",
}


def compared(**changes):
    known = Compensation(models=("none", "B"), misalignment="true", attitude="true")
    return compare(published(duration=14400.0, step=16.0, compensation=known, **changes))


def test_the_document_names_the_equatorial_lines_when_the_speeds_differ():
    alike, apart = compared().document(), compared(equatorial_rotation=W2).document()
    for part in ("models", "theory"):
        assert not EQUATORIAL & set(alike[part]["none"])
        assert set(apart[part]["none"]) >= EQUATORIAL
        for model in apart[part].values():
            assert len({len(values) for values in model.values()}) == 1
    seen, expected = (apart[part]["none"]["heading_equatorial_line_arcmin"][0] for part in ("models", "theory"))
    assert seen == pytest.approx(expected, rel=0.01)


def test_speeds_that_a_stretch_cannot_tell_apart_give_no_line_and_a_note():
    result = compared(equatorial_rotation=W1 * 1.01)
    assert result.document()["models"]["none"]["roll_line_arcmin"] == [None]
    assert "cannot be told apart within 4 h" in result.preparation.notes[0]


def test_a_case_at_rest_has_no_line():
    content = compared(polar_rotation=0.0).document()
    assert (
        content["models"]["none"]["heading_line_arcmin"]
        == [None]
        == content["theory"]["none"]["heading_line_arcmin"]
    )
    expected = content["theory"]["none"]["heading_equatorial_line_arcmin"][0]
    assert content["models"]["none"]["heading_equatorial_line_arcmin"][0] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("ratio", [0.5, 2.0, 1.03])
def test_lines_are_found_beside_all_that_is_known_to_be_there(ratio):
    """Also where twice one rate is the other."""
    t, w2 = np.arange(4320) * 20.0, ratio * W1
    wave = 0.02 * np.cos(W1 * t + 0.3) + (0.5 + 1e-7 * t) * np.sin(w2 * t)
    wave += 0.4 * np.cos((W1 + OMEGA) * t) + 0.8 * np.sin(1.2394e-3 * t) + 1e-5 * t
    seen = fitted_lines(t, wave[:, None], (W1, w2), 0.7)[:, 0]
    np.testing.assert_allclose(seen, [0.02, 0.5 + 1e-7 * t.mean()], rtol=2e-3)


@long
@pytest.mark.parametrize(
    ("kind", "hours", "changes"),
    [
        ("static", 6.0, {}),
        ("static", 24.0, {}),
        ("sway", 12.0, {}),
        ("turn", 12.0, {}),
        ("static", 26.0, {"place": Place(-35.0 * DEG)}),
        ("static", 24.0, {"triad": (0.01, -0.02, 0.1), "equatorial_rotation": W2}),
        ("static", 8.0, {"equatorial_rotation": W2, "redundancy": 2.0 * DEG}),
    ],
)
def test_lines_of_a_base_that_stays_at_its_place_are_those_of_the_theory(kind, hours, changes):
    """No model: the neighbours at ``+- Earth rate`` are as large as the line itself, and do not leak into it."""
    motion = {"static": MotionPlan(heading=HEADING), "sway": AT_SEA, "turn": MotionPlan("turn", turn_rate=0.01)}
    s = published(
        duration=hours * 3600.0,
        step=4.0,
        motion=motion[kind],
        compensation=Compensation(("none",), misalignment="true", attitude="true"),
        **changes,
    )
    ran = compare(s).models["none"]
    for channel in CHANNELS[:4]:
        if kind == "turn" and channel == "roll":
            assert np.isnan(ran.theory.amplitude[channel]).all()
        else:
            expected = ran.theory.amplitude[channel]
            least = 2e-6 if channel == "north_velocity" else 0.0  # second order
            seen = ran.lines.amplitude[channel]
            np.testing.assert_allclose(seen, expected, rtol=2e-3, atol=least, err_msg=channel)


@pytest.mark.parametrize(
    ("changes", "note", "theory"),
    [
        ({}, "", True),
        ({"motion": MotionPlan("turn", turn_rate=0.01)}, "the base turns", True),
        ({"motion": MotionPlan("track")}, "the base changes its place", False),
        ({"reversal": 1}, "the cases reverse", False),
        ({"duration": 3600.0}, "in less than 4 h", False),
    ],
)
def test_a_note_says_where_no_theory_holds(changes, note, theory):
    s = published(**changes)
    assert theory_note(s).startswith(note)
    assert has_theory(s) == theory
