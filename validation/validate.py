"""Compare piga with results that others published, and write ``docs/validation-data.md``. Exit code 1 if one does not hold."""

from __future__ import annotations

import gzip
import hashlib
import json
import math
import re
import sys
import tempfile
import textwrap
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import piga
from piga.certificate.dcc import read_dcc, verify_signature
from piga.gravity_norm import calibrate_set_file
from piga.noise import allan_deviation
from piga.units import G0

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "validation-data.md"
KINDS = {"oadev": "allan", "mdev": "modified", "ohdev": "hadamard"}
LIMITS = 3e-3
"""Relative difference of the ends of bands: the published ones use approximations of the degrees of freedom."""


@dataclass(frozen=True)
class Comparison:
    """A comparison: of what, with what, how far apart in which measure, and whether it holds. ``holds`` None: skipped."""

    what: str
    published: str
    result: str
    holds: bool | None


def xsens() -> Iterator[Comparison]:
    """The nine parameters of imu_tk's published run, in units of our u."""
    cal = calibrate_set_file(HERE / "data" / "xsens.toml")
    skews = np.eye(3)
    skews[1, 0], skews[2, 0], skews[2, 1] = -0.0035492, -0.0089041, -0.0213032
    m = np.linalg.inv(skews)
    published = [33124.2, 33275.2, 32364.4, 414.478, 412.102, 414.538, m[1, 0], m[2, 0], m[2, 1]]
    for term, value in zip(cal.terms, published, strict=True):
        off = (term.value - value) / term.std
        what = f"imu_tk, Xsens record: {term.key} [{term.unit}]"
        yield Comparison(what, f"{value:.7g}", f"{term.value:.7g}, {off:+.1f} u", abs(off) < 2.0)


def imucal() -> Iterator[Comparison]:
    """The twelve parameters of imucal's six positions, each axis as a direct instrument; and a term that they cannot tell."""
    own = json.loads((HERE / "data" / "imucal-result.json").read_text())
    matrix, offset = np.array(own["K_a"]) @ np.array(own["R_a"]), np.array(own["b_a"])
    log = np.genfromtxt(
        HERE / "data" / "imucal-six-positions.csv.gz", delimiter=",", names=True, dtype=None, encoding=None
    )
    part, g = log["part"], 9.81
    for i, axis in enumerate("xyz"):
        order = [i, (i + 1) % 3, (i + 2) % 3]
        upwards = np.stack(
            [(part == f"{'xyz'[k]}_p") * g - (part == f"{'xyz'[k]}_a") * g for k in order], axis=1
        )
        K = matrix[i, i]
        published = {"scale_factor": K * G0, "k0": offset[i] / K / G0}
        published |= {"m_Y": matrix[i, order[1]] / K, "m_Z": matrix[i, order[2]] / K}

        run = piga.Run.from_arrays(
            np.arange(part.size) / 100.0, log[axis].astype(float), upwards, scale_factor=f"{K * G0} LSB/g", kind="rate",
            unit="LSB", segment=part, model={"terms": [*published]}, units="SI",
        )  # fmt: skip
        with warnings.catch_warnings(action="ignore"):
            result = piga.calibrate(run)
            try:
                words = f"accepted, U {piga.calibrate(run, terms=[*published, 'k_ZZ'])['scale_factor'].expanded:.2g}"
            except piga.PigaError as error:
                words = f"refused: {str(error).splitlines()[0]}"
        for name, value in published.items():
            c = result[name]
            off = (c.value - value) / c.std
            what = f"imucal, six positions, axis {axis}: {name} [{c.unit}]"
            yield Comparison(
                what, f"{value:.7g}", f"{c.value:.7g}, {round(off, 1) + 0.0:+.1f} u", abs(off) < 2.0
            )
        what = f"imucal, six positions, axis {axis}: with k_ZZ, which one position decides"
        yield Comparison(what, "U of K 53 times smaller in piga 0.2", words, words.startswith("refused"))


NOT_OURS = "holds no calibration record of piga"
SIGNED, CHANGED = "the signature holds", "the signature does not hold: Digest mismatch"
CERTIFICATES = {
    "dcc_gp_temperature_typical_v12_signed.xml": ("signed", SIGNED),
    "dcc_gp_temperature_typical_v12_signed_manipulated.xml": ("manipulated", CHANGED),
    "dcc_gp_temperature_typical_v12_v3.2.0_signed.xml": ("signed", SIGNED),
    "dcc_gp_temperature_typical_v12_v3.2.0_signed_lt.xml": ("signed, with revocation lists", SIGNED),
    "dcc_gp_temperature_typical_v12_v3.2.0_signed_lt_revoked.xml": (
        "signer revoked",
        "was revoked on 2023-06-15",
    ),
    "dcc_gp_temperature_typical_v12_v3.2.0_signed_manipulated.xml": ("manipulated", CHANGED),
    "examples_siliziumkugel___.xml.p7m": ("XML in an envelope", "is an envelope (CMS, PKCS #7), not XML"),
    "signed_siliziumkugel.xml": (
        "signed through an XPath filter",
        "after the transform http://www.w3.org/2002/06/xmldsig-filter2",
    ),
    "siliziumkugel_2_4_0.xml": ("version 2.4.0", "DCC version '2.4.0' is not known"),
}
"""What is special about a certificate, and words of the answer. All others are valid, not signed, of other instruments."""


def certificates() -> Iterator[Comparison]:
    """The example certificates (DCC) of pydcc: a signed one is verified with the certificate inside, others are read."""
    sources = json.loads((HERE / "sources.json").read_text())["pydcc"]
    for name, file in sources["files"].items():
        path, what = HERE / "fetched" / name, f"pydcc, `{name}`"
        fact, words = CERTIFICATES.get(name, ("valid, not signed, not of piga", NOT_OURS))
        if not path.exists():
            yield Comparison(what, fact, f"skipped: {sources['licence']}; run python validation/fetch.py", None)
            continue
        raw = path.read_bytes()
        if hashlib.sha256(raw).hexdigest() != file["sha256"]:
            raise SystemExit(f"{path}: another digest than in sources.json; delete it and fetch again")
        answer = _answer(path, raw)
        yield Comparison(what, fact, answer, words in answer)


def _answer(path: Path, raw: bytes) -> str:
    """What piga says of a certificate."""
    signer = re.search(rb"X509Certificate>([^<]+)<", raw)
    try:
        if signer is None:
            return f"read: {read_dcc(path).serial}"
        body = "\n".join(textwrap.wrap("".join(signer[1].decode().split()), 64))
        with tempfile.NamedTemporaryFile("w", suffix=".pem") as pem:
            pem.write(f"-----BEGIN CERTIFICATE-----\n{body}\n-----END CERTIFICATE-----\n")
            pem.flush()
            signed = verify_signature(path, Path(pem.name))
    except piga.PigaError as error:
        return str(error).splitlines()[0].partition(f"{path}: ")[2].rstrip(" ()")
    return "; ".join((f"{SIGNED}: {signed.signer}", *(note.partition(":")[0] for note in signed.remarks)))


def nist_suite() -> Iterator[Comparison]:
    """The test suite of 1000 points of NIST SP 1065."""
    numbers = [1234567890]
    for _ in range(999):
        numbers.append(16807 * numbers[-1] % 2147483647)
    x = np.concatenate(([0.0], np.cumsum(np.array(numbers) / 2147483647.0)))
    tables = {
        "allan": (2.922319e-01, 9.159953e-02, 3.241343e-02),
        "modified": (2.922319e-01, 6.172376e-02, 2.170921e-02),
        "hadamard": (2.943883e-01, 9.581083e-02, 3.237638e-02),
    }
    for kind, table in tables.items():
        found = _deviations(x, kind, [1, 10, 100], 0)[0]
        worst = max(_units(a, b, 6) for a, b in zip(found, table, strict=True))
        text = f"largest difference {worst:.2f} units of the last printed digit"
        yield Comparison(f"NIST SP 1065, 1000 points: {kind}", "3 values, 7 digits", text, worst <= 1.0)


def allantools() -> Iterator[Comparison]:
    """Tables of Stable32 in the tests of allantools."""
    sources = json.loads((HERE / "sources.json").read_text())["allantools"]
    for name, what, read in (
        ("5071A", "caesium clock 5071A, 556 990 phases", "5071A_phase.txt.gz"),
        ("ocxo", "crystal oscillator, 19 982 frequencies", "ocxo_frequency.txt"),
        ("PHASE", "PHASE.DAT of Stable32, 1001 phases", "PHASE.DAT"),
    ):
        path = HERE / "fetched" / read
        if not path.exists():
            reason = f"skipped: the data are under {sources['licence']}; run python validation/fetch.py"
            yield Comparison(f"allantools: {what}", "tables of Stable32", reason, None)
            continue
        raw = path.read_bytes()
        if hashlib.sha256(raw).hexdigest() != sources["files"][read]["sha256"]:
            raise SystemExit(f"{path}: another digest than in sources.json; delete it and fetch again")
        lines = (gzip.decompress(raw) if read.endswith(".gz") else raw).decode().splitlines()
        x = np.array([float(line.split()[0]) for line in lines if line.strip() and not line.startswith("#")])
        if name == "ocxo":
            x = np.concatenate(([0.0], np.cumsum(x / 1e7 - np.mean(x / 1e7))))
        for short, kind in KINDS.items():
            yield _against_table(
                f"allantools, {what}: {kind}", x, kind, HERE / "fetched" / f"{name}_{short}.txt"
            )


def _against_table(what: str, x: np.ndarray, kind: str, path: Path) -> Comparison:
    worst, ends = 0.0, 0.0
    rows = [line.split() for line in path.read_text().splitlines() if line.strip() and not line.startswith("#")]
    for row in rows:
        m, exponent, low, value, high = int(row[0]), int(row[3]), *(float(one) for one in row[4:7])
        found, lower, upper = (float(one[0]) for one in _deviations(x, kind, [m], exponent))
        worst = max(worst, _units(found, value, 4))
        if low:
            ends = max(ends, abs(lower / low - 1.0), abs(upper / high - 1.0))
    text = f"largest difference {worst:.2f} units of the last printed digit"
    text += f"; ends of the bands {100.0 * ends:.2g} %" if ends else ""
    return Comparison(what, f"{len(rows)} values, 5 digits", text, worst <= 1.0 and ends <= LIMITS)


def _deviations(
    x: np.ndarray, kind: str, factors: list[int], exponent: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    begins = np.zeros(x.size, dtype=bool)
    begins[0] = True
    t = np.arange(x.size, dtype=float)
    found = allan_deviation(x, t, begins, noise={exponent: 1.0}, kind=kind, factors=factors)  # type: ignore[arg-type]
    return found.deviation, found.lower, found.upper


def _units(value: float, printed: float, digits: int) -> float:
    """Difference in units of the last digit of a number printed with so many decimals and a power of ten."""
    return abs(value - printed) / (10.0 ** (math.floor(math.log10(printed)) - digits))


def page(results: list[Comparison]) -> str:
    """The page of the documentation."""
    marks = {True: "holds", False: "**does not hold**", None: "skipped"}
    rows = [f"| {one.what} | {one.published} | {one.result} | {marks[one.holds]} |" for one in results]
    return "\n".join([HEAD, *rows, "", TAIL])


HEAD = """# Validation on data of others

Made by `python validation/validate.py`.
Records and results that we did not make: sources, licences and digests are in the folder `validation` of the repository.
No record of a real gyro accelerometer is public.
A parameter holds within 2 u, a deviation within one unit of its last printed digit, an end of a band within 0.3 %.
A certificate holds if the answer is the true one.

| comparison | published | piga | result |
|---|---|---|---|"""
TAIL = """Compared in the tests, on each change:

| data | test |
|---|---|
| NIST Statistical Reference Datasets, linear regression | `tests/calibration/model/test_reduction.py` |
| examples of JCGM 100 (GUM), annex H | `tests/calibration/test_uncertainty.py` |
| the three publications on the instrument, `piga reproduce` | [reproduction](reproduction.md) |
| the Xsens record | `tests/test_gravity_norm.py` |
| the suite of NIST SP 1065 | `tests/noise/test_deviations.py` |

Of the crystal oscillator the tables without bands are used.
Those with bands were made from a file with fewer digits, and differ by 0.2 %.
imucal takes the bias from the two positions of its own axis, piga from all six.
The certificates are those of the PTB in the tests of pydcc: each holds what its name says, and piga says so.
"""


def main() -> int:
    """Write the page; 1 if a comparison does not hold."""
    results = [*xsens(), *imucal(), *nist_suite(), *allantools(), *certificates()]
    PAGE.write_text(page(results), encoding="utf-8")
    for one in results:
        print(one.holds, one.what, one.result, sep=" | ")
    return int(any(one.holds is False for one in results))


if __name__ == "__main__":
    sys.exit(main())
