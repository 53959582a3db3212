"""The one-pass kernels against the general ones, and their results whatever the chunks."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numba
import numpy as np
import pytest

import piga
from piga.compensation import Mounted, SetCompensator

from .twin_data import K_G, TAN_BETA, calibration_of

ROWS = 300 if numba.config.DISABLE_JIT else 10_000
CUTS = (0, 1, 2, 64, 65, 130, 250, ROWS)
CAL = calibration_of({"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "s1": 1e-5, "c1": -2e-5})


def samples(seed: int = 1) -> dict[str, np.ndarray]:
    """Any numbers will do; the angle passes the limit of the fast reduction."""
    rng = np.random.default_rng(seed)
    angle = 1.5999e6 + np.cumsum(np.abs(rng.standard_normal(ROWS)))
    begins = np.zeros(ROWS, dtype=bool)
    begins[[70, 200]] = True
    return {
        "t": np.cumsum(0.01 + 1e-4 * rng.random(ROWS)), "output": rng.standard_normal(ROWS),
        "f": 9.8 * rng.standard_normal((ROWS, 3)), "angle": angle, "begins": begins,
    }  # fmt: skip


STD = {"scale_factor": 1e-7, "tan_beta": 1e-6, "phi": 1e-4, "k0": 1e-6}
VALUES = {"scale_factor": K_G, "tan_beta": TAN_BETA, "phi": 0.3, "s1": 1e-5, "c1": -2e-5, "k0": 1e-3}
LIMITS = {"range": {"a_x": [-20.0, 20.0], "a_t": [0.0, 15.0]}}


@pytest.mark.compiled
@pytest.mark.parametrize("left_out", [(), ("tan_beta",), ("scale_factor", "k0"), tuple(STD)])
def test_one_pass_is_the_general_kernel_to_rounding_and_itself_to_the_bit(left_out):
    """A base rate of zero takes the general kernel; chunks of any size, all results or some."""
    columns = samples()
    columns["t"][120] = columns["t"][119]
    std = {name: u for name, u in STD.items() if name not in left_out}
    cal = calibration_of(VALUES, std, angle_rms=1e-6, angle_random_walk=1e-5, diagnostics=LIMITS)
    spread = np.sqrt(np.diag(cal.covariance))
    cal = replace(cal, covariance=np.outer(spread, spread) * (0.6 + 0.4 * np.eye(spread.size)))
    whole = piga.Compensator(cal, kind="rate", step=0.01).push(columns)
    still = {**columns, "base_rate": np.zeros((ROWS, 3))}
    general = piga.Compensator(cal, kind="rate", step=0.01).push(still)
    size = np.abs(general.ax) + np.abs(columns["f"]).max()
    assert np.all(np.abs(whole.ax - general.ax) < 4e-16 * size)
    assert np.abs(whole.dv - general.dv).max() < 4e-16 * size.max()
    assert np.abs(whole.u_ax / general.u_ax - 1.0).max() < 2e-15
    assert np.array_equal(whole.flags, general.flags)
    assert len(set(whole.flags.tolist())) > 4
    stream = piga.Compensator(cal, kind="rate", step=0.01)
    parts = [stream.push({name: c[a:b] for name, c in columns.items()}) for a, b in pairwise(CUTS)]
    for name in ("ax", "dv", "u_ax", "flags"):
        assert np.concatenate([getattr(p, name) for p in parts]).tobytes() == getattr(whole, name).tobytes()
    bare = piga.Compensator(cal, kind="rate", uncertainty=False, flags=False).push(columns)
    flagged = piga.Compensator(cal, kind="rate", step=0.01, uncertainty=False).push(columns)
    known = piga.Compensator(cal, kind="rate", step=0.01, flags=False).push(columns)
    for found in (bare, flagged, known):
        assert found.ax.tobytes() == whole.ax.tobytes()
        assert found.dv.tobytes() == whole.dv.tobytes()
    assert np.array_equal(flagged.flags, whole.flags)
    assert known.u_ax.tobytes() == whole.u_ax.tobytes()
    assert list(bare.columns()) == ["t", "ax", "dv"]
    assert columns["angle"][-1] > 1.6e6 > columns["angle"][0]
    assert np.all(whole.dv[columns["begins"]] == 0.0)


@pytest.mark.compiled
def test_triad_of_samples_agrees_with_the_general_solution_and_with_itself():
    data = [samples(seed) for seed in range(3)]
    t, begins = data[0]["t"], data[0]["begins"]
    psi, rate = np.array([d["angle"] for d in data]), np.array([d["output"] for d in data])
    mounted = [Mounted(CAL, np.roll(np.eye(3), -i, axis=0)) for i in range(3)]

    def push(cuts, **wanted):
        stream = SetCompensator(mounted, sampled=True, **wanted)
        parts = [
            stream.push(t[a:b], psi[:, a:b], rate=rate[:, a:b], begins=begins[a:b]) for a, b in pairwise(cuts)
        ]
        return {name: np.concatenate([getattr(p, name) for p in parts]) for name in ("f", "dv", "flags")}

    general, lean = push((0, ROWS)), push((0, ROWS), uncertainty=False)
    cut, bare = push(CUTS, uncertainty=False), push(CUTS, uncertainty=False, flags=False)
    assert np.abs(lean["f"] - general["f"]).max() < 1e-14 * np.abs(general["f"]).max()
    assert np.abs(lean["dv"] - general["dv"]).max() < 1e-15
    assert np.array_equal(lean["flags"], general["flags"])
    assert len(set(lean["flags"].tolist())) > 2
    for name in ("f", "dv"):
        assert lean[name].tobytes() == cut[name].tobytes() == bare[name].tobytes()
    assert lean["flags"].tobytes() == cut["flags"].tobytes()


def test_bad_number_in_a_set_is_named_and_leaves_the_state():
    data = samples()
    psi = np.tile(data["angle"], (3, 1))
    mounted = [Mounted(CAL, np.roll(np.eye(3), -i, axis=0)) for i in range(3)]
    stream, sound = SetCompensator(mounted), SetCompensator(mounted)
    stream.push(data["t"][:10], psi[:, :10])
    sound.push(data["t"][:10], psi[:, :10])
    broken = psi[:, 10:20].copy()
    broken[1, 9] = np.nan
    with pytest.raises(piga.ArgumentError, match=r"output\[1, 9\] is not finite"):
        stream.push(data["t"][10:20], broken)
    again = [s.push(data["t"][10:20], psi[:, 10:20]).f for s in (stream, sound)]
    assert again[0].tobytes() == again[1].tobytes()
