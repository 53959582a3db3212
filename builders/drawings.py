"""Drawings of the manual as SVG, in the symbols of the text: ``python -m builders.drawings`` writes ``docs/figures/drawing-*.svg``.

Lengths are in pixels of the drawing, y downwards. The colours follow the reader's light or dark mode.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "figures"
STYLE = """
:root{color-scheme:light dark}
.bg{fill:#ffffff}.l{stroke:#1f2328;fill:none;stroke-width:1.6;stroke-linecap:round;stroke-linejoin:round}
.thin{stroke-width:1}.dash{stroke-dasharray:5 4}.b{stroke:#0a5ea8}.r{stroke:#b3261e}.g{stroke:#2e7d32}.n{stroke:#6e7781}
.body{fill:#eef2f6;stroke:#1f2328;stroke-width:1.4}.solid{fill:#1f2328}.fb{fill:#0a5ea8}.fr{fill:#b3261e}.fg{fill:#2e7d32}.fn{fill:#57606a}
text{font-family:system-ui,'DejaVu Sans',sans-serif;font-size:15px;fill:#1f2328}.small{font-size:13px}.head{font-weight:600}
@media(prefers-color-scheme:dark){.bg{fill:#131416}.l{stroke:#e6edf3}.b{stroke:#6cb2f0}.r{stroke:#ff8a80}.g{stroke:#81c784}.n{stroke:#8b949e}
.body{fill:#23272e;stroke:#e6edf3}.solid{fill:#e6edf3}text{fill:#e6edf3}.fb{fill:#6cb2f0}.fr{fill:#ff8a80}.fg{fill:#81c784}.fn{fill:#9aa4af}}
""".replace("\n", "")
FILLS = {"b": "fb", "r": "fr", "g": "fg", "n": "fn", "": "solid"}
"""Fill of an arrow head, by the class of its line."""

Point = tuple[float, float]


class Drawing:
    """An SVG that grows by lines, arrows, arcs and words. Words: ``_x`` is a subscript, e.g. ``a_Y`` or ``X_0``."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self.width, self.height, self.title = width, height, title
        self.parts: list[str] = []

    def path(self, data: str, kind: str = "") -> None:
        """A path of the line class and the further classes ``kind``."""
        self.parts.append(f'<path class="l {kind}" d="{data}"/>')

    def line(self, *points: Point, kind: str = "") -> None:
        """A line through points."""
        self.path("M" + " L".join(f"{x:.1f} {y:.1f}" for x, y in points), kind)

    def arrow(self, start: Point, end: Point, words: str = "", kind: str = "", shift: Point = (8, 5)) -> None:
        """An arrow, with words at its end."""
        self.line(start, end, kind=kind)
        self._head(end, math.atan2(end[1] - start[1], end[0] - start[0]), kind)
        if words:
            self.text((end[0] + shift[0], end[1] + shift[1]), words, kind)

    def _head(self, tip: Point, angle: float, kind: str) -> None:
        sides = [(tip[0] - 10 * math.cos(angle + d), tip[1] - 10 * math.sin(angle + d)) for d in (-0.38, 0.38)]
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (tip, *sides))
        colour = next((FILLS[part] for part in kind.split() if part in FILLS), "solid")
        self.parts.append(f'<polygon class="{colour}" points="{points}"/>')

    def curve(self, points: Sequence[Point], kind: str = "", *, head: bool = False) -> None:
        """A line through many points, with an arrow head at its end if asked."""
        self.line(*points, kind=kind)
        if head:
            (x0, y0), (x1, y1) = points[-3], points[-1]
            self._head((x1, y1), math.atan2(y1 - y0, x1 - x0), kind)

    def arc(
        self, centre: Point, radius: float, start: float, end: float, kind: str = "", *, head: bool = True
    ) -> None:
        """An arc from angle ``start`` to ``end`` [deg], counter-clockwise positive."""
        steps = [math.radians(start + (end - start) * k / 40) for k in range(41)]
        points = [(centre[0] + radius * math.cos(a), centre[1] - radius * math.sin(a)) for a in steps]
        self.curve(points, kind, head=head)

    def circle(self, centre: Point, radius: float, kind: str = "body") -> None:
        """A circle."""
        self.parts.append(f'<circle class="{kind}" cx="{centre[0]:.1f}" cy="{centre[1]:.1f}" r="{radius:g}"/>')

    def box(self, corner: Point, size: Point, words: str = "", turn: float = 0.0) -> None:
        """A box with words in its middle, turned by ``turn`` [deg] counter-clockwise."""
        (x, y), (w, h) = corner, size
        middle = f"{x + w / 2:.1f} {y + h / 2:.1f}"
        self.parts.append(
            f'<rect class="body" x="{x}" y="{y}" width="{w}" height="{h}" rx="4" transform="rotate({-turn:g} {middle})"/>'
        )
        if words:
            lines = words.split("|")
            for k, line in enumerate(lines):
                self.text((x + w / 2, y + h / 2 + 5 + 18 * (k - (len(lines) - 1) / 2)), line, anchor="middle")

    def tile(self, corner: Point, size: Point, kind: str, opacity: str) -> None:
        """A rectangle without a border, filled by the class ``kind``."""
        place = f'x="{corner[0]}" y="{corner[1]}" width="{size[0]}" height="{size[1]}"'
        self.parts.append(f'<rect class="{kind}" opacity="{opacity}" {place}/>')

    def text(self, at: Point, words: str, kind: str = "", anchor: str = "start") -> None:
        """Words at a place; ``kind`` of a line gives them its colour."""
        colour = " ".join(FILLS.get(part, part) for part in kind.split() if part not in ("thin", "dash"))
        body = re.sub(
            r"_(\w+)", r'<tspan dy="4" font-size="72%">\1</tspan><tspan dy="-4">&#8203;</tspan>', escape(words)
        )
        self.parts.append(
            f'<text class="{colour}" x="{at[0]:.1f}" y="{at[1]:.1f}" text-anchor="{anchor}">{body}</text>'
        )

    def svg(self) -> str:
        """The file."""
        size = f'viewBox="0 0 {self.width} {self.height}" width="{self.width}" height="{self.height}"'
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" {size} role="img" aria-label="{escape(self.title)}">'
            f"<title>{escape(self.title)}</title><style>{STYLE}</style>"
            f'<rect class="bg" width="100%" height="100%"/>{"".join(self.parts)}</svg>\n'
        )


def isometric(origin: Point, x: float, y: float, z: float) -> Point:
    """A point in space on the drawing: x up, y to the lower left, z to the lower right (right-handed)."""
    c, s = math.cos(math.radians(30)), 0.5
    return origin[0] + c * (z - y), origin[1] - x + s * (y + z)


def ellipse(centre: Point, radii: Point, start: float = 0.0, end: float = 360.0) -> list[Point]:
    """Points of an ellipse from angle ``start`` to ``end`` [deg], counter-clockwise positive, 4.5 deg apart."""
    angles = [math.radians(start + 4.5 * k) for k in range(round((end - start) / 4.5) + 1)]
    return [(centre[0] + radii[0] * math.cos(a), centre[1] - radii[1] * math.sin(a)) for a in angles]


def instrument() -> Drawing:
    """The instrument with its frames, the rotor axis and the pendulous mass."""
    d = Drawing(
        880, 520, "The instrument: frames, gimbal angle alpha, rotor axis tilted by beta, pendulous mass"
    )
    at: Callable[..., Point] = lambda x, y, z: isometric((330, 285), x, y, z)  # noqa: E731
    turn = math.radians(35)
    y1, z1 = (math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn))
    ring = [at(0, 120 * math.cos(a), 120 * math.sin(a)) for a in [k * math.pi / 60 for k in range(121)]]
    d.curve(ring, "n thin")
    d.arrow(at(-60, 0, 0), at(235, 0, 0), "X_0 = X_1: input axis, axis of the outer gimbal")
    d.arrow(at(0, 0, 0), at(0, 205, 0), "Y_0", "n", (-34, 8))
    d.arrow(at(0, 0, 0), at(0, 0, 205), "Z_0", "n")
    d.arrow(at(0, 0, 0), at(0, 180 * y1[0], 180 * y1[1]), "Y_1: axis of the inner gimbal", "b", (-60, 20))
    d.arrow(at(0, 0, 0), at(0, 190 * z1[0], 190 * z1[1]), "Z_1", "b", (8, 16))
    arc = [at(0, 78 * math.cos(a), 78 * math.sin(a)) for a in [turn * k / 20 for k in range(21)]]
    d.curve(arc, "b", head=True)
    d.text((at(0, 92, 30)[0] - 2, at(0, 92, 30)[1] + 16), "α", "b")
    beta = math.radians(16)
    tip = at(190 * math.sin(beta), 190 * math.cos(beta) * z1[0], 190 * math.cos(beta) * z1[1])
    d.arrow(at(0, 0, 0), tip, "z: rotor axis", "r", (8, -4))
    tilt = [
        at(150 * math.sin(b), 150 * math.cos(b) * z1[0], 150 * math.cos(b) * z1[1])
        for b in [beta * k / 12 for k in range(13)]
    ]
    d.curve(tilt, "r")
    d.text((tilt[6][0] + 8, tilt[6][1] + 5), "β", "r")
    rotor = [
        at(
            50 * math.cos(a) * math.cos(beta),
            *(50 * math.sin(a) * y1[k] - 50 * math.cos(a) * math.sin(beta) * z1[k] for k in (0, 1)),
        )
        for a in [k * math.pi / 40 for k in range(81)]
    ]
    d.curve(rotor, "r")
    mass = at(62 * math.sin(beta), 62 * math.cos(beta) * z1[0], 62 * math.cos(beta) * z1[1])
    d.circle(mass, 9, "solid")
    d.line((mass[0] + 3, mass[1] - 10), (mass[0] + 22, mass[1] - 66), kind="n thin")
    d.text((mass[0] + 6, mass[1] - 72), "pendulous mass: m l")
    symbols = (
        "H: angular momentum along z.   K = m l / H.   The output is the angle α of the outer gimbal about X_0,"
    )
    d.text((20, 478), symbols)
    d.text((20, 502), "positive from Y_0 to Z_0. It is read as ψ from an arbitrary zero:  α = ψ + φ.")
    return d


def effective_axis() -> Drawing:
    """The axis along which the instrument measures, on its cone."""
    d = Drawing(880, 360, "The effective input axis turns on a cone of half angle beta about X0")
    top, foot = 70, 290
    centre = (220, foot)
    d.arrow((220, 320), (220, 40), "X_0", "n")
    cone = ellipse((220, top + 30), (95, 22))
    d.curve(cone, "b thin dash")
    d.line(centre, (125, top + 30), kind="n thin dash")
    d.line(centre, (315, top + 30), kind="n thin dash")
    axis = (220 + 95 * math.cos(0.6), top + 30 + 22 * math.sin(0.6))
    d.arrow(centre, axis, "n(α)", "b", (22, 10))
    d.arc(centre, 120, 90, 68, "r", head=False)
    d.text((236, 160), "β", "r")
    d.curve(cone[4:26], "b", head=True)
    d.text((330, top + 4), "turns with α: one turn of the gimbal is one turn on the cone", "b")
    d.text((380, 170), "The output rate is K f · n(α):")
    d.text((380, 200), "α′ = K ( a_x + tan β ( a_Y sin α − a_Z cos α ) )", "head")
    d.text((380, 232), "Along X_0 it reads a_x. Across it, transverse force")
    d.text((380, 254), "leaks in once a turn. It averages out only if the")
    d.text((380, 276), "gimbal turns evenly, and it does not: near")
    d.text((380, 298), "|a_x| = a_t tan β the gimbal stands still (it locks).")
    return d


def dividing_head() -> Drawing:
    """A dividing head: angle, axes, force and azimuth."""
    d = Drawing(880, 400, "Dividing head: position x turns the instrument about Z0; f = g (cos x, -sin x, 0)")
    c, x = (230, 200), math.radians(35)
    d.circle(c, 130)
    d.circle(c, 5, "solid")
    d.arrow(c, (230, 40), "up: f = g", "r", (8, 4))
    d.line(c, (230, 62), kind="n thin dash")
    tip = (230 - 118 * math.sin(x), 200 - 118 * math.cos(x))
    d.arrow(c, tip, "X_0", "b", (-42, -12))
    d.arrow(c, (230 - 118 * math.cos(x), 200 + 118 * math.sin(x)), "Y_0", "b", (-38, 20))
    d.text((242, 222), "Z_0", "b")
    d.arc(c, 92, 90, 125, "g")
    d.text((196, 96), "x", "g")
    d.text((60, 372), "seen along the axis of the head: Z_0 towards you")
    d.text((430, 90), "At position x the force in the axes of the instrument is", "")
    d.text((430, 120), "a_x = g cos x,   a_Y = − g sin x,   a_Z = 0", "head")
    d.text((430, 156), "Position 0: X_0 points up. Positive x turns X_0")
    d.text((430, 178), "towards Y_0 (right-handed about Z_0).")
    d.text((430, 214), "azimuth: direction of Z_0, the axis of the head,")
    d.text((430, 236), "from north over east. 0 if it is not given.")
    d.text((430, 272), "Near x = 90° and 270° the gimbal locks: leave")
    d.text((430, 294), "these positions out.")
    return d


def centrifuge() -> Drawing:
    """A centrifuge from above."""
    d = Drawing(880, 380, "Centrifuge from above: X0 inward, Y0 against the motion, Z0 up")
    c, at = (190, 200), (330, 200)
    d.circle(c, 140, "l n thin dash")
    d.circle(c, 14)
    d.line(c, at)
    d.box((308, 178), (44, 44))
    d.arrow((330, 200), (252, 200), "X_0", "b", (-8, -10))
    d.arrow((330, 200), (330, 276), "Y_0", "b", (8, 6))
    d.circle((330, 200), 5, "fb")
    d.text((358, 190), "Z_0 up", "b")
    d.arc(c, 60, 40, 125, "g")
    d.text((168, 128), "Ω > 0", "g")
    d.line((190, 226), (330, 226), kind="n thin")
    d.text((244, 246), "r", "n")
    d.text((430, 90), "Seen from above. On the arm:")
    d.text((430, 120), "f = ( r Ω²,  − r Ω′,  g )", "head")
    d.text((430, 156), "X_0 points to the spindle, so the force is positive.")
    d.text((430, 178), "outward = true turns X_0 away from it: then it is")
    d.text((430, 200), "negative. Measure both for k_0 and k_2.")
    d.text((430, 236), "Ramps between the levels are not used. A tilt of the")
    d.text((430, 258), "arm by 1″ adds 4.8 µg to every level: state it.")
    return d


def rate_table() -> Drawing:
    """A rate table with a vertical axis."""
    d = Drawing(880, 330, "Rate table: the base turns about X0")
    d.box((90, 220), (240, 24))
    d.box((180, 244), (60, 40))
    d.box((175, 150), (70, 70))
    d.arrow((210, 185), (210, 50), "X_0 = axis of the table", "b")
    d.curve(ellipse((210, 100), (70, 14), -135.0, 135.0), "g", head=True)
    d.text((290, 104), "Ω_x", "g")
    d.text((400, 90), "The gimbal keeps its direction in space, so the output")
    d.text((400, 112), "shows the rate of the base with the opposite sign:")
    d.text((400, 144), "α′ = K a_x − Ω_x + coupling", "head")
    d.text((400, 180), "It checks sign, counts per revolution and time scale.")
    d.text((400, 202), "With a horizontal axis gravity turns in the base,")
    d.text((400, 224), "and every position of a head is passed once a turn.")
    return d


def vibration_table() -> Drawing:
    """A vibration table."""
    d = Drawing(880, 330, "Vibration table: rectification shows k2")
    d.box((120, 200), (180, 60), "shaker")
    d.box((150, 176), (120, 24))
    d.box((175, 106), (70, 70))
    d.arrow((210, 140), (210, 40), "X_0", "b")
    d.arrow((320, 150), (320, 96), "", "g")
    d.arrow((320, 150), (320, 204), "a sin ω t", "g", (10, -48))
    d.text((430, 96), "Vibration along X_0 with the mean square ⟨a²⟩")
    d.text((430, 118), "shifts the mean output:")
    d.text((430, 150), "Δ a_x = k_2 ⟨a²⟩", "head")
    d.text((430, 186), "So k_2 is seen without a centrifuge. Along another")
    d.text((430, 208), "axis k_YY or k_ZZ is seen, between two axes k_XY.")
    d.text((430, 230), "Keep the frequency below the band of the servo.")
    return d


def triad() -> Drawing:
    """Three instruments in one body."""
    d = Drawing(880, 380, "A triad: three instruments, the directions of their input axes and gimbals")
    at: Callable[..., Point] = lambda x, y, z: isometric((230, 220), x, y, z)  # noqa: E731
    for word, body, shift, axis, place in (
        ("x", (170, 0, 0), (10, 6), (150, 26, 0), (-64, 0)),
        ("y", (0, 170, 0), (-62, 10), (22, 150, 0), (-70, -6)),
        ("z", (0, 0, 170), (10, 6), (22, 0, 150), (12, 2)),
    ):
        d.arrow(at(0, 0, 0), at(*body), f"body {word}", "n", shift)
        d.arrow(at(0, 0, 0), at(*axis), f"X_0 of {word}", "b", place)
    d.text((430, 100), "Each instrument reads K_i f · n_i(α_i).")
    d.text((430, 130), "n_i is known from its mounting and its own")
    d.text((430, 152), "calibration, α_i from its output.")
    d.text((430, 188), "Three readings give the three components of f:", "head")
    d.text((430, 214), "no other reference is needed.")
    d.text((430, 250), "Four or more, skewed: the same by least squares.")
    return d


def platform() -> Drawing:
    """The platform with its two gyros."""
    d = Drawing(
        880, 420, "The space-stable platform: two gyros with turning cases, redundancy ring, three gimbals"
    )
    d.box((40, 60), (330, 290))
    d.text((52, 82), "platform P (held by three gimbals)", "n")
    d.box((80, 110), (110, 96), "polar gyro|h_1 along z_P")
    d.box((212, 196), (140, 96), "equatorial gyro|h_2 near x_P")
    d.parts.append('<rect class="l r dash" x="200" y="170" width="164" height="138" rx="60"/>')
    d.text((196, 332), "ring: turn Y about y_P", "r")
    d.arc((135, 110), 20, 180, 0, "g")
    d.text((170, 102), "c_1, w_c", "g")
    d.arc((282, 186), 22, 200, -20, "g")
    d.text((312, 158), "c_2, w_c", "g")
    d.arrow((70, 330), (70, 250), "z_P", "b")
    d.arrow((70, 330), (150, 330), "x_P", "b", (6, 5))
    d.text((410, 96), "The cases turn at w_c, so that drifts fixed to the case")
    d.text((410, 118), "average out. The price: a case that is not square to its")
    d.text((410, 140), "axis (misalignment m_1, m_2) swings the platform:")
    d.text((410, 172), "e_x = m_1 cos c_1,   e_y = m_1 sin c_1", "head")
    d.text((410, 198), "e_z = m_2 sin c_2 / cos η − m_1 cos c_1 tan η", "head")
    d.text((410, 234), "η, the redundancy angle, couples the two gyros.")
    d.text((410, 256), "It grows over ten days, and so does the error.")
    d.text((410, 292), "Gimbals from outside: azimuth ψ, middle θ, polar σ.")
    return d


def servo_loop() -> Drawing:
    """Block diagram of the servo loop."""
    d = Drawing(880, 300, "The servo loop: a torque on the outer gimbal keeps the rotor axis at its null")
    d.box((170, 90), (140, 60), "float|c, J_y")
    d.box((400, 90), (150, 60), "outer gimbal|J_x, H")
    d.box((270, 200), (150, 56), "servo|k_p, k_i, k_d")
    d.arrow((50, 120), (170, 120))
    d.text((50, 108), "m l a_x", "b")
    d.arrow((310, 120), (400, 120))
    d.text((350, 110), "β", "r")
    d.arrow((550, 120), (760, 120), "α: output")
    d.line((650, 120), (650, 50), (140, 50))
    d.arrow((140, 50), (140, 118))
    d.text((300, 42), "H α′: gyroscopic torque", "n")
    d.arrow((345, 120), (345, 200))
    d.line((420, 228), (475, 228))
    d.arrow((475, 228), (475, 150))
    d.text((486, 196), "torque of the motor", "n")
    servo = "Gravity across X_0 pulls on the mass once a turn. The loop gives way a little: the term servo."
    d.text((50, 290), servo, "small")
    return d


def data_flow() -> Drawing:
    """From a log to numbers that are used."""
    d = Drawing(880, 250, "Flow of data: log, run file, calibration, what follows")
    names = ["log|CSV, XLSX …", "run file|TOML", "checked|record", "calibration|K, tan β, k_0 …"]
    for k, name in enumerate(names):
        d.box((20 + 190 * k, 40), (150, 64), name)
        if k:
            d.arrow((170 + 190 * (k - 1), 72), (20 + 190 * k, 72))
    for k, word in enumerate(("piga init", "piga check", "piga calibrate")):
        d.text((190 + 190 * k, 34), word, "fb small", "middle")
    results = {
        "report": "--report",
        "certificate": "piga certificate",
        "corrected force": "piga compensate",
        "trend": "piga records",
    }
    for k, (name, word) in enumerate(results.items()):
        d.box((20 + 190 * k, 176), (150, 48), name)
        d.line((665, 104), (665, 140), (95 + 190 * k, 140))
        d.arrow((95 + 190 * k, 140), (95 + 190 * k, 176))
        d.text((103 + 190 * k, 164), word, "fb small")
    return d


def terms_and_stands() -> Drawing:
    """Which test shows which term."""
    d = Drawing(880, 420, "Which test shows which term")
    stands = ("head", "rolled|head", "centrifuge", "rate table", "vibration", "head and|centrifuge")
    rows = (
        ("scale_factor, tan_beta", "yyyy.y"),
        ("k0 (bias)", "yyyyyy"),
        ("m_Y", "y.py.y"),
        ("m_Z, k_XZ", ".y...."),
        ("k2", "p.y.yy"),
        ("k3, k2o", "..y..y"),
        ("k_YY (with k0 and k2)", ".....y"),
        ("k_XY", "y..y.y"),
        ("servo", "p....y"),
        ("servo_damping", "y....y"),
        ("k0_T, k1_T", "pp...."),
    )
    for k, stand in enumerate(stands):
        for j, line in enumerate(stand.split("|")):
            d.text((320 + 100 * k, 30 + 18 * j), line, "head", "middle")
    for j, (terms, marks) in enumerate(rows):
        y = 74 + 28 * j
        d.parts.append(f'<text x="20" y="{y + 5}">{escape(terms)}</text>')
        d.line((20, y + 14), (860, y + 14), kind="thin n")
        for k, mark in enumerate(marks):
            if mark == "y":
                d.circle((320 + 100 * k, y), 8, "fb")
            elif mark == "p":
                d.path(f"M{312 + 100 * k} {y} a8 8 0 1 0 16 0 a8 8 0 1 0 -16 0", "b")
    d.circle((30, 398), 8, "fb")
    d.text((46, 403), "shows it", "small")
    d.path("M142 398 a8 8 0 1 0 16 0 a8 8 0 1 0 -16 0", "b")
    partly = "shows it if another term is fixed, or if the temperature changes apart from the positions"
    d.text((166, 403), partly, "small")
    return d


def _chart(d: Drawing, corner: Point, size: Point, words: str, good: bool) -> None:
    """An empty chart with its zero line and its heading."""
    (x, y), (w, h) = corner, size
    d.line((x, y), (x, y + h), (x + w, y + h), kind="thin")
    d.line((x, y + h / 2), (x + w, y + h / 2), kind="thin dash n")
    d.text((x, y - 8), words, "g small" if good else "r small")


def _noise(count: int, seed: int) -> list[float]:
    """Numbers between -1 and 1 that look like noise, the same in each build."""
    waves = (math.sin(12.9898 * (k + 1) + 78.233 * seed) * 43758.5453 for k in range(count))
    return [(wave % 1.0) * 2.0 - 1.0 for wave in waves]


def residuals() -> Drawing:
    """Six pairs of residuals: a sound record, and one with a fault."""
    width, height = 185, 96
    d = Drawing(900, 620, "Six pairs of residuals: sound (left) and with a fault (right)")
    count = 24
    angles = [2.0 * math.pi * k / count for k in range(count)]
    faults: tuple[tuple[str, Callable[[int], float]], ...] = (
        ("by position: a term is missing", lambda k: 0.7 * math.cos(2.0 * angles[k])),
        ("by order: the servo is missing", lambda k: 1.6 if k == 8 else 0.0),
        ("by time: the counter slipped", lambda k: 0.8 if k > 13 else -0.1),
        ("by time: spikes", lambda k: 0.9 if k in (5, 15) else 0.0),
        ("by time: the bias drifts", lambda k: 0.9 - 1.7 * k / count + 0.3 * math.sin(k / 3.0)),
        ("by position: head badly set", lambda k: 1.1 * _noise(count, 91)[k]),
    )
    for pair, (words, fault) in enumerate(faults):
        x, y = 20 + 455 * (pair % 2), 40 + 200 * (pair // 2)
        for side in (0, 1):
            corner = (x + side * 215, y)
            by_order = "order" in words
            _chart(d, corner, (width, height), words if side else "sound", good=not side)
            for k, noise in enumerate(_noise(count, pair + 7)):
                value = 0.13 * noise + (fault(k) if side else 0.0)
                at = (corner[0] + 6 + k * (width - 10) / count, corner[1] + height / 2 - 0.5 * height * value)
                if by_order:
                    top = corner[1] + height - height * min(abs(value) / 1.75 + 0.03, 1.0)
                    d.line((at[0], corner[1] + height), (at[0], top), kind="b")
                else:
                    d.circle((at[0], max(at[1], corner[1])), 2.6, "fb")
        d.text((x, y + height + 22), RESIDUAL_REMEDIES[pair], "small")
    return d


RESIDUAL_REMEDIES = (
    "Add the term that the remark names.",
    "Order 2: add the terms of the servo. Order 1: add the coupling.",
    "Check the counter; use a phase for each segment.",
    "They are left out and listed. Look at the log there.",
    "Visit the positions in shuffled order; record the temperature.",
    "State how well the angle is set; the intervals include the scatter.",
)


def triangle() -> Drawing:
    """The whitened triangle of a position, and how triangles add up."""
    d = Drawing(880, 330, "A position becomes one whitened triangle; triangles add up")
    names = ("K", "p", "q", "k_0", "m_Y", "h", "y")
    d.text((20, 30), "rows of one position", "small n")
    for k, name in enumerate(names):
        d.text((40 + 26 * k, 56), name, "fr" if name == "y" else "fb" if name == "h" else "", "middle")
        for j in range(9):
            d.parts.append(f'<rect class="body" x="{29 + 26 * k}" y="{64 + 24 * j}" width="22" height="20"/>')
    d.text((29, 300), "increments: terms, its own rate h, reading y", "small n")
    d.arrow((225, 165), (330, 165))
    d.text((277, 142), "whiten, QR", "fb small", "middle")
    for k in range(len(names)):
        for j in range(k + 1):
            kind = "fr" if k == len(names) - 1 else "fb" if k == len(names) - 2 else "fn"
            d.tile((345 + 24 * k, 78 + 24 * j), (20, 20), kind, ".75")
    d.text((345, 275), "7 x 7, whatever the length", "small n")
    d.arrow((530, 165), (620, 165))
    d.text((575, 142), "add up", "fb small", "middle")
    for n in range(3):
        for k in range(5):
            for j in range(k + 1):
                d.tile((640 + 14 * k, 40 + 84 * n + 14 * j), (11, 11), "fn", ".6")
        d.text((722, 80 + 84 * n), f"position {n + 1}", "small n")
    d.text((640, 312), "K, tan β, k_0 … and their scatter", "small")
    return d


def scatter() -> Drawing:
    """The scatter of the positions against what their noise predicts."""
    d = Drawing(880, 300, "The interval comes from the scatter of the positions")
    spread = _noise(12, 3)
    for side, (words, size) in enumerate(
        (("they scatter as their noise predicts", 0.55), ("they scatter more", 1.6))
    ):
        x, kind = 40 + 430 * side, "g" if not side else "r"
        d.text((x, 30), words, f"head {kind}")
        d.line((x, 150), (x + 380, 150), kind="thin dash n")
        for k, value in enumerate(spread):
            at = (x + 20 + 30 * k, 150 - 52 * size * value)
            d.line((at[0], at[1] - 22), (at[0], at[1] + 22), kind="thin b")
            d.circle(at, 4, "fb")
        half = 24 if not side else 66
        d.tile((x, 150 - half), (380, 2 * half), FILLS[kind], ".15")
        d.text((x, 268), "bar: noise within the position. Band: scatter of all positions.", "small n")
    rule = "U is Student's t times the scatter over the root of the number of positions, with their degrees of freedom."
    d.text((40, 290), rule, "small")
    return d


def _measured(name: str) -> list[dict[str, Any]]:
    """Figures of a table of ``docs/measured``."""
    return list(json.loads((FOLDER.parent / "measured" / f"{name}.json").read_text("utf-8"))["figures"])


def scenarios() -> Drawing:
    """Coverage of the intervals by scenario: the simulator of piga (blue) and the independent one (red)."""
    rows = [
        (str(figure["row"]), figure["value"], kind)
        for name, column, kind in (("intervals", "coverage", "b"), ("scatter-rule", "intervals hold", "r"))
        for figure in _measured(name)
        if figure["column"] == column
    ]
    bottom = 46 + 24 * len(rows)
    d = Drawing(900, bottom + 54, "Coverage of 95 % intervals by scenario")
    d.tile((801, 36), (28, bottom - 36), "fg", ".15")
    for share in (70, 80, 90, 95, 100):
        x = 640 + 7 * (share - 70)
        d.line((x, 36), (x, bottom), kind="thin n")
        if share != 95:
            d.text((x, 26), f"{share} %", "small n", "middle")
    hold = "Share of 95 % intervals that hold: worst and best coefficient. Green: the goal, 93 to 97 %."
    d.text((20, bottom + 24), hold, "small")
    for k, (words, span, kind) in enumerate(rows):
        y, shares = 54 + 24 * k, span if isinstance(span, list) else [span]
        d.parts.append(f'<text class="small" x="20" y="{y + 5}">{escape(words)}</text>')
        ends = [(640.0 + 7.0 * (share - 70.0), y) for share in (min(shares), max(shares))]
        d.line(*ends, kind=kind)
        for end in ends:
            d.circle(end, 3.5, FILLS[kind])
    colours = "Blue: 200 tests of piga's simulator each. Red: independent simulation, 40 to 150 records each."
    d.text((20, bottom + 46), colours, "small")
    return d


DRAWINGS = (
    instrument, effective_axis, dividing_head, centrifuge, rate_table, vibration_table, triad, platform, servo_loop, data_flow,
    terms_and_stands, residuals, triangle, scatter, scenarios,
)  # fmt: skip


def main() -> None:
    """Write all drawings."""
    for make in DRAWINGS:
        (FOLDER / f"drawing-{make.__name__.replace('_', '-')}.svg").write_text(make().svg(), "utf-8")


if __name__ == "__main__":
    main()
